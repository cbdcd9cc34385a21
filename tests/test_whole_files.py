"""Files are whole or not there."""

import os
import resource
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from builders import run_program
from programs.system_calls import in_fork

from phasemark import InputFileError, OutputExistsError, StorageError, UsageError
from phasemark.data.files import renames, write_atomically, write_checksum
from phasemark.data.measured import simulate_recording, write_recording
from phasemark.inputs import read_checksum, verify_checksum
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Views, preset


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_bytes_and_pieces_are_written(tmp_path):
    assert write_atomically(tmp_path / "a", b"whole").read_bytes() == b"whole"
    assert write_atomically(tmp_path / "b", (bytes([i]) for i in range(3))).read_bytes() == b"\0\1\2"
    assert names(tmp_path) == ["a", "b"]


def test_new_file_has_the_permissions_the_umask_leaves(tmp_path):
    before = os.umask(0o027)
    try:
        write_atomically(tmp_path / "a", b"x")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


def test_an_existing_output_needs_force(tmp_path):
    path = tmp_path / "a"
    write_atomically(path, b"old")
    with pytest.raises(OutputExistsError, match=r"a: exists; use force=True"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    write_atomically(path, b"new", force=True)
    assert path.read_bytes() == b"new"


def test_a_stray_checksum_of_an_absent_file_needs_force_too(tmp_path):
    (tmp_path / "a.sha256").write_text("somebody's")
    with pytest.raises(OutputExistsError, match=r"a\.sha256: exists"):
        write_atomically(tmp_path / "a", b"x", checksum=True)


@pytest.mark.parametrize("force", [False, True])
def test_folders_devices_and_absent_folders_are_refused(tmp_path, force):
    for path, reason in (
        (tmp_path / "none" / "a", "folder .*none' does not exist"),
        (tmp_path, "is a folder"),
        (Path("/dev/null"), "is a device"),
    ):
        with pytest.raises(UsageError, match=reason):
            write_atomically(path, b"x", force=force)
    assert names(tmp_path) == []


def test_content_is_on_disk_before_it_gets_its_name_and_the_name_after(tmp_path, monkeypatch):
    events = []
    real_fsync, real_rename = os.fsync, renames.rename_new

    def fsync(descriptor):
        status = os.fstat(descriptor)
        events.append(("sync", status.st_ino))
        real_fsync(descriptor)

    def replace(source, target):
        events.append(("rename", os.stat(source).st_ino))
        real_rename(source, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(renames, "rename_new", replace)
    path = write_atomically(tmp_path / "a", b"content", checksum=True)
    file, sums, folder = path.stat().st_ino, (tmp_path / "a.sha256").stat().st_ino, tmp_path.stat().st_ino
    assert events == [("sync", file), ("sync", sums), ("rename", file), ("rename", sums), ("sync", folder)]


def test_an_interrupt_leaves_nothing_behind(tmp_path):
    def pieces():
        yield b"half"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "a", pieces(), checksum=True)
    assert names(tmp_path) == []


@pytest.mark.parametrize("name", ["bank.h5", "two words.h5", "back\\slash", "new\nline", "ünï"])
def test_sha256sum_accepts_the_checksum(tmp_path, name):
    if shutil.which("sha256sum") is None:
        pytest.skip("needs sha256sum")
    write_atomically(tmp_path / name, b"content", checksum=True)
    subprocess.run(
        ["sha256sum", "--check", "--strict", f"{name}.sha256"], cwd=tmp_path, check=True, capture_output=True
    )
    theirs = subprocess.run(["sha256sum", name], cwd=tmp_path, check=True, capture_output=True).stdout
    assert (tmp_path / f"{name}.sha256").read_bytes() == theirs
    verify_checksum(tmp_path / name)


def test_checksum_of_abc_is_the_published_one(tmp_path):
    path = write_atomically(tmp_path / "abc", b"abc")
    write_checksum(path)
    # FIPS 180-2, appendix B.1
    assert read_checksum(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (None, "cannot be read"),
        ("", "must be one line"),
        ("xyz  a\n", "must be one line"),
        (f"{'0' * 64}  b\n", "must name 'a'"),
        (f"{'0' * 64}  a\n", "damaged"),
    ],
)
def test_a_checksum_file_that_is_useless_or_of_another_content_is_an_input_error(tmp_path, text, reason):
    path = write_atomically(tmp_path / "a", b"content")
    if text is not None:
        (tmp_path / "a.sha256").write_text(text)
    with pytest.raises(InputFileError, match=reason):
        verify_checksum(path)


