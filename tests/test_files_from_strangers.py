"""Files from strangers: nothing outside is opened, nothing runs away, and each ends in an answer or one line."""

import contextlib
import os
import re
import shutil
import subprocess
import sys
import time
import zlib

import h5py
import numpy as np
import pytest
from damaged_files import COMMANDS, check_mutants
from programs.regenerate_golden import BANK, FRAMES

from phasemark import InputFileError
from phasemark.cli import main
from phasemark.data import open_bank, open_frames, read_frames
from phasemark.data.files.guard import first_reading, refusal
from phasemark.inputs import checksum_path
from phasemark.inputs.toml_file import read_toml
from phasemark.landmarks import read_mesh
from phasemark.matcher.calibration import read_poses
from phasemark.matcher.recordings.pose_table import read_pose_table
from phasemark.render import preset

SENSOR = preset("pmd-16x16")


@pytest.fixture
def canary(tmp_path):
    """A pipe: opening it to read waits for ever, so that it cannot be opened unnoticed."""
    path = tmp_path / "canary"
    os.mkfifo(path)
    return path


def external_link(file, canary):
    file["range"] = h5py.ExternalLink(str(canary), "/range")


def deep_external_link(file, canary):
    file["a/b/c"] = h5py.ExternalLink(str(canary), "/range")


def external_storage(file, canary):
    file.create_dataset("range", (1, 16, 16), "f4", external=[(str(canary), 0, 1024)])


def virtual_dataset(file, canary):
    layout = h5py.VirtualLayout((1, 16, 16), "f4")
    layout[0] = h5py.VirtualSource(str(canary), "range", (16, 16))
    file.create_virtual_dataset("range", layout)


def link_out_of_its_group(file, canary):
    file["a/range"] = h5py.SoftLink("/somewhere/else")


def plugin_filter(file, canary):
    creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    creation.set_chunk((1, 16, 16))
    creation.set_filter(32015, h5py.h5z.FLAG_OPTIONAL, ())  # zstandard: a plug-in
    h5py.h5d.create(file.id, b"range", h5py.h5t.IEEE_F32LE, h5py.h5s.create_simple((1, 16, 16)), creation)


def declares_8_terabytes(file, canary):
    file.create_dataset("range", (2**33, 16, 16), "f4", chunks=(1, 16, 16))


def deflate_bomb(file, canary):
    bomb = file.create_dataset("range", (2**19, 16, 16), "f4", chunks=(2**14, 16, 16), compression=9)
    packed = zlib.compress(bytes(bomb.chunks[0] * 16 * 16 * 4), 9)
    for start in range(0, len(bomb), bomb.chunks[0]):
        bomb.id.write_direct_chunk((start, 0, 0), packed)


def groups_without_end(file, canary):
    group = file
    for _ in range(40):
        group = group.create_group("g")
    group["range"] = 1.0


TRICKS = {
    external_link: "external link",
    deep_external_link: "external link",
    external_storage: "another file",
    virtual_dataset: "virtual dataset",
    link_out_of_its_group: "soft link out of its group",
    plugin_filter: "filter 32015",
    declares_8_terabytes: "declares far more",
    deflate_bomb: "declares far more",
    groups_without_end: "without end",
}


def write(trick, path, canary):
    with h5py.File(path, "w") as file:
        trick(file, canary)
    return path


@pytest.mark.parametrize("trick", TRICKS, ids=lambda trick: trick.__name__)
def test_each_trick_is_refused_by_its_name(trick, tmp_path, canary, recwarn):
    path, reason = write(trick, tmp_path / "trick.h5", canary), TRICKS[trick]
    assert reason in refusal(path)
    assert reason in first_reading(path)
    for read in (open_bank, open_frames, lambda path: read_frames(path, sensor=SENSOR, unit="m", quantity="range")):
        with pytest.raises(InputFileError, match=reason):
            read(path)


def test_refusing_takes_little_memory(tmp_path, canary, recwarn):
    paths = [write(trick, tmp_path / f"{trick.__name__}.h5", canary) for trick in TRICKS]
    program = (
        "import sys; from phasemark.data.files.guard import refusal\n"
        "def peak(): return int(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])\n"
        "before = peak()\n"  # ru_maxrss begins at what this process has
        "assert all(map(refusal, sys.argv[1:]))\n"
        "print(peak() - before)"
    )
    grown = subprocess.run([sys.executable, "-c", program, *paths], capture_output=True, text=True, check=True).stdout
    assert int(grown) < 20 << 10  # KiB: the files' metadata, none of their values


def test_what_a_cycle_of_groups_holds_is_looked_at_once(tmp_path):
    path = tmp_path / "cycle.h5"
    with h5py.File(path, "w") as file:
        outer = file.create_group("a")
        outer.create_group("b")["c"] = outer
        file["a/range"] = np.ones((1, 16, 16))
    assert refusal(path) is None
    assert first_reading(path) is None


@pytest.mark.parametrize("path", [BANK, FRAMES])
def test_an_honest_file_passes(path):
    assert refusal(path) is None
    assert first_reading(path) is None


def test_filters_of_hdf5_itself_are_read(tmp_path):
    path = tmp_path / "packed.h5"
    values = np.random.default_rng(1).uniform(1, 2, (5, 16, 16))
    with h5py.File(path, "w") as file:
        file.create_dataset("range", data=values, chunks=True, compression="gzip", shuffle=True, fletcher32=True)
    frames = read_frames(path, sensor=SENSOR, unit="m", quantity="range", untrusted=True)
    np.testing.assert_array_equal(frames.range_m[0], values)


def test_an_npz_bomb_is_refused(tmp_path):
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, range=np.zeros((2**16, 16, 16), "f4"))
    with pytest.raises(InputFileError, match="far more than its size can hold"):
        read_frames(path, sensor=SENSOR, unit="m", quantity="range")


