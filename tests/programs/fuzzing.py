"""Damaged and hostile files for every reader, found by mutation that follows what code they reach.

``python tests/programs/fuzzing.py KIND,... COUNT SEED FOLDER`` reads COUNT mutants of each kind in a process of its own
and prints how it went; a crash of that process is a finding as well. An input that reaches lines which no other has
reached is mutated further. An input that ends in anything but an answer or a :class:`phasemark.PhasemarkError` is kept
in FOLDER, and belongs into ``tests/corpus/KIND`` once it is mended: the ordinary tests read all that is there, and
mutation begins with it.
"""

import io
import json
import os
import random
import resource
import shutil
import signal
import sys
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from phasemark import PhasemarkError
from phasemark.data import BankPlan, FramePlan, open_bank, open_frames, read_frames
from phasemark.data.shards.build import _Manifest
from phasemark.inputs import checksum_path, read_checksum
from phasemark.landmarks import build_mesh, catalog, export_mesh, read_mesh
from phasemark.matcher.calibration.known_poses import read_poses
from phasemark.matcher.plan_kinds import KINDS as PLANS
from phasemark.matcher.plan_kinds import check_plan, plan_example
from phasemark.matcher.position import read_landmark_map
from phasemark.render import Sensor, preset

CORPUS = Path(__file__).resolve().parent.parent / "corpus"
SENSOR = preset("pmd-16x16").model_copy(update={"rows": 4, "cols": 4})
MOST_SECONDS = 10
MOST_BYTES = 2 << 30
OWN_READERS = (
    "/data/",
    "/landmarks/",
    "/inputs/",
    "/render/sensor/",
    "/matcher/plan_kinds.py",
    "/matcher/position/landmark_map.py",
    "/matcher/calibration/known_poses.py",
)
_TRACED = (*OWN_READERS, "numpy/lib/", "/zipfile", "/PIL/Png", "trimesh/exchange", "/tomllib/")
_TRACE_SHARE = 0.1
"""Share of the mutants whose lines are followed, which takes ten times as long."""
_MOST_SEEDS = 400
WORDS = (
    b"0", b"-1", b"1e30", b"nan", b"inf", b"-inf", b"True", b"()", b"[]", b"{}", b"''", b"\0", b"\n", b",", b";", b"#",
    b"4294967295", b"2147483648", b"9223372036854775808", b"1e-320", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x80",
    b"\xef\xbb\xbf", b"O", b"<f8", b"|O", b"<U9", b"<c16", b"|V0", b"t_ms", b"range_0", b"mm_0", b"status_0", b"=",
)  # fmt: skip
NUMBERS = (0, 1, 2**16 - 1, 2**31 - 1, 2**32 - 1)
SAMPLES = ("bank", "frames", "scenes", "h5")
"""Kinds that are read by a child process of the guard first, which takes a fraction of a second each."""


def frames(path: Path) -> None:
    read_frames(path, sensor=SENSOR, unit="m", quantity="range", valid_status=[5])


def stated_frames(path: Path) -> None:
    read_frames(path, sensor=SENSOR, valid_status=[5], untrusted=True)


def mesh(path: Path) -> None:
    found = read_mesh(path, unit="m")
    assert len(found.faces) > 0
    assert np.isfinite(found.vertices).all()


def plan(kind: str) -> Callable[[Path], object]:
    return lambda path: check_plan(path, kind)


def whole_bank(path: Path) -> None:
    with open_bank(path, untrusted=True) as bank:
        for group in (bank.lower, bank.upper, bank.full):
            if group is not None:
                for name in ("phasor", "intensity", "coverage"):
                    getattr(group, name)
        bank.info()
        bank.mesh(bank.classes[0])


def whole_frames(path: Path) -> None:
    with open_frames(path, untrusted=True) as found:
        found.frames()
        found[0]
        found.info()


def checksum(path: Path) -> None:
    read_checksum(path.with_suffix(""))


def seeds(kind: str, folder: Path) -> list[bytes]:
    """Return small good files of a kind, and what is kept in the corpus; a bag is a list of files with their names."""
    kept = [path.read_bytes() for path in sorted((CORPUS / kind).glob("*"))] if kind != "bag" else []
    return kept + KINDS[kind][2](folder)