@pytest.mark.parametrize("checksum", [True, False])
@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444])
def test_a_replaced_file_keeps_its_permissions_and_a_checksum_that_is_right(tmp_path, mode, checksum):
    path = write_atomically(tmp_path / "a", b"old", checksum=True)
    path.chmod(mode)
    write_atomically(path, b"new", force=True, checksum=checksum)
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"new", mode)
    verify_checksum(path)


def test_new_content_of_a_private_file_is_never_open_to_others(tmp_path):
    path = write_atomically(tmp_path / "a", b"old")
    path.chmod(0o600)
    seen = []

    def pieces():
        yield b"secret"
        seen.extend(entry.stat().st_mode & 0o077 for entry in tmp_path.iterdir())

    write_atomically(path, pieces(), force=True)
    assert seen == [0, 0]


def test_force_follows_a_link_and_leaves_it_a_link(tmp_path):
    (tmp_path / "real").mkdir()
    file = write_atomically(tmp_path / "real" / "a", b"old", checksum=True)
    link = tmp_path / "link"
    link.symlink_to("real/a")
    with pytest.raises(OutputExistsError):
        write_atomically(link, b"new")
    write_atomically(link, b"new", force=True, checksum=True)
    assert link.is_symlink()
    assert file.read_bytes() == b"new"
    assert verify_checksum(link) == verify_checksum(file)
    assert names(tmp_path) == ["link", "real"]
    assert names(tmp_path / "real") == ["a", "a.sha256"]


def test_a_link_with_a_checksum_of_its_own_or_in_a_circle_is_refused(tmp_path):
    file = write_atomically(tmp_path / "a", b"old", checksum=True)
    link, circle = tmp_path / "link", tmp_path / "circle"
    link.symlink_to("a")
    (tmp_path / "link.sha256").write_bytes((tmp_path / "a.sha256").read_bytes().replace(b"  a", b"  link"))
    verify_checksum(link)
    circle.symlink_to("circle")
    for path, reason in ((link, "link with a checksum of its own"), (circle, "in a circle")):
        with pytest.raises(UsageError, match=reason):
            write_atomically(path, b"new", force=True)
    assert file.read_bytes() == b"old"


@pytest.mark.parametrize("in_one_step", [True, False])
def test_a_rename_that_replaces_nothing_refuses_an_existing_name(tmp_path, monkeypatch, in_one_step):
    if not in_one_step:  # as on a file system that does not know it
        monkeypatch.setattr(renames, "_renameat2", lambda source, target, flags: False)
    (tmp_path / "a").write_bytes(b"a")
    (tmp_path / "b").write_bytes(b"b")
    with pytest.raises(FileExistsError):
        renames.rename_new(tmp_path / "a", tmp_path / "b")
    renames.rename_new(tmp_path / "a", tmp_path / "c")
    assert {name: (tmp_path / name).read_bytes() for name in names(tmp_path)} == {"b": b"b", "c": b"a"}
    if in_one_step and renames.exchange(tmp_path / "b", tmp_path / "c"):
        assert (tmp_path / "b").read_bytes() == b"a"


@pytest.mark.parametrize("action", ["kill", "ENOSPC", "other", pytest.param("EIO", marks=pytest.mark.soak)])
def test_a_file_ended_at_any_call_to_the_system_is_the_old_or_the_new_one(tmp_path, action):
    printed = run_program("file_crash_points", tmp_path, action)
    assert int(printed) > 15


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".h5"])
def test_a_recording_that_does_not_fit_leaves_the_old_one(tmp_path, suffix):
    cone = build_mesh(catalog()["cone"])
    taken = simulate_recording(cone, "cone", preset("pmd-16x16"), Views.broadcast(np.full(40, 1.0)), seed=1)
    path = tmp_path / f"recording{suffix}"
    path.write_text("old")

    def written_with_little_space() -> int:
        resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))
        try:
            write_recording(taken, path, force=True)
        except StorageError as error:
            return error.exit_code
        return 0

    assert in_fork(written_with_little_space) == 5
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {path.name: "old"}
