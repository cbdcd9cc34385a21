"""Kill or fail a build at its k-th call to the system, for every k, and resume it; a program, run by test_shards.py.

usage: python -m programs.build_crash_points FOLDER kill|ENOSPC|EIO

Prints how many points there were. Each run is a fork of this process, which has a single thread.
"""

import signal
import sys
from pathlib import Path

from programs.system_calls import ended, in_fork
from programs.toy_job import ToyJob, check_toy_file

from phasemark.data.shards.build import build, manifest_path, partial_path
from phasemark.inputs import checksum_path, verify_checksum

CALLS = ("pwrite", "write", "fsync", "replace", "posix_fallocate", "ftruncate")


def fail_at(path: Path, at: int, action: str, force: bool) -> int:
    return ended(lambda: build(ToyJob(mark=1), path, workers=1, shard_items=3, force=force), at, action, CALLS)


def resume(path: Path) -> int:
    build(ToyJob(mark=1), path, workers=1, resume=True, force=True)
    check_toy_file(path)
    verify_checksum(path)
    return 0


def tidy(folder: Path) -> None:
    for entry in folder.iterdir():
        if entry.name not in ("reference", "reference.sha256", "old", "old.sha256"):
            entry.unlink()


def main(folder: Path, action: str) -> None:
    reference = folder / "reference"
    build(ToyJob(mark=1), reference)
    old_job = folder / "old"
    build(ToyJob(mark=0), old_job)
    points = 0
    for with_old in (False, True):
        for at in range(1, 1000):
            path = folder / f"{action}-{with_old}-{at}"
            if with_old:
                path.write_bytes(old_job.read_bytes())
                checksum_path(path).write_bytes(
                    checksum_path(old_job).read_bytes().replace(b"  old", b"  " + path.name.encode())
                )
            code = in_fork(fail_at, path, at, action, with_old)
            allowed = [reference.read_bytes()] + ([old_job.read_bytes()] if with_old else [])
            assert path.read_bytes() in allowed if path.exists() else not with_old, f"a partial file after call {at}"
            if action != "kill" and code == 5 and path.exists() and path.read_bytes() == old_job.read_bytes():
                verify_checksum(path)
            leftovers = {entry.name for entry in folder.iterdir() if entry.name.startswith((path.name + ".", "."))}
            expected = {p.name for p in (manifest_path(path), partial_path(path), checksum_path(path))}
            if action != "kill":
                assert leftovers - expected == set(), f"debris after call {at}: {leftovers - expected}"
            if code == 0:
                tidy(folder)
                break
            assert code in ((-signal.SIGKILL,) if action == "kill" else (5, 6)), f"exit code {code} at call {at}"
            points += 1
            assert in_fork(resume, path) == 0, f"cannot be resumed after call {at}"
            assert path.read_bytes() == reference.read_bytes()
            left = {entry.name for entry in folder.iterdir() if not entry.name.startswith(("reference", "old"))}
            assert left == {path.name, checksum_path(path).name}, f"debris after resuming from call {at}: {left}"
            tidy(folder)
    sys.stdout.write(f"{points}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
