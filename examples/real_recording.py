"""Match a recording of a small time-of-flight sensor that turns before a flat panel, and compare with the truth.

``python examples/real_recording.py panel.csv --out out/recording``

The CSV has one frame a line, with a header: ``mm_0 … mm_63`` (z distances of 8 × 8 zones, row by row from the top),
``status_0 … status_63`` (5: valid), and of a motion-capture system ``panel_x_m`` (how far the panel's plane is from the
sensor along its normal) and ``yaw_deg`` (heading, 0: facing the panel, counter-clockwise). An empty cell is a missing
value. ETH Zürich's data set Matrix_ToF_Drones has recordings of this kind.

Each frame by itself gives the panel's distance D along the optical axis and the side δ it is seen from. Zones that see
the floor or miss the panel are told apart by a plane: seen by a pinhole, a plane's 1/z is linear over the image.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phasemark import PhasemarkError
from phasemark.data import read_frames
from phasemark.render import Frames, Renderer, Sensor, preset

VALID_STATUS = 5
FEWEST_ZONES = 16
"""A quarter of the zones has to lie on the panel."""
FEWEST_INSIDE = 8
"""Where fewer would be left without the zones at the sides, those are kept."""
NEAREST_M = 0.2
"""Nearer returns are the floor or the sensor's own cover."""
TOLERANCE_M = 0.015
"""A zone lies on the plane if it is nearer to it than this: four times the noise of a zone."""
STEEPEST_RAD = np.radians(50.0)
THICKNESS_M = 0.01
"""Of the panel; its landmark axis lies in the middle."""
STEPS = 6
"""Gauss–Newton steps; the model is all but linear."""
DIFFERENCE = np.array([1e-3, 1e-3])
"""Steps of the differences in D (m) and δ (rad)."""


@dataclass
class Recording:
    """A recording and its truth; n frames."""

    z_m: NDArray[np.float64]
    frames: Frames
    distance_m: NDArray[np.float64]
    yaw_rad: NDArray[np.float64]


def read_recording(path: Path, sensor: Sensor) -> Recording:
    """Read a CSV as described above.

    Raises
    ------
    ValueError
        With one line that says which column or value is wrong.
    """
    zones = sensor.rows * sensor.cols
    names = {
        "mm": [f"mm_{i}" for i in range(zones)],
        "status": [f"status_{i}" for i in range(zones)],
        "truth": ["panel_x_m", "yaw_deg"],
    }
    table: dict[str, list[list[float]]] = {group: [] for group in names}
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        try:
            missing = [name for group in names.values() for name in group if name not in (reader.fieldnames or ())]
            if missing:
                raise ValueError(
                    f"{path}: no column {missing[0]!r}; needed are {', '.join(g[0] for g in names.values())} …"
                )
            for line in reader:
                for group, columns in names.items():
                    table[group].append([_number(path, reader.line_num, name, line[name]) for name in columns])
        except (csv.Error, UnicodeDecodeError) as error:
            raise ValueError(f"{path}, after line {reader.line_num}: not a text table ({error})") from None
    if not table["mm"]:
        raise ValueError(f"{path}: no frames")
    shape = (-1, sensor.rows, sensor.cols)
    millimetres = np.array(table["mm"]).reshape(shape)
    status = np.nan_to_num(np.array(table["status"])).astype(int).reshape(shape)
    truth = np.array(table["truth"])
    with tempfile.TemporaryDirectory() as folder:
        arrays = Path(folder) / "recording.npz"
        np.savez(arrays, range=np.where(millimetres > 0, millimetres, np.nan), status=status)
        frames = read_frames(arrays, sensor=sensor, unit="mm", quantity="z", valid_status=[VALID_STATUS])
    z_m = np.where(status == VALID_STATUS, millimetres / 1e3, np.nan)
    return Recording(z_m, frames, truth[:, 0], np.radians(truth[:, 1]))


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    """Read one value of the table; NaN where there is none."""
    try:
        value = float(text or "nan")
    except ValueError:
        raise ValueError(f"{path}, line {line}: {name} must be a number, got {text!r}") from None
    return value if math.isfinite(value) else math.nan


def zone_rays(sensor: Sensor) -> NDArray[np.float64]:
    """Return (1, y, z) of the ray through the centre of each zone, (zones, 3)."""
    tan_h, tan_v = sensor.tan_half_angles
    centre_u, centre_v = sensor.centre_px
    v, u = np.mgrid[: sensor.rows, : sensor.cols] + 0.5
    y, z = (centre_u - u) * 2 * tan_h / sensor.cols, (centre_v - v) * 2 * tan_v / sensor.rows
    return np.column_stack([np.ones(u.size), y.ravel(), z.ravel()])