def _image() -> NDArray[Any]:
    return np.random.default_rng(0).uniform(0.5, 2, (2, 4, 4))


def _good_npy(folder: Path) -> list[bytes]:
    path = folder / "a.npy"
    found = []
    for values in (_image(), _image().astype("<f4"), np.asfortranarray(_image()), (1e3 * _image()).astype("u2")):
        np.save(path, values)
        found.append(path.read_bytes())
    return found


def _good_npz(folder: Path) -> list[bytes]:
    path, found = folder / "a.npz", list[bytes]()
    for save in (np.savez, np.savez_compressed):
        save(path, range=_image(), amplitude=_image(), t_ms=np.arange(2), unit="m", quantity="range")
        found.append(path.read_bytes())
    for method in (zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2):
        with zipfile.ZipFile(folder / "b.npz", "w", method) as archive:
            for name, value in (("range", _image()), ("unit", np.array("m")), ("quantity", np.array("z"))):
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, value)
        found.append((folder / "b.npz").read_bytes())
    return found


def _good_png(folder: Path) -> list[bytes]:
    from phasemark.data.export.images import encode_png16

    return [encode_png16(_image()[0], 1e-4, "z")]


def _good_csv(folder: Path) -> list[bytes]:
    rows = [",".join(f"{v:.3f}" for v in frame.ravel()) for frame in _image()]
    named = ["t_ms", *(f"mm_{k}" for k in range(16)), *(f"status_{k}" for k in range(16)), "truth_class"]
    line = ",".join(["0", *("1000",) * 16, *("5",) * 16, "cone"])
    return ["\n".join(rows).encode(), "\n".join([",".join(named), line, line]).encode()]


def _good_board(folder: Path) -> list[bytes]:
    row = "\t500" * 4 + "\n"
    zones = "".join(f"Zone : {zone:3}, Status :   5, Distance :  500 mm\n" for zone in range(16))
    line, cells = " -----------------" * 4 + "\n", "|   500  :      5 " * 4 + "|\n"
    state = "[D][text_sensor:069]: 'a': Sending state '" + ",\n".join(["0.500," * 3 + "0.500"] * 4) + "'\n"
    values = ",".join(["500"] * 16)
    numbers = ",".join(["500"] * 77)
    texts = (
        "SparkFun VL53L5CX\n" + (4 * row + "\n") * 2, ("500\t" * 3 + "----\t\n") * 4 + "\n",
        ("Print data no :   1\n" + zones) * 2,
        4 * (line + cells) + line, 2 * state, f'{{"t_ms": 1, "distances": [{values}], "status": [{values}]}}\n' * 2,
        f"FRAME_START\nD:{values}\nS:{values}\nFRAME_END\n", f"#Obj,{numbers}\n" * 8,
    )  # fmt: skip
    return [text.encode() for text in texts]


def _good_plan(kind: str) -> Callable[[Path], list[bytes]]:
    return lambda folder: [plan_example(kind).encode()]


def _good_sensor(folder: Path) -> list[bytes]:
    fields = [preset(name).model_dump() for name in ("vl53l5cx-8x8", "pmd-16x16-wiggle")]

    def lines(table: dict[str, Any]) -> str:
        stated = {name: value for name, value in table.items() if value not in (None, [], ())}
        return "".join(f"{name} = {json.dumps(value)}\n" for name, value in stated.items())

    files = []
    for one in fields:
        histogram = one.pop("histogram", None)
        files.append(lines(one) + (f"[histogram]\n{lines(histogram)}" if histogram else ""))
    lens = {"fx": 15.0, "fy": 15.0, "cx": 3.5, "cy": 3.5, "distortion": [-0.2, 0.1, 0.001, 0.0]}
    files.append(f"rows = 8\ncols = 8\n[lens]\n{lines(lens)}")
    return [text.encode() for text in files]


