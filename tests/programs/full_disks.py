"""Run every command that writes on disks of ten sizes that are too small for it; a program, run by the tests.

usage: python -m programs.full_disks FOLDER

FOLDER/disk must be a tmpfs that this process may remount. Each command runs once in this process, and then in forks of
it, which have nothing to load and end as a program does. Prints for each command how many runs found the disk full.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from programs.random_kills import code_of, fork, warm

PLAN = 'views = 60\nframes_per_view = 2\nseed = 7\nwall_m = 4.0\nclasses = ["cone", "post"]\n'
SHARES = (0.005, 0.02, 0.1, 0.25, 0.4, 0.55, 0.7, 0.85, 0.95, 0.99)
"""Sizes of the disk, over what the command needs."""
PAGE = 4096
LARGE = "64m"


def commands(folder: Path) -> Iterator[tuple[str, list[object], bool]]:
    """Return name, arguments and whether the command can be resumed, of every command that writes."""
    plan, frames, out = folder / "plan.toml", folder / "frames.h5", folder / "disk" / "out"
    build: list[object] = ["frames", "build", plan, "--shard-size", "7"]
    yield "frames build", [*build, "-o", out], True
    yield "frames build --shard", [*build, "--shard", "1/2", "-o", out], True
    yield "frames merge", ["frames", "merge", folder / "part1", folder / "part2", "-o", out], True
    grid = ["--class", "cone", "--distance", "0.9:1:0.02", "--delta", "0:180:10"]
    yield "bank build", ["bank", "build", *grid, "-o", out], True
    for to in ("npz", "csv", "png16", "ply", "bop", "rosbag"):
        yield f"export {to}", ["frames", "export", frames, "--to", to, "-o", out], False
    yield "import", ["frames", "import", folder / "frames.npz", "-o", f"{out}.npz"], False
    yield "show", ["frames", "show", frames, "-o", f"{out}.png"], False


def resize(disk: Path, size: int | str) -> None:
    subprocess.run(["mount", "-o", f"remount,size={size}", disk], check=True)


def used_bytes(disk: Path) -> int:
    state = os.statvfs(disk)
    return (state.f_blocks - state.f_bfree) * state.f_frsize


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files, by name. A bag's database has the time in it, and ZIP files too."""
    found = {str(path.relative_to(folder)): path for path in sorted(folder.rglob("*")) if path.is_file()}
    return {name: b"" if path.suffix in (".db3", ".npz") else path.read_bytes() for name, path in found.items()}


def clear(disk: Path) -> None:
    for entry in disk.iterdir():
        shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


def main(folder: Path) -> None:
    disk = folder / "disk"
    (folder / "plan.toml").write_text(PLAN)
    for arguments in (
        ["-o", folder / "frames.h5"], ["--shard", "1/2", "-o", folder / "part1"],
        ["--shard", "2/2", "-o", folder / "part2"],
    ):  # fmt: skip
        warm(["frames", "build", folder / "plan.toml", *arguments])
    warm(["frames", "export", folder / "frames.h5", "--to", "npz", "-o", folder / "frames.npz"])
    for name, arguments, resumable in commands(folder):
        resize(disk, LARGE)
        warm(arguments)
        expected, needed = contents(disk), used_bytes(disk)
        clear(disk)
        full = 0
        for share in SHARES:
            size = max(PAGE, int(share * needed) // PAGE * PAGE)
            resize(disk, size)
            code = code_of(fork(*arguments))
            where = f"{name} on {size} of {needed} bytes"
            assert code in (0, 5), f"{where}: exit code {code}"
            full += code == 5
            left = sorted(entry.name for entry in disk.iterdir())
            allowed = {"out.partial", "out.manifest"} if resumable else set()
            assert code == 0 or set(left) <= allowed, f"{where}: leaves {left}"
            resize(disk, LARGE)
            code = code_of(fork(*arguments, "--resume" if resumable else "--force"))
            assert code == 0, f"{where}: exit code {code} once there is room"
            assert contents(disk) == expected, f"{where}: other bytes once there is room"
            clear(disk)
        print(f"{name}: {full} of {len(SHARES)}", flush=True)
        assert full >= len(SHARES) - 2, f"{name}: the disks were not too small"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
