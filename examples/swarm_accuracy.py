"""Measure the accuracy on a copy of the nano-drone swarm's recordings, beside what its authors state.

``python examples/swarm_accuracy.py FOLDER --out out/swarm``
``python examples/swarm_accuracy.py FOLDER --calibrate-on OTHER --out out/swarm``

FOLDER holds runs as ``docs/locate.md`` describes recordings, one .npz each, with motion capture (`vicon_x_m`, `_y_m`,
`_yaw_rad`, `_pitch_rad`, `_roll_rad`) and the authors' own SLAM (`slam_x_m` ...), and ``maps.toml`` with the walls of
each run. The data are those of Friess et al., Fully Onboard SLAM for Distributed Mapping With a Swarm of Nano-Drones
(IEEE IoT Journal 2024), GPL-3.0; none of them come with phasemark.

The rig of a run is calibrated on the other runs of FOLDER, or on those of OTHER. Stops at which the motion capture is
doubtful by attitude and gyro are not scored. "About the bias": less the median error of each drone in each run, for its
marker frame was defined again each time. Written are ``accuracy.md``, ``accuracy.csv``, ``poses.png``, the rig of each
run, and the poses of each row as ``phasemark locate`` writes them.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError, PhasemarkError
from phasemark.data.files.csv_cell import csv_text
from phasemark.inputs.toml_file import read_toml
from phasemark.matcher.locate import (
    LocatedPose,
    Locator,
    Rig,
    RigRecording,
    WallMap,
    calibrate_rig,
    read_rig_recording,
    smoothed,
)
from phasemark.matcher.locate.figures import locate_figure
from phasemark.matcher.locate.pose_table import pose_csv
from phasemark.matcher.locate.wall_map import cut_at_crossings
from phasemark.render.png import figure_png

Floats = NDArray[np.float64]
Row = Callable[["Run", Rig], list[LocatedPose]]

MAP = {"thickness_m": 0.02, "position_std_m": 0.006, "yaw_std_deg": 0.35}
"""Walls have some thickness, stand up to 40 mm from where they are drawn, and may be off by this part as a whole."""
NOMINAL = Rig(
    # as the firmware has it: a column is the median of rows 2 ... 5, sensors are 20 and 25 mm from the centre
    sensor=[
        {"name": "front", "x_m": 0.02},
        {"name": "back", "x_m": -0.02, "yaw_deg": 180.0},
        {"name": "left", "y_m": 0.025, "yaw_deg": 90.0},
        {"name": "right", "y_m": -0.025, "yaw_deg": -90.0},
    ],
    reduction={"rows": [2, 5]},
    odometry={"per_m": 0.1, "position_m": 0.05, "yaw_deg": 0.3},
)
NO_UNKNOWNS = {"drift_m_s": 0.0, "age_s": 0.0, "offset_m": 0.0, "yaw_deg": 0.0}
THIN = 0.1
"""Footprint of a column that is nearly a ray, in columns."""
VICON_STD = np.diag(np.square([0.002, 0.002, math.radians(0.15)]))
GROSS_M, GROSS_RAD = 0.1, math.radians(5.0)
CHI2_95 = 7.815
"""95 % of χ² with 3 degrees of freedom."""
SAME_M, SAME_RAD = 0.1, math.radians(8.0)
"""An alternative this near to the truth is the true one."""


@dataclass(frozen=True, eq=False)
class Run:
    """A run: its recording, its map, the motion capture and which of its stops are scored, the authors' SLAM."""

    name: str
    recording: RigRecording
    wall_map: WallMap
    truth: Floats
    scored: NDArray[np.bool_]
    slam: Floats


def read_runs(folder: Path) -> list[Run]:
    """Read the runs of a folder."""
    maps = read_toml(folder / "maps.toml")
    by_name = {}
    for name, table in maps["maps"].items():
        walls, _ = cut_at_crossings(np.array(table["walls_m"], np.float64))
        by_name[name] = WallMap(walls_m=walls.tolist(), **MAP)
    runs = []
    for path in sorted(folder.glob("*.npz")):
        recording = read_rig_recording(path, NOMINAL)
        with np.load(path, allow_pickle=False) as arrays:
            truth, slam = (
                np.column_stack([arrays[f"{whose}_{name}"] for name in ("x_m", "y_m", "yaw_rad")])
                for whose in ("vicon", "slam")
            )
            scored = ~suspect(arrays, recording.robot)
        name = maps.get("runs", {}).get(recording.run, recording.map_name)
        if name not in by_name:
            raise InputFileError(f"{folder / 'maps.toml'}: no map for the run '{recording.run}'")
        runs.append(Run(recording.run, recording, by_name[name], truth, scored, slam))
    if not runs:
        raise InputFileError(f"{folder}: holds no .npz")
    return runs


