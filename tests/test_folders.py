"""Folders are whole or not there, and what is in them is ours or stays."""

import errno
import json
import os
import tempfile

import pytest
from builders import run_program

from phasemark import OutputExistsError, StorageError, UsageError
from phasemark.cli import main
from phasemark.data.files import renames
from phasemark.data.files.folder_marker import LOCK, MARKER, adding_to_folder, read_marker
from phasemark.data.files.replaced_folder import replacing_folder


def names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def write(path, mark, *, force=False):
    with replacing_folder(path, "test", force=force) as temporary:
        (temporary / "inner").mkdir()
        (temporary / "inner" / "deep").write_text(mark)
        (temporary / mark).write_text(mark)
    return path


def test_a_folder_carries_a_marker_that_lists_it_and_force_replaces_it_whole(tmp_path):
    folder = write(tmp_path / "out", "one")
    assert read_marker(folder) == (True, {"one", "inner/", "inner/deep"})
    assert names(tmp_path) == ["out", f"out/{MARKER}", "out/inner", "out/inner/deep", "out/one"]
    with pytest.raises(OutputExistsError, match="exists; use force=True"):
        write(folder, "two")
    write(folder, "two", force=True)
    assert names(tmp_path) == ["out", f"out/{MARKER}", "out/inner", "out/inner/deep", "out/two"]


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize(
    "content",
    [
        {},
        {"photo.jpg": "mine"},
        {"a/b.txt": "mine"},
        *({MARKER: text} for text in ("", "{}", "[]")),
        {MARKER: '{"format": "phasemark-folder", "schema_version": 2, "entries": []}'},
    ],
)
def test_a_folder_without_a_marker_of_ours_is_never_replaced(tmp_path, force, content):
    folder = tmp_path / "mine"
    folder.mkdir()
    for name, text in content.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    before = names(tmp_path)
    with pytest.raises(OutputExistsError, match="was not written by phasemark"):
        write(folder, "one", force=force)
    assert names(tmp_path) == before


@pytest.mark.parametrize("foreign", ["notes.txt", "inner/notes.txt", "empty/", "link"])
def test_a_foreign_entry_in_a_folder_of_ours_stays(tmp_path, foreign):
    folder = write(tmp_path / "out", "one")
    if foreign == "link":
        (folder / foreign).symlink_to(tmp_path)
    elif foreign.endswith("/"):
        (folder / foreign).mkdir()
    else:
        (folder / foreign).write_text("mine")
    before = names(folder)
    with pytest.raises(OutputExistsError, match=f"holds '{foreign}', which phasemark did not write"):
        write(folder, "two", force=True)
    assert names(folder) == before


def test_names_in_a_marker_are_not_followed(tmp_path):
    (tmp_path / "victim").write_text("mine")
    folder = tmp_path / "out"
    folder.mkdir()
    table = {"format": "phasemark-folder", "schema_version": 1, "content": "x", "entries": ["../victim"]}
    (folder / MARKER).write_text(json.dumps(table))
    write(folder, "one", force=True)
    assert (tmp_path / "victim").read_text() == "mine"


def write_half(folder, error):
    with replacing_folder(folder, "test", force=True) as temporary:
        (temporary / "half").write_text("x")
        raise error


def test_an_error_or_interrupt_leaves_the_old_folder_and_nothing_else(tmp_path):
    folder = write(tmp_path / "out", "one")
    before = names(tmp_path)
    for error, expected in ((OSError(errno.ENOSPC, "full"), StorageError), (KeyboardInterrupt(), KeyboardInterrupt)):
        with pytest.raises(expected):
            write_half(folder, error)
        assert names(tmp_path) == before


def test_every_file_and_folder_is_on_disk_before_the_name_and_the_name_after(tmp_path, monkeypatch):
    events: list[int | str] = []
    fsync, rename = os.fsync, renames.rename_new
    monkeypatch.setattr(os, "fsync", lambda fd: events.append(os.fstat(fd).st_ino) or fsync(fd))
    monkeypatch.setattr(renames, "rename_new", lambda a, b: events.append("rename") or rename(a, b))
    folder = write(tmp_path / "out", "one")
    at = events.index("rename")
    inodes = {path.stat().st_ino for path in (folder, *folder.rglob("*"))}
    assert inodes <= set(events[:at])
    assert events[at + 1 :] == [tmp_path.stat().st_ino]


@pytest.mark.parametrize("in_one_step", [True, False])
def test_a_link_to_a_folder_is_followed_and_its_permissions_are_kept(tmp_path, monkeypatch, in_one_step):
    if not in_one_step:
        monkeypatch.setattr(renames, "_renameat2", lambda source, target, flags: False)
    real = write(tmp_path / "real", "one")
    real.chmod(0o750)
    link = tmp_path / "link"
    link.symlink_to("real")
    write(link, "two", force=True)
    assert link.is_symlink()
    assert real.stat().st_mode & 0o777 == 0o750
    assert names(real) == [MARKER, "inner", "inner/deep", "two"]
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["link", "real"]