def test_mutated_files_end_with_an_answer_or_exit_3(tmp_path, capsys):
    pytest.importorskip("rosbags")
    _, refused, _ = check_mutants(tmp_path, dict.fromkeys(COMMANDS, 1), 1)
    assert refused > 0


@pytest.mark.soak
def test_two_thousand_mutated_files_of_ours_and_of_others_end_with_an_answer_or_exit_3(tmp_path, capsys):
    pytest.importorskip("rosbags")
    n = {"bank": 1000, "frames": 1000, "part": 200, "csv": 200, "npy": 200, "npz": 200, "png": 200, "bag": 200}
    runs, refused, longest = check_mutants(tmp_path, n, 2)
    assert runs >= 2 * sum(n.values()) - n["part"]  # which has a single command
    print(f"{sum(n.values())} files, {runs} runs, {refused} refused, the longest {longest:.1f} s of processor time")


SMALL_SWEEP = """name = "small"
trials = 2
classes = ["cone"]
[axes]
distance_m = [1.0]
delta_deg = [45.0]
[[methods]]
name = "nearest"
method = "nearest"
bank_step = [0.1, 15.0]
"""


@pytest.fixture(scope="module")
def sweep_folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("sweep")
    (place / "plan.toml").write_text(SMALL_SWEEP, encoding="utf-8")
    assert main(["sweep", "run", str(place / "plan.toml"), "-o", str(place / "out"), "--workers", "1"]) == 0
    return place / "out"


@pytest.mark.parametrize("command", ["sensor fit", "sweep compare", "sweep report"])
def test_fits_and_sweeps_read_hdf5_through_checksum_child_and_guard(
    command, sweep_folder, tmp_path, canary, capsys, recwarn, monkeypatch
):
    folder = tmp_path / "sweep"
    shutil.copytree(sweep_folder, folder)
    (trials,) = folder.glob("*.h5")
    arguments = {
        "sensor fit": [trials, "--distance", "1", "--unit", "m", "--quantity", "range", "-o", tmp_path / "a.toml"],
        "sweep compare": [sweep_folder, folder],
        "sweep report": [folder],
    }[command]

    def refused():
        before = trials.read_bytes()
        capsys.readouterr()
        assert main([*command.split(), *map(str, arguments)]) == 3
        assert trials.read_bytes() == before
        (line,) = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("note: ")]
        assert line.startswith(f"error: {trials}: ")
        return line

    content = bytearray(trials.read_bytes())
    content[-1] ^= 1
    trials.write_bytes(content)
    assert "damaged" in refused()
    checksum_path(trials).unlink()
    for trick in (external_link, virtual_dataset, declares_8_terabytes):
        trials.unlink()
        assert TRICKS[trick] in (write(trick, trials, canary) and refused())
    monkeypatch.setattr("phasemark.data.files.hdf5_reading.first_reading", lambda path: f"looked at {path.name}")
    assert f"looked at {trials.name}" in refused()


def elapsed_s(work):
    """Return the processor seconds that something takes to be refused, and its message."""
    began = time.process_time()
    with pytest.raises(InputFileError) as refused:
        work()
    return time.process_time() - began, str(refused.value)


@pytest.mark.parametrize("key", ["a", '"a b"', "'a.b'", '"\\""'])
@pytest.mark.parametrize("text", ["{} = 1\n", "[{}]\n", "[[{}]]\n", "x = {{ {} = 1 }}\n"])
def test_a_key_of_a_hundred_thousand_tables_is_refused_at_once(tmp_path, key, text):
    path = tmp_path / "plan.toml"
    path.write_text("x.y = 0.5\n\n" + text.format(".".join([key] * 100_000)))
    took_s, message = elapsed_s(lambda: read_toml(path))
    assert message == f"{path}: line 3: a key has 32 dots or more, and no plan or sensor has any"
    assert took_s < 5  # tomllib takes minutes


@pytest.mark.parametrize("text", ["a" * 10**6, '"' * 10**6, '"a ' * 10**6, "a." * 15 + "a = 1", "." * 10**6])
def test_looking_for_such_keys_takes_no_longer_than_reading(tmp_path, text):
    path = tmp_path / "plan.toml"
    path.write_text(text)
    began = time.process_time()
    with contextlib.suppress(InputFileError):
        read_toml(path)
    assert time.process_time() - began < 5


@pytest.mark.parametrize("kind", ["obj", "off"])
def test_a_polygon_of_three_hundred_thousand_corners_is_refused(kind):
    n = 300_000
    turn = 2 * np.pi * np.arange(n) / n
    points = [f"{x:.6f} {y:.6f} 0" for x, y in zip(np.cos(turn), np.sin(turn), strict=True)]
    if kind == "obj":
        text = "v " + "\nv ".join(points) + "\nf " + " ".join(map(str, range(1, n + 1)))
    else:
        text = f"OFF {n} 1 0\n" + "\n".join(points) + f"\n{n} " + " ".join(map(str, range(n)))
    took_s, message = elapsed_s(lambda: read_mesh(text.encode(), unit="m", file_type=kind))
    assert re.fullmatch(r"mesh: 29\d{4} faces meet at one vertex, at most 4096 can be used: .*fewer corners", message)
    assert took_s < 40  # checking its symmetry would take hours


def test_a_quotation_mark_that_is_not_closed_does_not_swallow_the_table(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text('distance_m,delta_deg\n"1,30\n' + "1,30\n" * 200_000)
    for read in (read_poses, read_pose_table):
        with pytest.raises(InputFileError, match=r"line 2: is no line of CSV \(unexpected end of data\); a quotation"):
            read(path)