def suspect(arrays: np.lib.npyio.NpzFile, robot: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return at which stops the motion capture is doubtful: tilts by 2.5°, or turns by 1.2° against the gyro."""
    bad = np.zeros(len(robot), bool)
    for own in (np.flatnonzero(robot == k) for k in np.unique(robot)):
        for tilt in ("vicon_pitch_rad", "vicon_roll_rad"):
            off = np.degrees(arrays[tilt][own])
            bad[own] |= abs(off - np.median(off)) > 2.5
        turn = np.degrees(wrapped(arrays["vicon_yaw_rad"] - arrays["odometry_yaw_rad"]))[own]
        for j in range(len(own)):
            around = [turn[q] for q in range(max(j - 2, 0), min(j + 3, len(own))) if q != j]
            bad[own[j]] |= len(around) > 0 and abs(turn[j] - np.median(around)) > 1.2
    return bad


def wrapped(angle: Floats) -> Floats:
    """Return angles in [−π, π)."""
    return (angle + math.pi) % math.tau - math.pi


def starts(run: Run, position_m: float, yaw_deg: float) -> tuple[Floats, Floats]:
    """Return starts that are off by up to so much, evenly spread, and their standard deviations."""
    rng = np.random.default_rng(sum(map(ord, run.name)))
    reach = np.array([position_m, position_m, math.radians(yaw_deg)])
    return run.truth + reach * rng.uniform(-1, 1, run.truth.shape), reach / math.sqrt(3)


def near(run: Run, rig: Rig, position_m: float = 0.3, yaw_deg: float = 10.0) -> list[LocatedPose]:
    """Locate stops from starts that are off by up to so much."""
    return Locator(run.wall_map, rig).locate(run.recording, *starts(run, position_m, yaw_deg))


def rows() -> Iterator[tuple[str, Row]]:
    """Yield the rows of the table: what is changed, and how stops are located."""

    def changed(rig: Rig, footprint: float, unknowns: bool) -> Rig:
        sensors = tuple(one.model_copy(update={"footprint_columns": footprint}) for one in rig.sensor)
        stop = rig.stop if unknowns else type(rig.stop)(**NO_UNKNOWNS)
        return rig.model_copy(update={"sensor": sensors, "stop": stop})

    plain, with_unknowns = changed(NOMINAL, THIN, False), changed(NOMINAL, THIN, True)
    yield "flat walls, centre rays, nominal rig", lambda run, rig: near(run, plain)
    yield "+ unknowns of each stop", lambda run, rig: near(run, with_unknowns)
    yield "+ footprint of 2.5 columns", lambda run, rig: near(run, NOMINAL)
    yield "+ calibrated rig", near
    yield "from odometry alone", lambda run, rig: Locator(run.wall_map, rig).follow(run.recording)
    yield "from odometry, smoothed", joined
    yield "one frame of 15", lambda run, rig: near(first_frame(run), rig)
    yield "one frame, from odometry", lambda run, rig: Locator(run.wall_map, rig).follow(first_frame(run).recording)
    yield "starts ± 1.2 m, ± 45°", lambda run, rig: near(run, rig, 1.2, 45.0)
    yield "no start", lambda run, rig: Locator(run.wall_map, rig).locate(run.recording)
    yield "no start, smoothed", lambda run, rig: joined(run, rig, anywhere=True)


def joined(run: Run, rig: Rig, anywhere: bool = False) -> list[LocatedPose]:
    """Follow the odometry, or search the whole map at each stop, and join all stops by the odometry."""
    locator = Locator(run.wall_map, rig)
    answers = locator.locate(run.recording) if anywhere else locator.follow(run.recording)
    return smoothed(run.recording, answers, locator)


def first_frame(run: Run) -> Run:
    """Return a run with the first frame of each stop alone."""
    return Run(run.name, run.recording.first_frames(1), run.wall_map, run.truth, run.scored, run.slam)


def calibrated(run: Run, others: Sequence[Run]) -> Rig:
    """Calibrate the rig on other runs."""
    known = [np.where(one.scored[:, None], one.truth, np.nan) for one in others]
    return calibrate_rig(NOMINAL, [one.recording for one in others], [one.wall_map for one in others], known).rig


@dataclass
class Score:
    """Errors of accepted stops, in the body's frame, about the bias of each drone in each run or not."""

    raw: list[Floats]
    unbiased: list[Floats]
    inside: list[NDArray[np.bool_]]
    scored: int = 0
    accepted: int = 0
    gross: int = 0
    listed: int = 0

    def add(self, run: Run, pose: Floats, covariance: Floats | None, accepted: NDArray[np.bool_]) -> None:
        """Add the poses of a run."""
        used = run.scored & accepted
        error = pose - run.truth
        error[:, 2] = wrapped(error[:, 2])
        cos, sin, zero = np.cos(run.truth[:, 2]), np.sin(run.truth[:, 2]), np.zeros(len(pose))
        turn = np.array([[cos, sin, zero], [-sin, cos, zero], [zero, zero, zero + 1]]).transpose(2, 0, 1)
        own = np.einsum("nij,nj->ni", turn, error)
        for robot in np.unique(run.recording.robot):
            group = run.recording.robot == robot
            if (group & used).any():
                own[group] -= np.median(own[group & used], axis=0)
        self.raw.append(error[used])
        self.unbiased.append(own[used])
        self.scored += int(run.scored.sum())
        self.accepted += int(used.sum())
        self.gross += int((used & ((np.hypot(*error[:, :2].T) > GROSS_M) | (abs(own[:, 2]) > GROSS_RAD))).sum())
        if covariance is not None:
            whole = (turn @ covariance @ turn.transpose(0, 2, 1))[used] + VICON_STD
            nees = np.einsum("ni,ni->n", own[used], np.linalg.solve(whole, own[used][..., None])[..., 0])
            self.inside.append(nees < CHI2_95)

    def cells(self) -> tuple[str, ...]:
        """Return raw and unbiased r.m.s., share inside, accepted, gross and listed."""

        def rms(errors: list[Floats]) -> tuple[str, str]:
            every = np.concatenate(errors)
            if not len(every):
                return "", ""
            position = 1e3 * math.sqrt((every[:, :2] ** 2).sum(axis=1).mean())
            return f"{position:.1f}", f"{math.degrees(math.sqrt((every[:, 2] ** 2).mean())):.2f}"

        inside = f"{np.concatenate(self.inside).mean():.2f}" if self.inside and self.accepted else ""
        listed = f"{self.listed} of {self.scored}" if self.inside else ""
        return (
            *rms(self.raw),
            *rms(self.unbiased),
            inside,
            f"{self.accepted} of {self.scored}",
            str(self.gross),
            listed,
        )


def listed(run: Run, answers: Sequence[LocatedPose]) -> int:
    """Return at how many scored stops the true pose is among the explanations."""
    count = 0
    for answer, truth, scored in zip(answers, run.truth, run.scored, strict=True):
        off = np.array([[one.x_m, one.y_m, one.yaw_rad] for one in answer.alternatives]).reshape(-1, 3) - truth
        found = (np.hypot(off[:, 0], off[:, 1]) < SAME_M) & (abs(wrapped(off[:, 2])) < SAME_RAD)
        count += bool(scored and found.any())
    return count


HEAD = ("", "raw (mm)", "raw (°)", "about the bias (mm)", "(°)", "inside 95 %", "accepted", "gross", "true pose listed")


def measured(runs: Sequence[Run], rigs: dict[str, Rig], out: Path) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table, and write the poses of each and a figure."""
    score = Score([], [], [])
    for run in runs:
        score.add(run, run.slam.copy(), None, np.ones(len(run.slam), bool))
    yield "the authors' SLAM", *score.cells()
    for k, (name, row) in enumerate(rows()):
        score, everything = Score([], [], []), []
        for run in runs:
            answers = row(run, rigs[run.name])
            pose, accepted = np.array([one.pose for one in answers]), np.array([one.accepted for one in answers])
            score.add(run, pose, np.nan_to_num(np.array([one.covariance for one in answers])), accepted)
            score.listed += listed(run, answers)
            everything.append((run, answers))
        table = pose_csv([one for _, answers in everything for one in answers], runs[0].recording.robot_key)
        (out / f"poses-{k}.csv").write_text(table)
        if name == "from odometry, smoothed":
            drives = [
                (run.name, run.wall_map.outline(), answers, np.where(run.scored[:, None], run.truth, np.nan))
                for run, answers in everything
            ]
            (out / "poses.png").write_bytes(figure_png(locate_figure(drives), dpi=110))
        yield name, *score.cells()


def main(arguments: Sequence[str] | None = None) -> int:
    """Calibrate, locate, score and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--calibrate-on", type=Path, help="a folder of other runs; else the other runs of FOLDER")
    parser.add_argument("--out", type=Path, default=Path("out/swarm"))
    given = parser.parse_args(arguments)
    try:
        runs = read_runs(given.folder)
        other = None if given.calibrate_on is None else read_runs(given.calibrate_on)
        given.out.mkdir(parents=True, exist_ok=True)
        rigs = {}
        for run in runs:
            rigs[run.name] = calibrated(run, other or [one for one in runs if one is not run])
            (given.out / f"rig-{run.name}.toml").write_text(rigs[run.name].to_toml())
        lines = [f"| {' | '.join(HEAD)} |", f"|{'---|' * len(HEAD)}"]
        print(*lines, sep="\n")
        table = []
        for row in measured(runs, rigs, given.out):
            table.append(row)
            lines.append(f"| {' | '.join(row)} |")
            print(lines[-1], flush=True)
    except (PhasemarkError, OSError, KeyError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    (given.out / "accuracy.md").write_text("\n".join(lines) + "\n")
    (given.out / "accuracy.csv").write_text(csv_text([HEAD, *table]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
