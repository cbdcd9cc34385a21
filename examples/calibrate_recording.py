"""Calibrate a small time-of-flight sensor on a recording of a moving camera before a flat panel.

``python examples/calibrate_recording.py panel.csv --first-half --out out/calibration``

The CSV file is that of ``examples/real_recording.py``, with the truth of motion capture: ``panel_x_m``, ``panel_y_m``,
``panel_z_m`` (a marker on the panel minus the camera, world axes, x along the panel's normal) and ``yaw_deg``. What
comes out is a sensor file with tilt, bearing, field of view, range offset, the delay of the stamps, offsets of the
zones, a noise law and systematic errors, tested on frames that were left out, and a figure of the residuals.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from real_recording import THICKNESS_M, Recording, read_recording

from phasemark import PhasemarkError
from phasemark.matcher import calibrate, kalman_filter
from phasemark.matcher.calibration import KnownPoses
from phasemark.matcher.calibration.mounting import PARAMETERS
from phasemark.matcher.calibration.report import residual_figure
from phasemark.matcher.calibration.result import shown
from phasemark.render import preset

SENSOR = "vl53l5cx-8x8"
PANEL_M = (THICKNESS_M, 0.61, 0.49)
"""Thickness, width and height: where zones stop hitting it."""
MARKER_ABOVE_MIDDLE_M = 0.2
"""The marker is at the panel's upper edge; its height is uncertain, so the camera's height is not estimated."""
COLUMNS = ("t_ms", "panel_x_m", "panel_y_m", "panel_z_m", "yaw_deg")


def known_poses(recording: Recording) -> KnownPoses:
    """Return the poses of motion capture; the panel's front is the plane x = 0, the camera stands at negative x."""
    whole = np.isfinite([recording.columns[name] for name in COLUMNS]).all(axis=0)
    t_ms, x, y, z, yaw = (recording.columns[name][whole] for name in COLUMNS)
    poses = KnownPoses.cartesian(-x, -y, np.radians(yaw), landmark_xy_m=(THICKNESS_M / 2, 0.0))
    return replace(poses, height_m=z - MARKER_ABOVE_MIDDLE_M, time_s=t_ms / 1e3)


def main(argv: list[str] | None = None) -> int:
    """Calibrate and write the sensor file and the figure of the residuals."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("csv", type=Path, help="the recording")
    parser.add_argument("--first-half", action="store_const", const="first", help="calibrate on the first half alone")
    parser.add_argument("--write-distrusted", action="store_true", help="write what cannot be trusted, too")
    parser.add_argument("--force", action="store_true", help="replace the results of an earlier run")
    parser.add_argument("--out", type=Path, default=Path("out/calibration"), help="folder of the results")
    arguments = parser.parse_args(argv)
    sensor, figure = arguments.out / "sensor.toml", arguments.out / "residuals.png"
    for path in (sensor, figure):
        if path.exists() and not arguments.force:
            print(f"error: {path} exists: give another --out, or --force to replace it", file=sys.stderr)
            return 4
    try:
        recording = read_recording(arguments.csv, preset(SENSOR), COLUMNS, arguments.first_half)
        found = calibrate(
            trimesh.creation.box(PANEL_M),
            kalman_filter(recording.frames),
            known_poses(recording),
            fixed=("height",),
            reports_z=True,
            moving=True,
        )
    except (ValueError, OSError, PhasemarkError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    if found.doubts:
        said = f"{'; '.join(found.doubts)}. Likely cause: {found.cause}"
        if not arguments.write_distrusted:
            print(f"error: nothing was written: {said}", file=sys.stderr)
            return 3
        print(f"note: not to be trusted: {said}", file=sys.stderr)
    arguments.out.mkdir(parents=True, exist_ok=True)
    sensor.write_text(found.to_toml(base_name=SENSOR), encoding="utf-8")
    residual_figure(found).savefig(figure, dpi=90)
    for name in found.free:
        value, std = shown(found, name)
        print(f"{name:13s} {value:>9s} ± {std} {PARAMETERS[name].unit}")
    before, after = found.held_out_m
    print(f"residuals of held-out frames, r.m.s.: {1e3 * before:.1f} mm before, {1e3 * after:.1f} mm after")
    print(*found.notes, sensor, figure, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
