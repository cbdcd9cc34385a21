"""Calibrate a small time-of-flight sensor on a recording before a flat panel, and see what that changes elsewhere.

``python examples/calibrate_recording.py panel.csv --out out/calibration``

The CSV is that of ``examples/real_recording.py``. Every second frame with enough of the panel calibrates: its pose is
known from motion capture, and the zones that see the panel are found by a plane. The others are compared with what the
sensor should have measured there, mounted as assumed and as calibrated.

A wide panel seen under several angles tells pitch, roll, bearing, horizontal field of view and range offset. It does
not tell the height, for it looks the same from everywhere along it, nor, upright, the vertical field of view: all of a
column's zones have one z.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from real_recording import THICKNESS_M, find_plane, read_recording, zone_rays

from phasemark import PhasemarkError
from phasemark.matcher import Calibration, KnownPoses, calibrate, filter_poses
from phasemark.matcher.calibrate_model import PARAMETERS
from phasemark.matcher.calibrate_report import calibration_toml, residual_picture, shown, shown_std
from phasemark.render import Frames, Renderer, Sensor, preset

PANEL_M = 4.0
"""Wide enough to fill the view: which zones see the panel is told by the plane."""
FREE = ("pitch", "roll", "bearing", "half_angle_h", "range_offset")


def panel_frames(path: Path, sensor: Sensor) -> tuple[Frames, KnownPoses]:
    """Return the zones that see the panel, one frame a pose, and the poses that motion capture says.

    In the world the panel's front is the plane x = 0, and the lens stands at x = −distance, heading to its yaw.
    """
    recording = read_recording(path, sensor)
    rng, rays = np.random.default_rng(2005), zone_rays(sensor)
    found = [(k, find_plane(z.ravel(), rays, rng)) for k, z in enumerate(recording.z_m)]
    index = [k for k, plane in found if plane is not None]
    if len(index) < 20:
        raise ValueError(f"{path}: {len(index)} frames show the panel, a calibration takes at least 20")
    on_panel = np.array([plane[1] for _, plane in found if plane is not None])
    shape = (len(index), 1, sensor.rows, sensor.cols)
    ranges = recording.frames.range_m[0, index].reshape(shape)
    frames = Frames(np.where(on_panel.reshape(shape), ranges, np.nan), sensor=sensor)
    poses = KnownPoses.cartesian(
        -recording.distance_m[index],
        np.zeros(len(index)),
        recording.yaw_rad[index],
        landmark_xy_m=(THICKNESS_M / 2, 0.0),
    )
    return frames, poses


def residuals(frames: Frames, poses: KnownPoses, panel: trimesh.Trimesh) -> NDArray[np.float64]:
    """Return measured less expected ranges of zones on the panel, (poses, rows, cols), by the frames' own sensor."""
    image = Renderer(panel, frames.sensor).render(poses.distance_m, poses.delta_rad, poses.bearing_rad)
    return np.asarray(frames.range_m[:, 0] - image.range_m - frames.sensor.range_offset_m)


def describe(title: str, residual: NDArray[np.float64]) -> str:
    """Put residuals into one line: their r.m.s., and how much of it is the same in every frame."""
    with_data = residual[:, np.isfinite(residual).sum(axis=0) >= 10]
    pattern = np.nanmean(with_data, axis=0)
    return (
        f"{title}: r.m.s. {1e3 * np.sqrt(np.nanmean(residual**2)):.1f} mm,"
        f" mean {1e3 * np.nanmean(residual):.1f} mm,"
        f" r.m.s. of the zones' means {1e3 * np.sqrt(np.mean(pattern**2)):.1f} mm"
    )


def run(path: Path, sensor: Sensor) -> tuple[Calibration, list[str]]:
    """Calibrate on every second frame, and describe what is left of the others."""
    panel = trimesh.creation.box((THICKNESS_M, PANEL_M, PANEL_M))
    frames, poses = panel_frames(path, sensor)
    known, others = np.arange(0, len(poses), 2), np.arange(1, len(poses), 2)
    filtered = filter_poses([frames[k : k + 1] for k in known])
    found = calibrate(panel, filtered, poses[known], free=FREE)
    # ranges follow from the zones' z by the half angles
    kept = Frames(frames.range_m * sensor.axis_cosine() / found.sensor.axis_cosine(), sensor=found.sensor)
    lines = [
        describe("as assumed   ", residuals(frames[others], poses[others], panel)),
        describe("as calibrated", residuals(kept[others], poses[others], panel)),
    ]
    return found, [f"{len(known)} frames calibrate, {len(others)} others are compared", *lines]


def main() -> int:
    """Calibrate and write the sensor file and the picture of the residuals."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("csv", type=Path, help="the recording")
    parser.add_argument("--out", type=Path, default=Path("out/calibration"), help="folder of the results")
    arguments = parser.parse_args()
    try:
        found, lines = run(arguments.csv, preset("vl53l5cx-8x8"))
    except (ValueError, OSError, PhasemarkError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "sensor.toml").write_text(calibration_toml(found, base_name="vl53l5cx-8x8"), encoding="utf-8")
    residual_picture(found).savefig(arguments.out / "residuals.png", dpi=90)
    for name in found.free:
        print(f"{name:13s} {shown(found, name):>9s} ± {shown_std(found, name)} {PARAMETERS[name].unit}")
    for line in (*found.notes, *lines):
        print(line)
    print(arguments.out / "sensor.toml")
    print(arguments.out / "residuals.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