def find_plane(
    z_m: NDArray[np.float64], rays: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """Find the plane that most zones of a frame lie on, an upright panel before the sensor.

    Returns
    -------
    plane : (3,)
        Its points p satisfy plane · p = 1.
    on_it : (zones,) bool
        Or None: too few zones lie on any plane.
    """
    seen = np.flatnonzero(np.nan_to_num(z_m) > NEAREST_M)
    if len(seen) < FEWEST_ZONES:
        return None
    a, inverse = rays[seen], 1 / z_m[seen]

    def agrees(plane: NDArray[np.float64]) -> NDArray[np.bool_]:
        value = a @ plane
        return (value > 0) & (np.abs(1 / np.where(value > 0, value, 1.0) - z_m[seen]) < TOLERANCE_M)

    best = np.zeros(len(seen), bool)
    for _ in range(100):
        chosen = rng.choice(len(seen), 3, replace=False)
        if abs(np.linalg.det(a[chosen])) < 1e-4:
            continue
        on_it = agrees(np.linalg.solve(a[chosen], inverse[chosen]))
        if on_it.sum() > best.sum():
            best = on_it
    plane = np.zeros(3)
    for _ in range(3):
        if best.sum() < FEWEST_ZONES:
            return None
        weight = z_m[seen][best] ** 2  # the noise of z is the same for all zones, that of 1/z is not
        plane = np.linalg.lstsq(a[best] * weight[:, None], inverse[best] * weight, rcond=None)[0]
        best = agrees(plane)
    upright = abs(plane[2]) < 0.3 * plane[0]
    if best.sum() < FEWEST_ZONES or not upright or abs(np.arctan2(plane[1], plane[0])) > STEEPEST_RAD:
        return None
    on_panel = np.zeros(len(z_m), bool)
    on_panel[seen[best]] = True
    return plane, on_panel


def inside(on_panel: NDArray[np.bool_], sensor: Sensor) -> NDArray[np.bool_]:
    """Leave out zones of a frame that may see past a side of the panel: those with a neighbour that is not on it.

    A zone that sees both is a little too far or too near, and at the side, where it tilts the plane most.
    """
    grid = on_panel.reshape(sensor.rows, sensor.cols)
    beside = np.pad(grid, ((0, 0), (1, 1)), constant_values=True)
    kept = grid & beside[:, :-2] & beside[:, 2:]
    return (kept if kept.sum() >= FEWEST_INSIDE else grid).ravel()


def panel_width(planes: NDArray[np.float64], on_panel: NDArray[np.bool_], rays: NDArray[np.float64]) -> float:
    """Return how wide the panel is at least: what zones on it span, to both sides of the axis it is hit at (m)."""
    points = rays / (planes @ rays.T)[..., None]
    along = np.stack([-planes[:, 1], planes[:, 0]], axis=1) / np.hypot(planes[:, 0], planes[:, 1])[:, None]
    across = np.abs(np.einsum("nzk,nk->nz", points[..., :2] - [[[1.0, 0.0]]] / planes[:, None, :1], along))
    return 2.2 * float(across[on_panel].max())


def match(
    recording: Recording, sensor: Sensor, rng: np.random.Generator
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
    """Estimate (D, δ) of every frame that shows enough of the panel.

    Returns
    -------
    index : (m,)
        The frames.
    view : (m, 2)
        D and δ.
    covariance : (m, 2, 2)
    chi2_per_dof : (m,)
    width_m : float
        Of the panel.
    """
    rays = zone_rays(sensor)
    found = [(k, find_plane(z.ravel(), rays, rng)) for k, z in enumerate(recording.z_m)]
    kept = [(k, *plane) for k, plane in found if plane is not None]
    if not kept:
        raise ValueError("no frame shows a panel")
    index = np.array([k for k, _, _ in kept])
    planes, on_panel = np.array([p for _, p, _ in kept]), np.array([z for _, _, z in kept])
    width = panel_width(planes, on_panel, rays)
    renderer = Renderer(trimesh.creation.box((THICKNESS_M, width, width)), sensor)
    measured = recording.frames.range_m[0].reshape(len(recording.z_m), -1)[index]
    used = np.array([inside(frame, sensor) for frame in on_panel])
    weight = np.where(used & np.isfinite(measured), 1.0, 0.0)
    view = np.column_stack([1 / planes[:, 0] + THICKNESS_M / 2, np.arctan2(planes[:, 1], planes[:, 0])])
    view[:, 1] *= -1

    def ranges(at: NDArray[np.float64]) -> NDArray[np.float64]:
        return renderer.render(at[:, 0], at[:, 1]).range_m.reshape(len(at), -1)

    for _ in range(STEPS):
        model = ranges(view)
        slope = np.stack(
            [(ranges(view + step) - ranges(view - step)) / (2 * step.sum()) for step in np.diag(DIFFERENCE)], axis=2
        )
        use = weight * np.isfinite(model) * np.isfinite(slope).all(axis=2)
        residual = np.where(use > 0, measured - model, 0.0)
        slope = np.where(use[..., None] > 0, slope, 0.0)
        information = np.einsum("nza,nzb->nab", slope, slope)
        view = view + np.linalg.solve(information, np.einsum("nza,nz->na", slope, residual)[..., None])[..., 0]
    variance = sensor.range_std_m**2
    chi2_per_dof = (residual**2).sum(axis=1) / variance / np.maximum(use.sum(axis=1) - 2, 1)
    covariance = variance * np.maximum(chi2_per_dof, 1.0)[:, None, None] * np.linalg.inv(information)
    return index, view, covariance, chi2_per_dof, width


def draw(
    recording: Recording,
    index: NDArray[np.intp],
    distance: NDArray[np.float64],
    std: NDArray[np.float64],
    delta: NDArray[np.float64],
    delta_std: NDArray[np.float64],
) -> Figure:
    """Draw the estimates over the truth."""
    figure = Figure(figsize=(10, 6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for axes, estimate, spread, truth, label in (
        (above, distance, std, recording.distance_m[index], "distance to the panel (m)"),
        (below, np.degrees(delta), np.degrees(delta_std), np.degrees(recording.yaw_rad[index]), "side δ (°)"),
    ):
        axes.plot(index, truth, "k.", ms=3, label="motion capture")
        axes.errorbar(index, estimate, 2 * spread, fmt=".", ms=4, lw=0.7, label="estimate ± 2σ")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    above.legend(frameon=False)
    below.set_xlabel("frame")
    return figure


def main() -> int:
    """Match a recording and write estimates and picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("csv", type=Path, help="the recording")
    parser.add_argument("--out", type=Path, default=Path("out/recording"), help="folder of the results")
    arguments = parser.parse_args()
    sensor = preset("vl53l5cx-8x8")
    try:
        recording = read_recording(arguments.csv, sensor)
        index, view, covariance, chi2, width = match(recording, sensor, np.random.default_rng(2005))
    except (ValueError, OSError, PhasemarkError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    # the lens is D cos δ before the panel's middle plane, half its thickness nearer to its front
    distance = view[:, 0] * np.cos(view[:, 1]) - THICKNESS_M / 2
    slope = np.stack([np.cos(view[:, 1]), -view[:, 0] * np.sin(view[:, 1])], axis=1)
    std = np.sqrt(np.einsum("na,nab,nb->n", slope, covariance, slope))
    delta_std = np.sqrt(covariance[:, 1, 1])
    arguments.out.mkdir(parents=True, exist_ok=True)
    columns = (index, distance, std, np.degrees(view[:, 1]), np.degrees(delta_std), chi2)
    np.savetxt(
        arguments.out / "estimates.csv",
        np.column_stack(columns),
        delimiter=",",
        comments="",
        fmt=("%d", "%.5f", "%.5f", "%.3f", "%.3f", "%.3f"),
        header="frame,distance_m,distance_std_m,delta_deg,delta_std_deg,chi2_per_dof",
    )
    draw(recording, index, distance, std, view[:, 1], delta_std).savefig(arguments.out / "estimates.png", dpi=90)
    error_m = distance - recording.distance_m[index]
    turn = view[:, 1] - recording.yaw_rad[index]
    error_deg = np.degrees(np.angle(np.exp(1j * turn)))
    known = np.isfinite(error_m) & np.isfinite(error_deg)
    print(f"{len(index)} of {len(recording.z_m)} frames show the panel, {width:.2f} m wide or more")
    print(arguments.out / "estimates.png")
    if not known.any():
        print("no frame of these has a truth to compare with")
        return 0
    error_m, error_deg = error_m[known], error_deg[known]
    offset = np.median(error_m)
    print(f"distance: median error {1e3 * offset:.1f} mm, MAD {1e3 * np.median(np.abs(error_m - offset)):.1f} mm")
    print(f"side: median error {np.median(error_deg):.2f}°, r.m.s. {np.sqrt(np.mean(error_deg**2)):.2f}°")
    return 0


if __name__ == "__main__":
    sys.exit(main())