def _good_camera_info(folder: Path) -> list[bytes]:
    calibrated = (
        b"image_width: 8\nimage_height: 8\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        b"  data: [15, 0, 3.5, 0, 15, 3.5, 0, 0, 1]\ndistortion_model: plumb_bob\n"
        b"distortion_coefficients:\n  data: [-0.2, 0.1, 0.001, 0, 0]\n"
    )
    echoed = (
        b"width: 8\nheight: 8\nbinning_x: 0\nroi: {width: 0}\ndistortion_model: equidistant\nd: [0.1, 0, 0, 0]\n"
        b"k: [15, 0, 3.5, 0, 15, 3.5, 0, 0, 1]\n---\n"
    )
    return [calibrated, echoed]


def _good_map(folder: Path) -> list[bytes]:
    one = b'[[landmark]]\nname = "door"\nclass = "cone"\nx_m = 2.0\ny_m = 1.0\nyaw_deg = 30.0\n'
    return [one, one + b"xy_std_m = 0.01\nyaw_std_deg = 1\n" + one.replace(b"door", b"gate")]


def _good_poses(folder: Path) -> list[bytes]:
    polar = b"distance_m,delta_deg,t_s,frames\n1.0,10,0.1,3\n1.2,20,0.2,3\n"
    return [polar, b"x_m;y_m;heading_deg\n1,0;0,5;180\n"]


def _good_manifest(folder: Path) -> list[bytes]:
    head = _Manifest({"plan": {"views": 3}}, 2, 1000, "a" * 64).head()
    return [head + b"".join(json.dumps({"shard": k, "sha256": "b" * 64}).encode() + b"\n" for k in range(3))]


def _good_checksum(folder: Path) -> list[bytes]:
    return [b"a" * 64 + b"  input\n", b"\\" + b"a" * 64 + b" *input\n"]


def _good_mesh(kind: str) -> Callable[[Path], list[bytes]]:
    return lambda folder: [export_mesh(build_mesh(catalog()[name]), kind) for name in ("post", "cone")][:1]


def _good_h5(folder: Path) -> list[bytes]:
    import h5py

    found = []
    ways: tuple[dict[str, Any], ...] = ({}, {"compression": "gzip", "shuffle": True, "chunks": (1, 4, 4)})
    for options in ways:
        with h5py.File(folder / "a.h5", "w") as file:
            dataset = file.create_dataset("range", data=_image(), **options)
            dataset.attrs["units"], dataset.attrs["quantity"] = "m", "range"
            file["t_ms"] = np.arange(2)
        found.append((folder / "a.h5").read_bytes())
    return found


def _good_bank(folder: Path) -> list[bytes]:
    from phasemark.data import build_bank

    build_bank(BankPlan(classes=["cone"], distance_m="1", delta_deg="0:90:45", model="planar"), folder / "b.h5").close()
    return [(folder / "b.h5").read_bytes()]


def _good_frames(folder: Path) -> list[bytes]:
    from phasemark.data import build_frames

    build_frames(FramePlan(classes=["cone"], views=2), folder / "f.h5").close()
    return [(folder / "f.h5").read_bytes()]


def _good_scenes(folder: Path) -> list[bytes]:
    from phasemark.data import build_frames
    from phasemark.data.plans import SceneFramesPlan

    scenes = {"generator": "own_generators:drive", "n": 2, "steps": 3, "bodies": 2, "classes": ["ball", "wall"]}
    build_frames(SceneFramesPlan(scenes=scenes), folder / "s.h5").close()
    return [(folder / "s.h5").read_bytes()]


def _good_bag(folder: Path) -> list[bytes]:
    from phasemark.data import build_frames
    from phasemark.data.export import export_frames

    plan = FramePlan(classes=["cone"], views=2, sensor_overrides={"rows": 4, "cols": 4})
    with build_frames(plan, folder / "g.h5") as found:
        export_frames(found, folder / "bag", "rosbag")
    return [b"".join(_packed(path) for path in sorted((folder / "bag").iterdir()))]


def _packed(path: Path) -> bytes:
    content = path.read_bytes()
    return f"{path.name}\n{len(content)}\n".encode() + content


