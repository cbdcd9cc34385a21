"""Large files are built in shards: whole or not there, continued after any end, the same bytes however made."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time

import numpy as np
import pytest
from builders import HELPERS_IN_PATH, run_program
from programs.toy_job import ToyJob, check_toy_file

from phasemark import OutputExistsError, StorageError, UsageError
from phasemark.data.shards.build import build, difference, manifest_path, partial_path
from phasemark.data.shards.remote import open_maker
from phasemark.inputs import checksum_path, verify_checksum


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


@pytest.fixture
def disk(tmp_path):
    """A function that makes a small disk, or changes its size, and returns its folder."""
    folder = tmp_path / "disk"

    def sized(size, remount=False):
        folder.mkdir(exist_ok=True)
        options = f"{'remount,' if remount else ''}size={size}"
        mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=False)
        if mounted.returncode:
            pytest.skip("mounting a small disk needs privileges")
        return folder

    yield sized
    subprocess.run(["umount", folder], stderr=subprocess.DEVNULL, check=False)


class Stop(Exception):
    pass


def stop_after(items):
    """A progress function that ends the run when a number of items are done."""

    def progress(done, total):
        if done >= items:
            raise Stop

    return progress


@pytest.fixture
def unfinished(tmp_path):
    path = tmp_path / "toy"
    with pytest.raises(Stop):
        build(ToyJob(), path, workers=1, shard_items=1, progress=stop_after(4))
    return path


@pytest.mark.parametrize("workers", [1, 2, 3, 8])
@pytest.mark.parametrize("shard_items", [1, 7, 64])
def test_the_bytes_depend_on_neither_workers_nor_shards(tmp_path, workers, shard_items):
    build(ToyJob(), tmp_path / "one", workers=1)
    build(ToyJob(), tmp_path / "other", workers=workers, shard_items=shard_items)
    check_toy_file(tmp_path / "other")
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()
    assert names(tmp_path) == ["one", "one.sha256", "other", "other.sha256"]


def test_an_unfinished_run_is_beside_the_file_and_not_under_its_name(unfinished):
    assert names(unfinished.parent) == ["toy.manifest", "toy.partial"]


def test_resuming_makes_only_what_is_missing(unfinished):
    made = []

    class Watched(ToyJob):
        def make(self, slab, start, stop):
            made.append((slab, start, stop))
            return super().make(slab, start, stop)

    build(Watched(), unfinished, resume=True)
    check_toy_file(unfinished)
    # writing the header again spoils the shard that shares its 64 kB page, and no other
    assert 4 <= len(made) <= 6
    assert names(unfinished.parent) == ["toy", "toy.sha256"]


def test_a_shard_that_rotted_since_is_made_again(unfinished):
    with partial_path(unfinished).open("r+b") as file:
        file.seek(-150_000, os.SEEK_END)
        file.write(b"rot")
        file.seek(250_000)
        file.write(b"rot")
    build(ToyJob(), unfinished, resume=True)
    check_toy_file(unfinished)


@pytest.mark.parametrize("damage", ["", "garbage", '{"format": "other"}\n'])
def test_a_manifest_that_is_not_ours_is_refused_until_it_is_moved_away(unfinished, damage):
    manifest_path(unfinished).write_text(damage)
    with pytest.raises(OutputExistsError, match=r"toy\.manifest: exists and is not of an unfinished run"):
        build(ToyJob(), unfinished, resume=True, force=True)
    assert manifest_path(unfinished).read_text() == damage
    manifest_path(unfinished).unlink()
    with pytest.raises(OutputExistsError, match=r"toy\.partial: exists and is not of an unfinished run"):
        build(ToyJob(), unfinished, force=True)
    partial_path(unfinished).unlink()
    build(ToyJob(), unfinished)
    check_toy_file(unfinished)


@pytest.mark.parametrize("damage", ["cut", "half a line"])
def test_a_damaged_manifest_costs_work_but_nothing_else(unfinished, damage):
    manifest = manifest_path(unfinished)
    text = manifest.read_bytes()
    changed = {"cut": text[:-20], "half a line": text + b'{"shard": 7, "sh'}
    manifest.write_bytes(changed[damage])
    build(ToyJob(), unfinished, resume=True, force=True)
    check_toy_file(unfinished)


def test_a_run_of_another_plan_is_not_continued_and_the_difference_named(unfinished):
    with pytest.raises(OutputExistsError, match=r"another plan \(plan\.mark: 0 → 1\)"):
        build(ToyJob(mark=1), unfinished, resume=True)
    build(ToyJob(), unfinished, resume=True)
    check_toy_file(unfinished)


def test_an_unfinished_run_that_replaces_a_file_goes_on_by_both_options(unfinished):
    unfinished.write_text("what was there before")
    with pytest.raises(OutputExistsError, match="stands beside the unfinished run that replaces it: give force=True"):
        build(ToyJob(), unfinished, resume=True)
    build(ToyJob(), unfinished, resume=True, force=True)
    check_toy_file(unfinished)


def test_an_unfinished_run_is_not_thrown_away_unasked(unfinished):
    with pytest.raises(OutputExistsError, match="resume=True continues it, force=True starts over"):
        build(ToyJob(), unfinished)
    build(ToyJob(), unfinished, force=True)
    check_toy_file(unfinished)


def test_a_run_that_finished_nothing_leaves_nothing(tmp_path):
    class Broken(ToyJob):
        def make(self, slab, start, stop):
            raise UsageError("no")

    with pytest.raises(UsageError, match="no"):
        build(Broken(), tmp_path / "toy")
    assert names(tmp_path) == []


def test_a_second_run_on_one_output_is_refused_while_the_first_goes_on(tmp_path):
    path = tmp_path / "toy"
    begun, refused = threading.Event(), []

    def progress(done, total):
        begun.set()

    first = threading.Thread(
        target=build, args=(ToyJob(seconds=0.1), path), kwargs={"workers": 1, "shard_items": 1, "progress": progress}
    )
    first.start()
    begun.wait()
    for resume in (False, True):
        with pytest.raises(OutputExistsError, match=r"unfinished run|another run is writing it") as error:
            build(ToyJob(), path, resume=resume)
        refused.append(str(error.value))
    first.join()
    assert "another run is writing it" in refused[1]
    check_toy_file(path)
    assert names(tmp_path) == ["toy", "toy.sha256"]


@pytest.mark.parametrize("n", [10, pytest.param(1000, marks=pytest.mark.soak)])
def test_readers_see_the_old_file_or_the_new_one(tmp_path, n):
    path = tmp_path / "toy"
    build(ToyJob(mark=0), path)
    contents = {path.read_bytes()}
    build(ToyJob(mark=1), tmp_path / "new")
    contents.add((tmp_path / "new").read_bytes())
    ended, seen = threading.Event(), []

    def read():
        while not ended.is_set():
            seen.append(path.read_bytes() in contents)

    readers = [threading.Thread(target=read) for _ in range(4)]
    for reader in readers:
        reader.start()
    turn = 0
    while len(seen) <= n or turn < 4:
        turn += 1
        build(ToyJob(mark=turn % 2), path, force=True)
    ended.set()
    for reader in readers:
        reader.join()
    assert all(seen)


@pytest.mark.parametrize("action", ["kill", "ENOSPC", pytest.param("EIO", marks=pytest.mark.soak)])
def test_a_build_ended_at_any_call_to_the_system_leaves_old_or_new_and_resumes(action):
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # hundreds of fsyncs take a minute on a disk
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        printed = run_program("build_crash_points", folder, action)
    # two rounds, without and with an old file: layout, manifest, three shards, commit, hash, publication
    assert int(printed) > 30


INTERRUPTED = """
import sys
from phasemark import cli
from phasemark.data.shards.build import build
from programs.toy_job import ToyJob
cli._run = lambda arguments: build(ToyJob(items=(400, 3), seconds=0.02), arguments[0], workers=2, shard_items=1)
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.parametrize("n", [1, pytest.param(25, marks=pytest.mark.soak)])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_command_exits_with_its_code_and_can_be_resumed(tmp_path, number, code, n):
    moments = np.random.default_rng(4).uniform(0, 2, n - 1)
    for wait_s in (0.0, *moments):
        path = tmp_path / "toy"
        with subprocess.Popen(
            [sys.executable, "-c", INTERRUPTED, path], env=HELPERS_IN_PATH, stderr=subprocess.PIPE
        ) as child:
            wait_for_a_shard(path)
            time.sleep(wait_s)
            child.send_signal(number)
            child.communicate(timeout=20)
        assert child.returncode == code
        assert names(tmp_path) == ["toy.manifest", "toy.partial"]
        build(ToyJob(items=(400, 3)), path, resume=True)
        check_toy_file(path, (400, 3))
        assert names(tmp_path) == ["toy", "toy.sha256"]
        path.unlink()
        checksum_path(path).unlink()


