"""Split a recording before a panel in two halves, each with the poses of motion capture as `phasemark` reads them.

``python examples/split_recording.py panel.csv --out out/panel``

The CSV file is that of ``examples/calibrate_recording.py``. Written are ``whole.csv``, ``first.csv`` and ``second.csv``
with the frames, and ``whole_poses.csv``, ``first_poses.csv`` and ``second_poses.csv`` with ``t_ms, x_m, y_m,
heading_deg, height_m`` of the lens: the panel's front is the plane x = 0, and its middle is the origin.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from pathlib import Path

MARKER_ABOVE_MIDDLE_M = 0.2
"""The marker is at the panel's upper edge."""
NEEDED = ("t_ms", "panel_x_m", "panel_y_m", "panel_z_m", "yaw_deg")
POSES = ("t_ms", "x_m", "y_m", "heading_deg", "height_m")


def pose_of(row: dict[str, str]) -> list[str] | None:
    """Return the pose of a line as cells of :data:`POSES`; None where motion capture has none."""
    try:
        t_ms, x, y, z, yaw = (float(row[name]) for name in NEEDED)
    except ValueError:
        return None
    if not all(map(math.isfinite, (t_ms, x, y, z, yaw))):
        return None
    return [f"{value:.9g}" for value in (t_ms, -x, -y, yaw, z - MARKER_ABOVE_MIDDLE_M)]


def write(path: Path, header: list[str], rows: list[list[str]]) -> None:
    """Write a table."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([header, *rows])


def main(argv: list[str] | None = None) -> int:
    """Write frames and poses of the whole recording and of its halves."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("csv", type=Path, help="the recording")
    parser.add_argument("--out", type=Path, default=Path("out/panel"), help="folder of the tables")
    arguments = parser.parse_args(argv)
    try:
        with arguments.csv.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(line for line in file if line.strip() and not line.startswith("#"))
            rows, names = list(reader), list(reader.fieldnames or ())
        if missing := [name for name in NEEDED if name not in names]:
            raise ValueError(f"{arguments.csv}: no column {missing[0]!r}; needed are {', '.join(NEEDED)}")
        if cut := [k for k, row in enumerate(rows) if None in row.values()]:
            raise ValueError(f"{arguments.csv}: frame {cut[0]} has fewer values than there are columns")
        arguments.out.mkdir(parents=True, exist_ok=True)
        shown = [name for name in names if name == "t_ms" or name.startswith(("mm_", "status_"))]
        middle = len(rows) // 2
        for part, own in (("whole", rows), ("first", rows[:middle]), ("second", rows[middle:])):
            poses = [pose for row in own if (pose := pose_of(row)) is not None]
            write(arguments.out / f"{part}.csv", shown, [[row[name] for name in shown] for row in own])
            write(arguments.out / f"{part}_poses.csv", list(POSES), poses)
            print(arguments.out / f"{part}.csv", arguments.out / f"{part}_poses.csv", sep="\n")
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