KINDS: dict[str, tuple[str, Callable[[Path], object], Callable[[Path], list[bytes]]]] = {
    "npy": (".npy", frames, _good_npy), "npz": (".npz", stated_frames, _good_npz),
    "png": (".png", stated_frames, _good_png), "csv": (".csv", frames, _good_csv),
    "board": (".log", stated_frames, _good_board),
    **{f"{kind}-plan": (".toml", plan(kind), _good_plan(kind)) for kind in PLANS},
    "sensor": (".toml", Sensor.from_toml, _good_sensor),
    "camera-info": (".yaml", Sensor.from_camera_info, _good_camera_info),
    "map": (".toml", read_landmark_map, _good_map), "poses": (".csv", read_poses, _good_poses),
    "manifest": (".manifest", _Manifest.read, _good_manifest), "checksum": (".sha256", checksum, _good_checksum),
    **{kind: (f".{kind}", mesh, _good_mesh(kind)) for kind in ("stl", "ply", "obj", "off")},
    "bag": ("", stated_frames, _good_bag), "h5": (".h5", stated_frames, _good_h5),
    "bank": (".h5", whole_bank, _good_bank), "frames": (".h5", whole_frames, _good_frames),
    "scenes": (".h5", whole_frames, _good_scenes),
}  # fmt: skip
"""For each kind of file: how its name ends, its reader, and what makes small good files of it."""


