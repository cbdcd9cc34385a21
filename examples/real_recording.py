"""Match a recording of a small time-of-flight sensor before a flat panel, frame by frame, and compare with the truth.

``python examples/real_recording.py panel.csv --sensor out/calibration/sensor.toml --second-half --out out/recording``

The CSV file is read as `phasemark match` reads it: ``t_ms``, ``mm_0 … mm_63`` (z of 8 × 8 zones, row by row from the
top) and ``status_0 … status_63`` (5: valid). If it also has ``panel_x_m`` (distance of the panel's plane from the lens,
along its normal) and ``yaw_deg`` (heading, counter-clockwise, 0: facing the panel), the estimates are compared with
them. ETH Zürich's data set Matrix_ToF_Drones has recordings of this kind.

Each frame alone gives the distance and the heading, with their covariance. A flat panel does not tell where along it
the camera looks, so the model is a slab wider than the view and the bearing is fixed. The floor, and whatever is seen
past the panel, are unknown things: ``background="unknown"``.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import least_squares

from phasemark import PhasemarkError
from phasemark.data import BankPlan, build_bank, read_frames
from phasemark.data.plans import MeshPlan
from phasemark.matcher import Matcher, Matches, kalman_filter
from phasemark.matcher.filters.stamps import spread_stamps
from phasemark.render import Frames, Sensor, preset

THICKNESS_M = 0.01
"""Of the panel; its landmark axis lies in the middle."""
WIDE_M = 4.0
"""Width and height of the slab, more than the view covers."""
AT_ONCE = 64
"""Frames in a batch."""
FACING_RAD, GROSS_M, GROSS_RAD = np.radians(45.0), 0.03, np.radians(6.0)
INSIDE_95 = 5.991
"""95 % quantile of χ² with two degrees of freedom."""
BLOCKS = 8
"""Blocks of time that are left out in turn for the standard deviation of a delay."""
Floats = NDArray[np.float64]


@dataclass
class Recording:
    """Frames of a moving camera, one a position, and the columns of their table that are no pixels.

    `columns` are those of the frames, `whole` those of the whole file; ``shown_s`` is added to both, the stamps (s)
    with those that repeat moved into the gaps beside them.
    """

    frames: Frames
    columns: dict[str, Floats]
    whole: dict[str, Floats]

    def truth(self, name: str, at_s: Floats) -> Floats:
        """Interpolate a column of the file at times (s); rows without a number and repeated stamps are left out."""
        time_s, values = self.whole["t_ms"] / 1e3, self.whole[name]
        known = np.isfinite(time_s) & np.isfinite(values)
        stamps, first = np.unique(time_s[known], return_index=True)
        smooth = np.unwrap(values[known], period=360.0) if name.endswith("_deg") else values[known]
        return np.interp(at_s, stamps, smooth[first], left=np.nan, right=np.nan)


def uncalibrated() -> Sensor:
    """Return the preset with the noise that covers zone offsets too, for a sensor that was not calibrated."""
    return preset("vl53l5cx-8x8").with_(range_std_m=0.006)


def read_recording(path: Path, sensor: Sensor, needed: tuple[str, ...], half: str | None = None) -> Recording:
    """Read a CSV file as described above.

    Raises
    ------
    ValueError
        A column is missing, or a value in it is not a number.
    """
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        frames = read_frames(path, sensor=sensor, unit="mm", quantity="z", valid_status=[5]).each_a_position()
    frames.tilt_rad = None  # of the drone, a nose up being positive, and noisier than what the panel shows of it
    for note in notes:
        print(f"note: {note.message}", file=sys.stderr)
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if line.strip() and not line.startswith("#")))
    missing = [name for name in needed if name not in rows[0]]
    if missing:
        raise ValueError(f"{path}: no column {missing[0]!r}; needed are {', '.join(needed)}")
    names = [name for name in rows[0] if name and not name.startswith(("mm_", "status_"))]
    try:
        columns = {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: a value is not a number: {error}") from None
    if "t_ms" in columns:
        columns["shown_s"] = spread_stamps(columns["t_ms"] / 1e3)
    middle = len(rows) // 2
    part = {"first": slice(middle), "second": slice(middle, None), None: slice(None)}[half]
    return Recording(frames[part], {name: values[part] for name, values in columns.items()}, columns)


def panel_matcher(sensor: Sensor, distance: str) -> Matcher:
    """Return a matcher for the panel, with a bank over a grid of distances (m) and headings up to 60°."""
    with tempfile.TemporaryDirectory() as folder:
        mesh = Path(folder) / "panel.stl"
        trimesh.creation.box((THICKNESS_M, WIDE_M, WIDE_M)).export(mesh)
        panel = MeshPlan(name="panel", path=str(mesh), unit="m", symmetry=2)
        fields = sensor.model_dump(exclude_none=True)
        plan = BankPlan(
            meshes=(panel,), sensor="vl53l5cx-8x8", sensor_overrides=fields, distance_m=distance, delta_deg="-60:60:1",
            layout="full",
        )  # fmt: skip
        bank = build_bank(plan)
    return Matcher(bank, "refine", free=("distance_m", "delta_rad"), background="unknown")


def match(matcher: Matcher, frames: Frames) -> Matches:
    """Match every frame by itself, in batches."""
    parts = range(0, len(frames), AT_ONCE)
    return Matches([one for k in parts for one in matcher.match(kalman_filter(frames[k : k + AT_ONCE]))])


def panel_pose(matches: Matches) -> tuple[Floats, Floats]:
    """Return distance from the panel's front (m) and heading (rad) of n frames, (n, 2), and covariance, (n, 2, 2)."""
    distance, delta = matches.distance_m, np.angle(np.exp(2j * matches.delta_rad)) / 2  # a slab repeats after 180°
    covariance = np.full((len(delta), 2, 2), np.nan) if matches.covariance is None else matches.covariance
    jacobian = np.zeros((len(delta), 2, 2))
    jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 1] = np.cos(delta), -distance * np.sin(delta), 1.0
    pose = np.column_stack([distance * np.cos(delta) - THICKNESS_M / 2, delta])
    return pose, jacobian @ covariance @ jacobian.transpose(0, 2, 1)


