"""The long fault tables of files and builds, run by `make soak`; short versions stand beside the code they test."""

import os
import random
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from builders import HELPERS_IN_PATH, run_program
from programs.toy_job import ToyJob, check_toy_file

from phasemark import InputFileError, StorageError
from phasemark.data.shards.build import build, manifest_path, partial_path
from phasemark.landmarks import build_mesh, catalog, export_mesh, read_mesh
from phasemark.render import Renderer, preset

pytestmark = pytest.mark.soak
PROGRAM = """
import sys
from phasemark import cli
from phasemark.data.shards.build import build
from programs.toy_job import ToyJob
cli._run = lambda arguments: build(ToyJob(items=(400, 3), seconds=0.02), arguments[0], workers=2, shard_items=1)
sys.exit(cli.main(sys.argv[1:]))
"""


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def test_fifty_interruptions_exit_with_their_code_and_can_be_resumed(tmp_path):
    rng = random.Random(4)
    for k in range(50):
        folder = tmp_path / str(k)
        folder.mkdir()
        path = folder / "toy"
        number, code = ((signal.SIGINT, 130), (signal.SIGTERM, 143))[k % 2]
        child = subprocess.Popen([sys.executable, "-c", PROGRAM, path], env=HELPERS_IN_PATH, stderr=subprocess.PIPE)
        end = time.monotonic() + 30
        while not manifest_path(path).exists() and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 2.0))
        child.send_signal(number)
        child.communicate(timeout=30)
        assert child.returncode == code
        assert not path.exists()
        build(ToyJob(items=(400, 3)), path, resume=True)
        check_toy_file(path, (400, 3))
        assert names(folder) == ["toy", "toy.sha256"]


@pytest.mark.parametrize("size_kb", [4, 64, 128, 256, 400, 512, 640, 720, 760, 780])
def test_a_full_disk_of_ten_sizes_is_an_error_without_debris(tmp_path, size_kb):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size_kb}k", "tmpfs", disk]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small disk needs privileges")
    try:
        path = disk / "toy"
        with pytest.raises(StorageError, match="No space left"):
            build(ToyJob(), path)
        assert names(disk) == []
        subprocess.run(["mount", "-o", "remount,size=2m", disk], check=True)
        build(ToyJob(), path, resume=True)
        check_toy_file(path)
    finally:
        subprocess.run(["umount", disk], check=True)


def test_every_command_that_writes_survives_disks_of_ten_sizes(tmp_path):
    (tmp_path / "disk").mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", tmp_path / "disk"]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small disk needs privileges")
    try:
        print(run_program("full_disks", tmp_path))
    finally:
        subprocess.run(["umount", tmp_path / "disk"], check=True)


@pytest.mark.parametrize("spare_kb", [0, 2000])
def test_a_disk_that_fills_while_a_file_is_made_ends_the_run_or_leaves_it_alone(tmp_path, spare_kb):
    """The space is claimed at the start, so only manifest and checksum can still fail."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", disk]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small disk needs privileges")
    try:
        path = disk / "toy"

        def fill(done, total):
            if done == 1:
                free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
                (disk / "filler").write_bytes(bytes(max(0, free - 1024 * spare_kb)))

        try:
            build(ToyJob(), path, workers=1, shard_items=1, progress=fill)
        except StorageError:
            (disk / "filler").unlink()
            build(ToyJob(), path, resume=True)
        check_toy_file(path)
    finally:
        subprocess.run(["umount", disk], check=True)


def test_a_thousand_opens_during_publications_see_the_old_file_or_the_new_one(tmp_path):
    path = tmp_path / "toy"
    build(ToyJob(mark=0), path)
    build(ToyJob(mark=1), tmp_path / "new")
    contents = {path.read_bytes(), (tmp_path / "new").read_bytes()}
    seen, ended = [], threading.Event()

    def read():
        while not ended.is_set():
            seen.append(path.read_bytes() in contents)

    readers = [threading.Thread(target=read) for _ in range(8)]
    for reader in readers:
        reader.start()
    turn = 0
    while len(seen) < 1000 or turn < 10:
        turn += 1
        build(ToyJob(mark=turn % 2), path, force=True)
    ended.set()
    for reader in readers:
        reader.join()
    assert len(seen) >= 1000
    assert all(seen)


def test_two_builders_on_one_output_end_with_one_winner(tmp_path):
    command = [sys.executable, "-c", PROGRAM]
    for k in range(5):
        path = tmp_path / f"toy{k}"
        environment = HELPERS_IN_PATH
        both = [subprocess.Popen([*command, path], env=environment, stderr=subprocess.PIPE) for _ in range(2)]
        codes = sorted((child.communicate(timeout=60), child.returncode)[1] for child in both)
        assert codes == [0, 4]
        check_toy_file(path, (400, 3))
        assert not partial_path(path).exists()


@pytest.mark.filterwarnings("ignore::phasemark.landmarks.mesh_files.MeshWarning")
def test_six_thousand_mutated_meshes_are_a_valid_mesh_or_one_error(tmp_path):
    rng = np.random.default_rng(9)
    mesh = build_mesh(catalog()["post"])
    contents = {kind: export_mesh(mesh, kind) for kind in ("stl", "ply", "obj", "off")}
    read = 0
    for k in range(6000):
        kind = ("stl", "ply", "obj", "off")[k % 4]
        data = bytearray(contents[kind])
        for _ in range(int(rng.integers(1, 5))):
            at = int(rng.integers(min(len(data), 400))) if rng.random() < 0.5 else int(rng.integers(len(data)))
            change = rng.integers(4)
            if change == 0:
                data[at] ^= 1 << int(rng.integers(8))
            elif change == 1:
                data[at : at + 4] = rng.bytes(4)
            elif change == 2:
                data[at : at + 6] = b"999999"
            else:
                del data[at : at + int(rng.integers(1, 400))]
        try:
            found = read_mesh(bytes(data), unit="m", file_type=kind)
        except InputFileError:  # any other exception fails the test
            continue
        read += 1
        assert len(found.faces) > 0
        assert np.isfinite(found.vertices).all()
        if k % 50 == 0 and found.extents.max() < 1:
            image = Renderer(found, preset("pmd-16x16")).render(2.0)
            assert image.coverage.max() > 0
    assert read > 0
