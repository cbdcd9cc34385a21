"""Files as they are read: what contradicts its checksum is refused, pipes are read once, and numbers do not wrap."""

import io
import os
import re
import shutil
import struct
import threading
import zipfile
import zlib
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from phasemark import InputFileError, UsageError
from phasemark.cli import main
from phasemark.data import BankPlan, FramePlan, build_bank, build_frames, open_bank, open_frames, read_frames
from phasemark.data.export import export_frames
from phasemark.data.files import write_checksum
from phasemark.data.files.narrow import narrowed
from phasemark.inputs import checksum_path, is_vouched_for, read_whole, unverified
from phasemark.landmarks import read_mesh
from phasemark.matcher.plan_kinds import plan_example
from phasemark.render import Sensor, preset

SENSOR = preset("pmd-16x16")
STATED: dict[str, Any] = {"unit": "m", "quantity": "range"}
BANK = BankPlan(classes=["cone"], distance_m="1", delta_deg="0:90:45", model="planar")
FRAMES = FramePlan(classes=["cone"], views=3, frames_per_view=2)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    build_bank(BANK, folder / "bank.h5").close()
    with build_frames(FRAMES, folder / "frames.h5") as frames:
        export_frames(frames, folder / "z.csv", "csv", quantity="z")
    return folder


@pytest.fixture
def folder(good, tmp_path, monkeypatch):
    shutil.copytree(good, tmp_path / "files")
    monkeypatch.chdir(tmp_path / "files")
    return tmp_path / "files"


def flip_last_value(path):
    """Change one byte of the values of an HDF5 file, which it opens with all the same."""
    with h5py.File(path) as file:
        dataset = file["lower/phasor"] if "lower" in file else file["range"]
        place = dataset.id.get_offset() + dataset.nbytes - 4
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


READ = {
    "match": ["match", "bank.h5", "frames.h5"],
    "match frames": ["match", "bank.h5", "z.csv"],
    "bank info": ["bank", "info", "bank.h5"],
    "bank resume": [
        "bank", "build", "--class", "cone", "--distance", "1", "--delta", "0:90:45", "--model", "planar", "--resume",
        "-o", "bank.h5",
    ],
    "frames info": ["frames", "info", "frames.h5"],
    "frames export": ["frames", "export", "frames.h5", "--to", "npz", "-o", "out.npz"],
    "frames show": ["frames", "show", "frames.h5", "-o", "out.png"],
    "frames import": ["frames", "import", "z.csv", "-o", "out.npz"],
}  # fmt: skip


@pytest.mark.parametrize("command", READ)
def test_a_file_that_its_checksum_contradicts_is_refused_before_it_is_opened(folder, capsys, monkeypatch, command):
    def opened(*given, **options):
        raise AssertionError("opened before it was compared")

    victim = {"match frames": "z.csv", "frames import": "z.csv"}.get(command)
    victim = folder / (victim or ("bank.h5" if "bank.h5" in READ[command] else "frames.h5"))
    if victim.suffix == ".csv":
        write_checksum(victim)
        victim.write_bytes(victim.read_bytes() + b"\n")
    else:
        flip_last_value(victim)
        monkeypatch.setattr("phasemark.data.files.hdf5_reading.refusal", opened)
        monkeypatch.setattr(h5py, "File", opened)
    before = sorted(os.listdir(folder))
    assert main(READ[command]) == 3
    out, err = capsys.readouterr()
    assert out == ""
    assert re.fullmatch(rf"error: {victim.name}: damaged: its SHA-256 is \w+, but .* \(--no-verify .*\)\n", err)
    assert sorted(os.listdir(folder)) == before


def test_no_verify_reads_it_all_the_same_before_and_behind_the_command(folder, capsys):
    flip_last_value(folder / "bank.h5")
    assert main(["--no-verify", "bank", "info", "bank.h5"]) == 0
    assert main(["bank", "info", "bank.h5", "--no-verify"]) == 0
    assert capsys.readouterr().err == ""
    assert main(["bank", "info", "bank.h5"]) == 3  # it holds for one command
    with pytest.raises(InputFileError, match="damaged"):
        open_bank("bank.h5")
    with unverified(), open_bank("bank.h5") as bank:
        assert bank.classes == ("cone",)


def test_a_missing_checksum_is_a_note(folder, capsys):
    checksum_path(folder / "bank.h5").unlink()
    assert main(["bank", "info", "bank.h5"]) == 0
    assert capsys.readouterr().err == (
        "note: bank.h5: has no checksum 'bank.h5.sha256' beside it, so damage may go unnoticed\n"
    )


def test_other_files_are_compared_with_a_checksum_they_have(tmp_path):
    for name, read in (
        ("part.stl", lambda path: read_mesh(path, unit="m")),
        ("camera.toml", Sensor.from_toml),
        ("frames.npy", lambda path: read_frames(path, sensor=SENSOR, **STATED)),
    ):
        (tmp_path / name).write_bytes(b"content")
        write_checksum(tmp_path / name)
        (tmp_path / name).write_bytes(b"Content")
        with pytest.raises(InputFileError, match=f"{name}: damaged: its SHA-256"):
            read(tmp_path / name)


def test_a_changed_byte_is_found_whatever_the_size_and_time_of_the_file(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"one")
    write_checksum(path)
    assert is_vouched_for(path)
    times = path.stat()
    path.write_bytes(b"two")
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    with pytest.raises(InputFileError, match="damaged"):
        is_vouched_for(path)