def pose_error(recording: Recording, pose: Floats, delay_s: Floats | float) -> tuple[Floats, Floats]:
    """Return errors of distance (m) and heading (rad), (n, 2), if frames show the pose `delay_s` after their stamp."""
    at_s = recording.columns["shown_s"] + delay_s
    yaw = np.radians(recording.truth("yaw_deg", at_s))
    turn = np.angle(np.exp(1j * (pose[:, 1] - yaw)))
    return np.column_stack([pose[:, 0] - recording.truth("panel_x_m", at_s), turn]), np.angle(np.exp(1j * yaw))


def delay_of_run(recording: Recording, pose: Floats, used: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Fit the delay (s) in the middle of the run and its drift (s per s) robustly; return both and jackknife errors."""
    time_s = recording.columns["t_ms"] / 1e3
    since = time_s - np.median(time_s)
    index = np.flatnonzero(used)

    def fit(kept: NDArray[np.intp]) -> Floats:
        def residual(x: Floats) -> Floats:
            error, _ = pose_error(recording, pose, x[0] + x[1] * since)
            return np.nan_to_num((error[kept] - x[2:]) / (0.004, np.radians(0.8))).ravel()

        start = np.append([-0.05, 0.0], np.nanmedian(pose_error(recording, pose, -0.05)[0][kept], axis=0))
        scale = (0.01, 0.001, 0.001, 0.01)
        return np.asarray(least_squares(residual, start, loss="soft_l1", x_scale=scale, diff_step=0.05).x[:2])

    left_out = np.array([fit(np.setdiff1d(index, block)) for block in np.array_split(index, BLOCKS)])
    return fit(index), np.sqrt((BLOCKS - 1) * left_out.var(axis=0))


def describe(
    recording: Recording, pose: Floats, covariance: Floats, accepted: NDArray[np.bool_], delay_s: float
) -> str:
    """Say how the estimates agree with the truth, for one delay."""
    error, yaw = pose_error(recording, pose, delay_s)
    facing = np.abs(yaw) < FACING_RAD
    good = accepted & facing & np.isfinite(error).all(axis=1)
    if not good.any():
        return "no accepted frame has a truth to compare with"
    middle = np.median(error[good], axis=0)
    mad = np.median(np.abs(error[good] - middle), axis=0)
    rms = math.sqrt(np.mean((error[good, 1] - middle[1]) ** 2))
    squared = np.einsum("ni,nij,nj->n", error[good], np.linalg.inv(covariance[good]), error[good])
    gross = accepted & ((np.abs(error[:, 0]) > GROSS_M) | (np.abs(error[:, 1]) > GROSS_RAD))
    return "\n".join(
        [
            f"compared at a delay of {1e3 * delay_s:.0f} ms:",
            f"  answered: {good.sum()} of {facing.sum()} frames within 45° of the panel's normal"
            f" ({100 * good.sum() / facing.sum():.0f} %)",
            f"  distance: median error {1e3 * middle[0]:.1f} mm, MAD {1e3 * mad[0]:.1f} mm",
            f"  heading: median error {np.degrees(middle[1]):.2f}°, r.m.s. about it {np.degrees(rms):.2f}°,"
            f" MAD {np.degrees(mad[1]):.2f}°",
            f"  truth in the 95 % ellipse: {100 * np.mean(squared < INSIDE_95):.0f} %",
            f"  accepted beyond 30 mm or 6°: {gross.sum()}",
        ]
    )


def draw(recording: Recording, pose: Floats, covariance: Floats, accepted: NDArray[np.bool_], delay_s: float) -> Figure:
    """Draw the accepted estimates, with two standard deviations, over the truth."""
    figure = Figure(figsize=(10, 6), layout="constrained")
    time_s = recording.columns["t_ms"] / 1e3
    for k, (axes, name, label) in enumerate(
        zip(figure.subplots(2, 1, sharex=True), ("panel_x_m", "yaw_deg"), ("distance (m)", "heading (°)"), strict=True)
    ):
        unit = np.degrees(1.0) if k else 1.0
        if name in recording.columns:
            truth = recording.truth(name, time_s + delay_s)
            axes.plot(time_s, (truth + 180) % 360 - 180 if k else truth, "k.", ms=3, label="motion capture")
        spread = 2 * unit * np.sqrt(covariance[accepted, k, k])
        axes.errorbar(time_s[accepted], unit * pose[accepted, k], spread, fmt=".", ms=4, lw=0.7, label="estimate ± 2σ")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    axes.set_xlabel("time (s)")
    axes.legend(frameon=False)
    return figure


def write_estimates(path: Path, matches: Matches, pose: Floats, covariance: Floats, time_s: Floats) -> None:
    """Write a line for each frame."""
    std = np.sqrt(np.einsum("nii->ni", covariance))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = "time_s,distance_m,distance_std_m,heading_deg,heading_std_deg,corr_distance_heading,accepted,reason"
        writer.writerow(names.split(","))
        for k, one in enumerate(matches):
            numbers = (pose[k, 0], std[k, 0], np.degrees(pose[k, 1]), np.degrees(std[k, 1]))
            values = (time_s[k], *numbers, covariance[k, 0, 1] / (std[k, 0] * std[k, 1]))
            writer.writerow([*(f"{v:.6g}" for v in values), "true" if one.accepted else "false", one.reason])


def main(argv: list[str] | None = None) -> int:
    """Match a recording, write estimates and figure, and compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("csv", type=Path, help="the recording")
    parser.add_argument("--sensor", type=Path, help="sensor file of calibrate_recording.py; the preset without it")
    parser.add_argument("--distance", default="0.4:1.2:0.01", help="distances of the bank: from:to:step, metres")
    parser.add_argument("--second-half", action="store_const", const="second", help="match the second half alone")
    parser.add_argument("--out", type=Path, default=Path("out/recording"), help="folder of the results")
    arguments = parser.parse_args(argv)
    try:
        sensor = uncalibrated() if arguments.sensor is None else Sensor.from_toml(arguments.sensor)
        recording = read_recording(arguments.csv, sensor, ("t_ms",), arguments.second_half)
        matcher = panel_matcher(sensor, arguments.distance)
        started = time.perf_counter()
        matches = match(matcher, recording.frames)
        seconds = time.perf_counter() - started
    except (ValueError, OSError, PhasemarkError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    pose, covariance = panel_pose(matches)
    arguments.out.mkdir(parents=True, exist_ok=True)
    estimates, figure = arguments.out / "estimates.csv", arguments.out / "estimates.png"
    write_estimates(estimates, matches, pose, covariance, recording.columns["t_ms"] / 1e3)
    draw(recording, pose, covariance, matches.accepted, sensor.delay_s).savefig(figure, dpi=90)
    print(f"{matches.accepted.sum()} of {len(matches)} frames accepted, {len(matches) / seconds:.0f} frames/s")
    if {"panel_x_m", "yaw_deg"} <= set(recording.columns):
        print(describe(recording, pose, covariance, matches.accepted, sensor.delay_s))
        if matches.accepted.sum() > 4 * BLOCKS:
            (delay, drift), std = delay_of_run(recording, pose, matches.accepted)
            print(f"this run's own delay: {1e3 * delay:.0f} ± {1e3 * std[0]:.0f} ms in its middle,", end=" ")
            print(f"drifting by {1e3 * drift:.1f} ± {1e3 * std[1]:.1f} ms per second")
            print(describe(recording, pose, covariance, matches.accepted, delay))
    print(estimates, figure, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
