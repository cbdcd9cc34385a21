"""Kill or fail a sweep at its k-th call to the system, and resume it; a program, run by the tests.

usage: python -m programs.sweep_crash_points FOLDER kill|ENOSPC|EIO STEP

k runs in steps of STEP, and of three times STEP with --force. A file of the user lies in the folder and stays. A second
run with --force, at every call that 7 times STEP divides, finds the lock. Each run is a fork of this process. The
trials are those of an uninterrupted sweep. Prints how many points there were.
"""

import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from programs.system_calls import Trap, in_fork

from phasemark import OutputExistsError, PhasemarkError, StorageError
from phasemark.matcher.sweep.plan import Method, SweepPlan
from phasemark.matcher.sweep.run import read_sweep, run_sweep

PLAN = SweepPlan(
    name="small", trials=4, classes=["cone"], axes={"distance_m": [1.0], "n_frames": [3]}, bank_distance_m=(0.9, 1.1),
    spread=(0.01, 5.0), methods=[Method(name="mine", method="own_matchers:nearest_to_mean")],
)  # fmt: skip
MINE = "trials-001.h5.my-backup"


def fail_at(folder: Path, at: int, action: str, options: dict[str, Any]) -> int:
    trap = Trap(at, action)
    try:
        run_sweep(PLAN, folder, workers=1, **options)
    except PhasemarkError as error:  # what cannot be read is a damaged input, or not known to be ours
        return error.exit_code
    except OSError:  # a table of the program itself, like a preset, cannot be read
        return StorageError.exit_code
    return 0 if trap.count < at else 6


def finish(folder: Path, options: dict[str, Any]) -> int:
    try:
        run_sweep(PLAN, folder, workers=1, **options)
    except OutputExistsError:
        return 4
    return 0


def main(folder: Path, action: str, step: int) -> None:
    run_sweep(PLAN, folder / "reference", workers=1)
    expected = read_sweep(folder / "reference")[1].estimate
    points = 0
    ways: tuple[dict[str, Any], ...] = ({}, {"force": True})
    for options in ways:
        for at in range(1, 1000, 3 * step if options else step):
            path = folder / "sweep"
            path.mkdir()
            (path / MINE).write_text("mine")
            if options:
                run_sweep(PLAN, path, workers=1)
            code = in_fork(fail_at, path, at, action, options)
            where = f"{action} at call {at}, exit code {code}"
            assert (path / MINE).read_text() == "mine", where
            if code != 0:
                assert code in ((-signal.SIGKILL,) if action == "kill" else (3, 4, 5, 6)), where
                assert in_fork(finish, path, {"resume": True}) == 0, f"{where}: does not go on"
                points += 1
            np.testing.assert_array_equal(read_sweep(path)[1].estimate, expected, err_msg=where)
            shutil.rmtree(path)
            if code == 0:
                break
    second_runs(folder / "sweep", 7 * step)
    sys.stdout.write(f"{points}\n")


def second_runs(path: Path, step: int) -> None:
    """Have a second run with --force start during a first one, every few calls; the first ends as if it were alone."""
    for at in range(step, 1000, step):
        codes: list[int] = []

        def second(codes: list[int] = codes) -> None:
            codes.append(in_fork(finish, path, {"force": True}))

        code = in_fork(first, path, at, second)
        assert code in (0, 1), f"second run at call {at}: exit code {code}"
        shutil.rmtree(path)
        if code == 1:
            return


def first(path: Path, at: int, second: Callable[[], None]) -> int:
    trap = Trap(at, second)
    run_sweep(PLAN, path, workers=1)
    read_sweep(path)
    return int(trap.count < at)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