@contextmanager
def pipe_of(content, folder):
    """A named pipe that delivers some bytes once."""
    pipe = folder / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=pipe.write_bytes, args=(content,))
    writer.start()
    yield pipe
    writer.join(10)
    assert not writer.is_alive()


@pytest.mark.parametrize("kind", ["npy", "npz", "csv", "png"])
def test_a_named_pipe_is_read_once_and_whole_for_every_kind(folder, tmp_path, kind):
    values = np.random.default_rng(1).uniform(0.5, 2, (40, 16, 16))  # more than a pipe holds
    np.save(folder / "a.npy", values)
    np.savez(folder / "a.npz", range=values)
    np.savetxt(folder / "a.csv", values.reshape(len(values), -1), delimiter=",")
    with open_frames(folder / "frames.h5") as frames:
        export_frames(frames, folder / "png", "png16", quantity="range")
    source = folder / f"a.{kind}" if kind != "png" else folder / "png" / "00000000.png"
    stated = {} if kind == "png" else STATED
    with pipe_of(source.read_bytes(), tmp_path) as pipe:
        through = read_frames(pipe, sensor=SENSOR, **stated)
    np.testing.assert_array_equal(through.range_m, read_frames(source, sensor=SENSOR, **stated).range_m)


def test_a_plan_may_come_from_a_pipe_that_is_asked_twice(tmp_path, capsys):
    with pipe_of(plan_example("frames").encode(), tmp_path) as pipe:
        assert main(["plan", "check", str(pipe)]) == 0
    assert capsys.readouterr().err == ""


def test_hdf5_from_a_pipe_is_one_line(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe")
    assert main(["frames", "info", str(tmp_path / "pipe")]) == 3
    assert "copy it to a file first" in capsys.readouterr().err


@pytest.mark.parametrize(("value", "kind"), [(256, "|u1"), (-1, "|u1"), (32768, "<i2"), (2**31, "<i4"), (-129, "|i1")])
def test_a_number_that_does_not_fit_its_type_is_refused(value, kind):
    with pytest.raises(UsageError, match=f"got {value}"):
        narrowed([0, value], kind, "splits")


def npy(header, values=b""):
    text = header.encode() + b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + values


def png(width, height):
    def chunk(name, body):
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")


def damaged_lzma():
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_LZMA) as archive, archive.open("range.npy", "w") as member:
        np.lib.format.write_array(member, np.random.default_rng(0).random((1, 16, 16)))
    content = bytearray(buffer.getvalue())
    content[60:400] = bytes(340)
    return bytes(content)


FOREIGN = {
    "descr.npy": npy("{'descr': (), 'fortran_order': False, 'shape': (1, 16, 16), }"),
    "huge.npy": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1e30, 16, 16), }"),
    "truth.npy": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (True, 16, 16), }", bytes(2048)),
    "large.npy": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (4000000000, 16, 16), }", bytes(2048)),
    "record.npy": npy("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1, 16, 16), }", bytes(2048)),
    "two.npy": 2 * npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1, 16, 16), }", np.ones(256).tobytes()),
    "lzma.npz": damaged_lzma(),
    "wide.png": png(65535, 65535),
    "widest.png": png(2**31 - 1, 2**31 - 1),
    "bomb.png": png(4096, 4096),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_what_foreign_decoders_stumble_over_is_one_line(tmp_path, capsys, name):
    path = tmp_path / name
    path.write_bytes(FOREIGN[name])
    assert main(["frames", "import", str(path), "-o", str(tmp_path / "o.npz"), "--unit", "m", "--quantity", "z"]) == 3
    out, err = capsys.readouterr()
    assert out == ""
    assert re.fullmatch(rf"error: {re.escape(str(path))}: [^\n]+\n", err)
    assert os.listdir(tmp_path) == [name]


def test_what_is_packed_to_fill_the_memory_is_refused_before_it_is_read(tmp_path):
    with h5py.File(tmp_path / "packed.h5", "w") as file:
        values = file.create_dataset("range", (300_000, 16, 16), "u1", chunks=(1000, 16, 16), compression=4)
        values[:1] = 1
        file["padding"] = np.random.default_rng(0).integers(0, 255, 1 << 20, np.uint8)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("range.npy", "w") as member:
        np.lib.format.write_array(member, np.zeros((1 << 17, 16, 16), np.uint8))
        archive_padding = np.random.default_rng(0).bytes(1 << 18)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr("padding", archive_padding)
    (tmp_path / "packed.npz").write_bytes(buffer.getvalue())
    for name in ("packed.h5", "packed.npz"):
        with pytest.raises(InputFileError, match=r"declares \d+ values, far more than a file of this size holds"):
            read_frames(tmp_path / name, sensor=SENSOR, **STATED)


def test_our_own_files_may_not_expand_as_those_of_others(folder):
    with h5py.File(folder / "bank.h5", "r+") as file:
        del file["lower/coverage"]
        file.create_dataset("lower/coverage", (80_000_000,), "f4", chunks=(1 << 20,), compression=9)
    checksum_path(folder / "bank.h5").unlink()
    with pytest.raises(InputFileError, match="declares far more values"):
        open_bank("bank.h5")


def test_files_that_are_read_whole_have_a_size_they_may_have(tmp_path):
    for name, read in (("a.stl", lambda path: read_mesh(path, unit="m")), ("a.toml", Sensor.from_toml)):
        with (tmp_path / name).open("wb") as file:
            file.truncate(1 << 40)
        with pytest.raises(InputFileError, match="far too large for a file of this kind"):
            read(tmp_path / name)
    with pytest.raises(InputFileError, match="far too large"):
        read_whole(Path("/dev/zero"), most_bytes=1000)