def wait_for_a_shard(path, seconds=20.0):
    end = time.monotonic() + seconds
    while not manifest_path(path).exists() or manifest_path(path).read_bytes().count(b"\n") < 2:
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.02)


SOAKED_KB = [pytest.param(size, marks=pytest.mark.soak) for size in (4, 128, 400, 512, 640, 720, 760, 780)]


@pytest.mark.parametrize("size_kb", [64, 256, 700, 900, *SOAKED_KB])
def test_a_full_disk_is_an_error_and_the_run_resumes_when_there_is_room(disk, size_kb):
    path = disk(f"{size_kb}k") / "toy"
    if size_kb < 800:  # the file has 800 kB
        with pytest.raises(StorageError, match="No space left"):
            build(ToyJob(), path)
        assert names(path.parent) == []
        disk("2m", remount=True)
    build(ToyJob(), path, resume=True)
    check_toy_file(path)


@pytest.mark.soak
@pytest.mark.parametrize("spare_kb", [0, 2000])
def test_a_disk_that_fills_while_a_file_is_made_ends_the_run_or_leaves_it_alone(disk, spare_kb):
    """The space is claimed at the start, so only manifest and checksum can still fail."""
    path = disk("3m") / "toy"
    filler = path.with_name("filler")

    def fill(done, total):
        if done == 1:
            free = shutil.disk_usage(path.parent).free
            filler.write_bytes(bytes(max(0, free - 1024 * spare_kb)))

    try:
        build(ToyJob(), path, workers=1, shard_items=1, progress=fill)
    except StorageError:
        filler.unlink()
        build(ToyJob(), path, resume=True)
    check_toy_file(path)


