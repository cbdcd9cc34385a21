"""Kill a small sweep at random moments and resume it, and run it on a Dask cluster; a program, run by the tests.

usage: python -m programs.sweep_random_kills FOLDER TRIALS RUNS SEED

A killed run is a fork of this process, which has all of the program loaded, and no threads left. Prints in how many
runs the kill came before any trial was safe, in the first round, after it, and after the end. The sweep on the cluster,
where Dask is installed, goes into FOLDER/dask.
"""

import os
import random
import signal
import sys
import threading
import time
from pathlib import Path

from programs.random_kills import code_of

from phasemark.matcher.sweep.plan import Method, SweepPlan
from phasemark.matcher.sweep.run import run_sweep

TABLES = ("trials.csv", "cells.csv")
"""Their last column is the time."""


def plan(trials: int) -> SweepPlan:
    """Return a sweep of two rounds."""
    return SweepPlan(
        name="ways", trials=trials, until_percent=1.0, max_trials=2 * trials, classes=["post"],
        bank_distance_m=(0.9, 1.1), axes={"distance_m": [0.95, 1.05], "n_frames": [3]}, stranger_trials=7,
        methods=[Method(name="nearest", method="nearest", bank_step=(0.02, 5.0))],
        strangers=[{"name": "bare-box", "box": {"length_m": 0.24, "width_m": 0.16, "height_m": 0.15}}],
    )  # fmt: skip


def tables(folder: Path) -> dict[str, list[str]]:
    """Return the tables of a sweep without the times."""
    return {name: [line.rsplit(",", 1)[0] for line in (folder / name).read_text().splitlines()] for name in TABLES}


def on_dask(sweep: SweepPlan, folder: Path) -> None:
    try:
        from distributed import LocalCluster
    except ImportError:
        return
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:  # type: ignore[no-untyped-call]
        run_sweep(sweep, folder, scheduler=cluster.scheduler_address)


def fork(sweep: SweepPlan, folder: Path) -> int:
    """Run the sweep in a child, going on with what it finds; return its process id."""
    child = os.fork()
    if child == 0:
        run_sweep(sweep, folder, workers=2, resume=True)
        os._exit(0)
    return child


def stage(folder: Path) -> int:
    """Return how far a sweep has come: 0 nothing is safe, 1 trials are, 2 the first round is, 3 the tables are."""
    first = folder / "trials-000.h5"
    if first.exists():
        return 3 if (folder / "sweep.json").exists() else 2
    manifest = folder / "trials-000.h5.manifest"
    return int(manifest.exists() and manifest.read_bytes().count(b"\n") > 1)


def kill_and_resume(sweep: SweepPlan, folder: Path, runs: int, seed: int) -> None:
    rng = random.Random(seed)
    run_sweep(sweep, folder / "warm", workers=2)
    expected = tables(folder / "warm")
    assert threading.active_count() == 1
    begun = time.monotonic()
    assert code_of(fork(sweep, folder / "timed")) == 0
    duration = time.monotonic() - begun
    counts = [0, 0, 0, 0]
    for run in range(runs):
        out = folder / str(run)
        child = fork(sweep, out)
        time.sleep(rng.uniform(0, 1.1 * duration))
        os.kill(child, signal.SIGKILL)
        assert code_of(child) in (0, -signal.SIGKILL)
        counts[stage(out)] += 1
        assert code_of(fork(sweep, out)) == 0, f"run {run}: cannot be resumed"
        assert tables(out) == expected, f"run {run}: other numbers"
        left = {path.name for path in out.iterdir()} - {path.name for path in (folder / "warm").iterdir()}
        # a table that was being written when the kill came lies beside it, under a name that nobody reads
        assert all(name.startswith(".") for name in left), f"run {run}: debris {left}"
    sys.stdout.write(f"{' '.join(map(str, counts))}\n")


def main(folder: Path, trials: int, runs: int, seed: int) -> None:
    kill_and_resume(plan(trials), folder, runs, seed)
    on_dask(plan(trials), folder / "dask")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
