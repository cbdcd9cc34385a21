"""Kill `phasemark frames build` at random moments and resume it; a program, run by the tests.

usage: python -m programs.random_kills FOLDER VIEWS RUNS SEED

Each run is a fork of this process, which has all of the program loaded, and no threads left.
Prints in how many runs the kill came before, during and after the file was made.
"""

import os
import random
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from phasemark.cli import main as phasemark
from phasemark.data.shards.build import partial_path

PLAN = 'views = {views}\nframes_per_view = 2\nseed = 7\nwall_m = 4.0\nclasses = ["cone", "post"]\n'


def fork(*arguments: object) -> int:
    """Run the command line in a child, which ends as a program does; return its process id."""
    child = os.fork()
    if child == 0:
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        sys.exit(phasemark([str(argument) for argument in arguments]))
    return child


def warm(arguments: Sequence[object]) -> None:
    """Run the command line here, so that the children have all that it loads."""
    assert phasemark([str(argument) for argument in arguments]) == 0
    assert threading.active_count() == 1


def code_of(child: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def main(folder: Path, views: int, runs: int, seed: int) -> None:
    rng = random.Random(seed)
    plan, reference, out = (folder / name for name in ("plan.toml", "reference.h5", "frames.h5"))
    plan.write_text(PLAN.format(views=views))

    def build(path: Path) -> int:
        return fork("frames", "build", plan, "-o", path, "--resume", "--shard-size", "20")

    warm(["frames", "build", plan, "-o", folder / "warm.h5"])
    begun = time.monotonic()
    assert code_of(build(reference)) == 0
    duration = time.monotonic() - begun
    expected = reference.read_bytes()
    counts = {"before": 0, "during": 0, "after": 0}
    for run in range(runs):
        child = build(out)
        time.sleep(rng.uniform(0, 1.1 * duration))
        os.kill(child, signal.SIGKILL)
        code = code_of(child)
        assert code in (0, -signal.SIGKILL), f"run {run}: exit code {code}"
        assert not out.exists() or out.read_bytes() == expected, f"run {run}: a partial file under the final name"
        counts["during" if partial_path(out).exists() else "after" if out.exists() else "before"] += 1
        assert code_of(build(out)) == 0, f"run {run}: cannot be resumed"
        assert out.read_bytes() == expected, f"run {run}: other bytes"
        left = sorted(entry.name for entry in folder.glob("*frames.h5*"))
        assert left == ["frames.h5", "frames.h5.sha256"], f"run {run}: debris {left}"
        for entry in folder.glob("frames.h5*"):
            entry.unlink()
    sys.stdout.write(f"{counts['before']} {counts['during']} {counts['after']}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