@pytest.mark.soak
def test_every_command_that_writes_survives_disks_of_ten_sizes(tmp_path, disk):
    disk("64m")
    print(run_program("full_disks", tmp_path))


def test_differences_are_named_by_key():
    old = {"plan": {"a": 1, "b": [{"c": 2}], "gone": None}, "versions": {"numpy": "1"}}
    new = {"plan": {"a": 1, "b": [{"c": 3}]}, "versions": {"numpy": "2"}}
    assert difference(old, new) == ["plan.b[0].c: 2 → 3", 'versions.numpy: "1" → "2"']


@pytest.mark.parametrize("scheduler", ["local:2", "processes", "dask"])
def test_an_unknown_scheduler_is_named(scheduler):
    with pytest.raises(UsageError, match="scheduler="):
        open_maker(scheduler, ToyJob())


@pytest.mark.parametrize("options", [{}, {"force": True}, {"resume": True}])
@pytest.mark.parametrize("name", [manifest_path, partial_path])
def test_a_file_of_somebody_else_under_the_name_of_an_unfinished_run_stays(tmp_path, name, options):
    theirs = name(tmp_path / "toy")
    theirs.write_text("mine")
    with pytest.raises(OutputExistsError, match="is not of an unfinished run"):
        build(ToyJob(), tmp_path / "toy", **options)
    assert theirs.read_text() == "mine"
    assert names(tmp_path) == [theirs.name]


def test_a_file_built_through_a_link_lies_where_the_link_leads_and_keeps_its_permissions(tmp_path):
    (tmp_path / "real").mkdir()
    path = build(ToyJob(mark=0), tmp_path / "real" / "toy")
    path.chmod(0o600)
    link = tmp_path / "link"
    link.symlink_to("real/toy")
    build(ToyJob(mark=1), link, force=True)
    check_toy_file(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert verify_checksum(link) == verify_checksum(path)
    assert names(tmp_path) == ["link", "real"]
    assert names(tmp_path / "real") == ["toy", "toy.sha256"]