def mutate(content: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """Return a mutant: bits, numbers, words and pieces changed, moved, repeated, or taken from another file."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        size = max(1, len(data))
        at = rng.randrange(size) if rng.random() < 0.5 else rng.randrange(min(size, 256))
        length = min(size - at, int(2 ** rng.uniform(0, 8)))
        kind = rng.randrange(9)
        if kind == 0 and data:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and data:
            data[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, 0x20, 0x30, 0x39, rng.randrange(256)))
        elif kind == 2:
            data[at : at + rng.choice((0, 1, 4, length))] = rng.choice(WORDS)
        elif kind == 3:
            del data[at : at + length]
        elif kind == 4:
            data[at:at] = data[at : at + length] * rng.choice((1, 1, 2, 50))
        elif kind == 5:
            data[at : at + length] = rng.randbytes(length)
        elif kind == 6:
            other = rng.choice(others)
            start = rng.randrange(max(1, len(other)))
            data[at : at + length] = other[start : start + length]
        elif kind == 7:
            del data[rng.randrange(size) :]
        else:
            width = rng.choice((2, 4, 8))
            number = rng.choice((*NUMBERS, len(data)))
            data[at : at + width] = number.to_bytes(8, "little")[:width]
    return bytes(data[: 1 << 18])


def mend(kind: str, content: bytes, rng: random.Random) -> bytes:
    """Give the chunks of a PNG their checksums back, most of the time: what lies behind them is to be reached."""
    if kind == "npz" and rng.random() < 0.7:
        return _archive(content, rng)
    if kind != "png" or rng.random() < 0.2:
        return content
    out, at = bytearray(content[:8]), 8
    while at + 12 <= len(content):
        length = int.from_bytes(content[at : at + 4], "big")
        body = content[at + 4 : at + 8 + length]
        out += content[at : at + 4] + body + zlib.crc32(body).to_bytes(4, "big")
        at += 12 + length
    return bytes(out) + content[at:]


def _archive(content: bytes, rng: random.Random) -> bytes:
    """Return an NPZ file, sound as an archive, one of whose members is a mutant."""
    image, time_s = _npy(_image()), _npy(np.arange(2.0))
    members = {"range": image, "t_s": time_s, "amplitude": image}
    members |= {name: _npy(np.array(word)) for name, word in (("unit", "m"), ("quantity", "z"))}
    victim = rng.choice(list(members))
    members[victim] = mutate(members[victim], [content, *members.values()], rng)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, body in members.items():
            archive.writestr(f"{name}.npy", body)
    return buffer.getvalue()


def _npy(values: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


def put(kind: str, content: bytes, folder: Path) -> Path:
    """Write an input where its reader finds it; return that path."""
    path = folder / f"input{KINDS[kind][0]}"
    if kind != "bag":
        path.write_bytes(content)
        return path
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir()
    for name, body in _unpacked(content):
        (path / name.decode("latin1")[:80]).write_bytes(body)
    return path


class Hang(BaseException):
    """A reader that has not answered in time."""


def _ring(number: int, frame: FrameType | None) -> None:
    raise Hang(f"no answer within {MOST_SECONDS} s")


def read_one(kind: str, content: bytes, folder: Path) -> bool:
    """Have the reader of a kind read an input; return whether it was refused, or raise what it raised."""
    path = put(kind, content, folder)
    signal.signal(signal.SIGALRM, _ring)
    signal.setitimer(signal.ITIMER_REAL, MOST_SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            KINDS[kind][1](path)
    except PhasemarkError as error:
        if "\n" in str(error):
            raise AssertionError("the message has more than one line") from error
        return True
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return False


class Lines:
    """Follows which lines of the readers are run."""

    def __init__(self) -> None:
        self.seen: set[tuple[CodeType, int]] = set()
        self.fresh = 0

    def _local(self, frame: FrameType, event: str, _: object) -> Any:
        key = (frame.f_code, frame.f_lineno)
        if key not in self.seen:
            self.seen.add(key)
            self.fresh += 1
        return self._local

    def _global(self, frame: FrameType, event: str, _: object) -> Any:
        return self._local if any(part in frame.f_code.co_filename for part in _TRACED) else None

    def __enter__(self) -> Self:
        self.fresh = 0
        sys.settrace(self._global)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)


def fuzz(kind: str, count: int, seed: int, folder: Path) -> dict[str, Any]:
    """Read mutants of a kind; return what was found, as plain numbers and text."""
    rng = random.Random(f"{kind} {seed}")
    work = folder / f"work-{kind}"
    work.mkdir(parents=True, exist_ok=True)
    pool = seeds(kind, work)
    put("checksum", b"a" * 64 + b"  input\n", work)
    lines, refused, longest, found = Lines(), 0, 0.0, list[str]()
    if kind != "checksum":
        checksum_path(work / "input").unlink()
    for number in range(count):
        if kind == "bag":  # names and sizes stay, so that each mutant is a bag again
            content = _mutated_bag(rng.choice(pool), rng)
        else:
            content = mend(kind, mutate(rng.choice(pool), pool, rng), rng)
        begun = time.monotonic()
        follow = kind not in SAMPLES and rng.random() < _TRACE_SHARE
        try:
            if follow:
                with lines:
                    refused += read_one(kind, content, work)
            else:
                refused += read_one(kind, content, work)
        except (Exception, Hang) as error:
            sys.settrace(None)
            place = folder / f"{kind}-{seed}-{number}"
            place.write_bytes(content)
            found.append(f"{place.name}: {type(error).__name__}: {str(error)[:200]}")
        longest = max(longest, time.monotonic() - begun)
        if follow and lines.fresh and len(pool) < _MOST_SEEDS:
            pool.append(content)
    shutil.rmtree(work)
    peak = 1024 * max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return {
        "kind": kind, "inputs": count, "refused": refused, "longest_s": longest, "peak_bytes": peak,
        "lines": len(lines.seen), "kept": len(pool), "found": found[:20], "n_found": len(found),
    }  # fmt: skip


def _mutated_bag(content: bytes, rng: random.Random) -> bytes:
    files = _unpacked(content)
    victim = rng.choice(files)
    victim[1] = mutate(victim[1], [victim[1]], rng)
    return b"".join(b"%s\n%d\n" % (name, len(body)) + body for name, body in files)


def _unpacked(content: bytes) -> list[list[bytes]]:
    """Return names and contents of the files of a bag."""
    files, at = list[list[bytes]](), 0
    while at < len(content):
        name, size, _ = content[at : at + 300].split(b"\n", 2)
        at += len(name) + len(size) + 2
        files.append([name, content[at : at + int(size)]])
        at += int(size)
    return files


def main(kinds: str, count: str, seed: str, folder: str) -> int:
    """Read mutants of each KIND or KIND:COUNT in a fork of this process, a line each; return 1 if a reader crashed."""
    codes: list[int] = []
    for one in kinds.split(","):
        kind, _, own_count = one.partition(":")
        child = os.fork()
        if child == 0:
            print(json.dumps(fuzz(kind, int(own_count or count), int(seed), Path(folder))), flush=True)
            os._exit(0)
        codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        if codes[-1]:
            print(f"the reader of {kind} ended with {codes[-1]}", file=sys.stderr)
    return int(any(codes))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