def test_two_writers_of_one_folder_do_not_meet(tmp_path):
    folder = tmp_path / "out"
    with replacing_folder(folder, "test") as temporary:
        (temporary / "one").write_text("x")
        with pytest.raises(OutputExistsError, match="another run is writing it"):
            write(folder, "two", force=True)
    assert (folder / "one").exists()
    write(folder, "two", force=True)
    assert names(tmp_path) == ["out", f"out/{MARKER}", "out/inner", "out/inner/deep", "out/two"]


def test_a_file_in_the_way_of_a_folder_is_a_usage_error(tmp_path):
    (tmp_path / "file").write_text("x")
    for path in (tmp_path / "file", tmp_path / "none" / "out"):
        with pytest.raises(UsageError):
            write(path, "one", force=True)


def test_a_hidden_folder_of_somebody_else_under_our_temporary_name_stays(tmp_path):
    mine = tmp_path / ".out.partial"
    mine.mkdir()
    (mine / "photo.jpg").write_text("mine")
    with pytest.raises(OutputExistsError, match="move it away"):
        write(tmp_path / "out", "one")
    assert names(tmp_path) == [".out.partial", ".out.partial/photo.jpg"]


def test_a_command_that_fails_before_it_writes_leaves_no_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    too_many = str(10**17)
    assert main(["sensor", "characterise", "ideal", "--frames", too_many, "-o", "new/out"]) == 2
    assert names(tmp_path) == []
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "notes.txt").write_text("mine")

    def fail(folder, *written):
        with adding_to_folder(tmp_path / folder, "test") as ours:
            ours.claim("a", "b")
            for name in written:
                (tmp_path / folder / name).write_text("x")
            raise ZeroDivisionError

    for folder in ("old", "old/sub/out"):
        with pytest.raises(ZeroDivisionError):
            fail(folder)
    assert names(tmp_path) == ["old", "old/notes.txt"]
    with pytest.raises(ZeroDivisionError):
        fail("new", "a")
    assert read_marker(tmp_path / "new") == (True, {"a", "b"})
    assert (tmp_path / "new" / "a").exists()


def test_files_of_a_shared_folder_are_claimed_and_cleared_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with adding_to_folder(tmp_path, "test") as ours:
        ours.claim("a", "sub/b")
        (tmp_path / "sub").mkdir()
        for name in ("a", "sub/b", "sub/mine"):
            (tmp_path / name).write_text("x")
        with pytest.raises(OutputExistsError, match=r"notes\.txt: exists and was not written by"):
            ours.claim("notes.txt")
        with pytest.raises(OutputExistsError, match="another run"), adding_to_folder(tmp_path, "test"):
            pass
        assert (tmp_path / LOCK).exists()
    with adding_to_folder(tmp_path, "test") as ours:
        assert ours.names == {"a", "sub/b"}
        ours.clear()
    assert names(tmp_path) == [MARKER, "notes.txt", "sub", "sub/mine"]


@pytest.mark.parametrize(
    ("action", "in_one_step"),
    [
        ("kill", "exchange"), ("kill", "two-renames"), ("ENOSPC", "exchange"),
        *(pytest.param(*way, marks=pytest.mark.soak) for way in (
            ("ENOSPC", "two-renames"), ("EIO", "exchange"), ("EIO", "two-renames"), ("other", "exchange"),
            ("other", "two-renames"),
        )),
    ],
)  # fmt: skip
def test_a_folder_ended_at_any_call_to_the_system_is_the_old_or_the_new_one(action, in_one_step):
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        printed = run_program("folder_crash_points", folder, action, in_one_step)
    assert int(printed) > 30


@pytest.mark.parametrize(
    ("command", "name"),
    [
        (["demo"], "report.html"), (["drive"], "path.csv"),
        (["landmark", "design"], "pareto.csv"),
        (["sensor", "characterise", "pmd-16x16"], "points.csv"), (["sweep", "run", "paper"], "cells.csv"),
    ],
)  # fmt: skip
def test_commands_that_write_several_files_leave_those_of_somebody_else(tmp_path, capsys, command, name):
    (tmp_path / name).write_text("mine")
    assert main([*command, "--out", str(tmp_path), "--force"]) == 4
    assert (
        f"{name}: exists and was not written by 'phasemark {command[0].replace('demo', 'sweep')}"
        in capsys.readouterr().err
    )
    assert names(tmp_path) == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_a_command_that_writes_several_files_replaces_its_own_one_run_at_a_time(tmp_path, capsys):
    limits = "[sampling]\ndistances = 2\ndelta_step_deg = 15\n[search]\nboxes = 8\nuppers = 8\nstep_mm = 5\n"
    (tmp_path / "plan.toml").write_text(f"n_classes = 1\nsymmetry = 4\n{limits}")
    out = ["landmark", "design", str(tmp_path / "plan.toml"), "--confirm", "0", "--out", str(tmp_path / "out")]
    assert main(out) == 0
    (tmp_path / "out" / "notes.txt").write_text("mine")
    assert main(out) == 4
    assert main([*out, "--force"]) == 0
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"
    with adding_to_folder(tmp_path / "out", "test"):
        assert main([*out, "--force"]) == 4
    assert "another run is writing it" in capsys.readouterr().err
