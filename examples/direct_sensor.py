"""Fit a single-photon zone sensor to histograms of a plane, then locate objects by histograms from several poses.

``python examples/direct_sensor.py --data FOLDER --out out/direct``

FOLDER holds ``ladder.npz`` (histograms of a plane, ``distance_m``) and, for each object, ``NAME.npz`` (histograms,
``sensor2world``) with ``NAME.stl`` (object and table, metres): logs as `phasemark sensor fit-direct` reads them. The
data sets LCSPCData and SPAD-ICCP-Summer-School have recordings of this kind. Without ``--data`` one is simulated.

The fit sees every second distance of the plane and a quarter of the poses of each object. On what it has not seen, the
example prints how well ranges and centroids are predicted, draws predicted beside measured histograms, and locates each
object from 1, 4, 8 and 16 poses drawn at random. What is common to all objects (the frame of the arm against that of
the objects) is taken from the poses of the fit. ``--top NAME=M`` states by how much an object is higher than its mesh.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import trimesh
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phasemark.data.measured.histogram_logs import read_histograms
from phasemark.matcher.histograms import ModelError, ObjectScene, evidence_of, match_jointly, solve_jointly
from phasemark.render import preset
from phasemark.render.direct import (
    DirectFit,
    HistogramFrames,
    ObjectRecording,
    PlaneRecording,
    SceneMesh,
    capture_histograms,
    expected_counts,
    fit_direct_sensor,
    footprint_grid,
    label_object,
    plane_samples,
    range_axis,
    reference_centroid,
    support_height,
    world2cam,
    zone_transients,
)

NEAREST_M = 0.06
"""Nearer than this the sensor's own parallax and saturation decide."""
DOMINATES = 0.9
"""Share of a zone's light from which on the object counts as what the zone sees."""
MODEL_ERROR = ModelError(0.05, 0.01)
POSES = (1, 4, 8, 16)
FREE = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad", "support")
INSIDE_95 = 12.592
"""95 % quantile of χ² with six degrees of freedom."""
SYSTEMATIC = (0.6e-3, np.radians(0.35))
"""What is common to all poses of an object and no number of them averages: metres, radians."""


def simulate(folder: Path, rng: np.random.Generator) -> None:
    """Write a recording of a plane, a block and a wedge."""
    sensor = preset("tmf8820-3x3").with_(principal_point_px=(1.45, 1.4), roll_deg=0.5)
    axis, grid = range_axis(sensor, longest_m=1.0), footprint_grid(sensor)
    log_order = list(sensor.histogram.zone_order)

    def write(name: str, samples: object, albedo: tuple[float, float], **arrays: NDArray[np.float64]) -> None:
        counts = expected_counts(zone_transients(samples, sensor, axis), sensor, axis, albedo)
        drawn = capture_histograms(counts, sensor, rng=rng).counts.reshape(len(counts), 9, -1)
        np.savez(folder / f"{name}.npz", histogram=drawn[:, log_order].astype(np.uint32), **arrays)

    distance_m = np.arange(0.06, 0.4, 0.0083)
    write("ladder", plane_samples(distance_m, grid), (0.8, 0.8), distance_m=distance_m)
    table = trimesh.creation.box((2, 2, 0.1), trimesh.transformations.translation_matrix((0, 0, -0.05)))
    upright = trimesh.transformations.translation_matrix((0, 0, 0.051))
    shapes = {
        "block": trimesh.creation.box((0.06, 0.09, 0.1), upright),
        "wedge": trimesh.creation.cone(0.08, 0.1, sections=4),
    }
    for name, shape in shapes.items():
        mesh = label_object(trimesh.util.concatenate([table, shape]), 0.0)
        mesh.export(folder / f"{name}.stl")
        poses = np.stack([_pose(rng) for _ in range(48)])
        write(name, SceneMesh(mesh).samples(world2cam(poses), grid), (0.5, 0.8), sensor2world=poses)


def _pose(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a pose of the optical frame that looks at the object from above."""
    azimuth, polar = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(8, 50))
    away = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    x = np.cross([0.3, 1.0, 0.2], -away)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x, np.cross(-away, x), -away])
    pose[:3, 3] = [0, 0, 0.06] + rng.uniform(-0.02, 0.02, 3) + 0.22 * away
    return pose


def read(folder: Path) -> tuple[PlaneRecording, list[ObjectRecording]]:
    """Return the plane and the objects of a folder, as the preset's zones."""
    base = preset("tmf8820-3x3")
    log = read_histograms(folder / "ladder.npz", sensor=base)
    if log.frames.reference is not None:
        peak = float(reference_centroid(log.frames.reference.sum(axis=1))[-1])
        base = base.with_(histogram={**base.histogram.model_dump(), "reference_peak": peak})
        log = read_histograms(folder / "ladder.npz", sensor=base)
    far = np.flatnonzero(log.distance_m >= NEAREST_M)
    objects = []
    for path in sorted(folder.glob("*.stl")):
        mesh = trimesh.load(path)
        own = read_histograms(path.with_suffix(".npz"), sensor=base)
        objects.append(
            ObjectRecording(path.stem, own.frames, label_object(mesh, support_height(mesh)), own.sensor2world)
        )
    return PlaneRecording(log.frames[far], log.distance_m[far]), objects


def split(n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which poses the fit sees, a quarter spread over eight tilts a turn, and the others."""
    k = np.arange(n)
    seen = (k + k // 8) % 4 == 0
    return np.flatnonzero(seen), np.flatnonzero(~seen)


def draw_histograms(fit: DirectFit, objects: list[ObjectRecording], path: Path) -> None:
    """Draw predicted beside measured histograms of two unseen poses of each object."""
    figure = Figure(figsize=(18, 3.0 * 2 * len(objects)), layout="constrained")
    axes = figure.subplots(2 * len(objects), 9)
    for row, (one, k) in enumerate((one, k) for one in objects for k in (0.2, 0.7)):
        rest = split(len(one.frames))[1]
        pose = int(rest[int(k * len(rest))])
        got = fit.predict(one[np.array([pose])])
        for zone, ax in enumerate(axes[row]):
            ax.stairs(got.measured[0, zone, 8:60] / 1e3, np.arange(8, 61), color="0.3")
            ax.plot(np.arange(8, 60) + 0.5, got.expected[0, zone, 8:60] / 1e3, color="tab:red", lw=1)
            ax.set_title(f"{one.name} {pose}, zone {zone}", fontsize=8)
            ax.tick_params(labelsize=7)
    figure.supxlabel("bin")
    figure.supylabel("thousand counts: measured (steps), predicted (red)")
    figure.savefig(path, dpi=60)


def locate(
    fit: DirectFit, one: ObjectRecording, rig: NDArray[np.float64], draws: int, rng: np.random.Generator
) -> list[dict[str, float]]:
    """Return errors of an object's pose from k poses that the fit has not seen, against the arm and the rig."""
    p = fit.parameters
    poses = one.sensor2world.copy()
    poses[:, :3, 3] += p["forward"] * poses[:, :3, 2]
    frames = HistogramFrames(one.frames.counts, sensor=fit.sensor, reference=one.frames.reference)
    scene = ObjectScene(one.mesh, fit.sensor)
    support = p[f"{one.name}_support"]
    # one linearisation at the arm's pose serves all draws: errors are far smaller than a bin
    linear = scene.linearise(frames, poses, rig, support, FREE)
    evidence = evidence_of(linear, frames.zone_counts, MODEL_ERROR)
    poisson = evidence_of(linear, frames.zone_counts)
    rest = split(len(poses))[1]
    table = []
    for k in POSES:
        error, spread, inside, bound = [], [], [], []
        for _ in range(draws):
            chosen = rng.choice(rest, k, replace=False)
            step, covariance = solve_jointly(evidence.of_poses(chosen), robust=True)
            covariance = np.nan_to_num(covariance[:6, :6], posinf=1e6) + np.diag(
                [SYSTEMATIC[0] ** 2] * 3 + [SYSTEMATIC[1] ** 2] * 3
            )
            error.append(step[:6])
            spread.append(np.sqrt([np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])]))
            bound.append(np.trace(solve_jointly(poisson.of_poses(chosen))[1][:3, :3]))
            inside.append(step[:6] @ np.linalg.pinv(covariance) @ step[:6] <= INSIDE_95)
        shift = 1e3 * np.linalg.norm(np.array(error)[:, :3], axis=1)
        turn = np.degrees(np.linalg.norm(np.array(error)[:, 3:], axis=1))
        table.append({
            "poses": k, "median_mm": float(np.median(shift)), "p90_mm": float(np.quantile(shift, 0.9)),
            "median_deg": float(np.median(turn)), "p90_deg": float(np.quantile(turn, 0.9)),
            "predicted_mm": float(1e3 * np.median([s[0] for s in spread])),
            "inside_95": float(np.mean(inside)), "bound_mm": float(1e3 * np.sqrt(np.median(bound))),
        })  # fmt: skip
    chosen = rng.choice(rest, POSES[1], replace=False)
    start = rig + np.array([0.004, -0.004, 0.003, 0, 0, 0.04])
    whole = match_jointly(frames[chosen], poses[chosen], scene, start=start, support=1.0, systematic=SYSTEMATIC)
    off = whole.displacement - rig
    print(
        f"{one.name}: searched from 6 mm and 2° away with {POSES[1]} poses: {1e3 * np.linalg.norm(off[:3]):.1f} mm,"
        f" {np.degrees(np.linalg.norm(off[3:])):.1f}° in {whole.steps} steps, chi2/dof {whole.chi2 / whole.dof:.2f}"
    )
    return table


def draw_errors(tables: dict[str, list[dict[str, float]]], path: Path) -> None:
    """Draw the error against the number of poses beside the bound."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    ax = figure.subplots()
    for color, (name, table) in zip(("tab:blue", "tab:orange", "tab:green"), tables.items(), strict=False):
        k = [row["poses"] for row in table]
        ax.loglog(k, [row["median_mm"] for row in table], "o-", color=color, label=f"{name}: median error")
        ax.loglog(k, [row["predicted_mm"] for row in table], "s:", color=color, label=f"{name}: predicted")
        ax.loglog(k, [row["bound_mm"] for row in table], "--", color=color, label=f"{name}: Poisson bound")
    ax.set_xticks(POSES, [str(k) for k in POSES])
    ax.set_xlabel("sensor poses matched jointly")
    ax.set_ylabel("error of the object's position (mm)")
    ax.grid(True, which="both", alpha=0.3)
    ax.legend(fontsize=8)
    figure.savefig(path, dpi=100)


def main(arguments: list[str] | None = None) -> dict[str, object]:
    """Run the example; returns what it found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of logs; without it a recording is simulated")
    parser.add_argument("--out", type=Path, required=True, help="folder for pictures and numbers")
    parser.add_argument("--top", action="append", default=[], metavar="NAME=M", help="how much higher an object is")
    parser.add_argument("--rounds", type=int, default=3, help="how often geometry and response are fitted in turn")
    parser.add_argument("--draws", type=int, default=200, help="random draws of poses")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(2024)
    folder = options.data
    if folder is None:
        folder = options.out / "simulated"
        folder.mkdir(exist_ok=True)
        simulate(folder, rng)
    plane, objects = read(folder)
    every_second = np.arange(0, len(plane.frames), 2)
    fit = fit_direct_sensor(
        plane[every_second], [one[split(len(one.frames))[0]] for one in objects], base=plane.frames.sensor,
        rounds=options.rounds,
    )  # fmt: skip
    unseen = plane[every_second[: len(plane.frames) // 2] + 1]
    error = 1e3 * (fit.plane_range_m(unseen) - unseen.distance_m[:, None])
    found: dict[str, object] = {"range_rms_mm": np.sqrt((error**2).mean(axis=0)).round(3).tolist()}
    print("range r.m.s. of each zone, distances not fitted (mm):", found["range_rms_mm"])
    print("chi2/nu of each zone, Poisson alone:", fit.reduced_chi2.round(0).tolist())
    for one in objects:
        rest = one[split(len(one.frames))[1]]
        off = 1e3 * fit.centroid_error_m(rest)[fit.predict(rest).object_share > DOMINATES]
        mad = float(np.median(np.abs(off - np.median(off))))
        found[f"{one.name}_centroid_mm"] = {"median": float(np.median(off)), "mad": mad, "n": len(off)}
        print(f"{one.name}: centroid of {len(off)} unseen zones: median {np.median(off):.2f} mm, MAD {mad:.2f} mm")
    draw_histograms(fit, objects, options.out / "histograms.png")
    rig = np.zeros(6)
    places = [[fit.parameters[f"{one.name}_{axis}"] for axis in ("x", "y", "z", "yaw")] for one in objects]
    rig[[0, 1, 2, 5]] = np.mean(places, axis=0)
    raised = {name: float(value) for name, _, value in (text.partition("=") for text in options.top)}
    mean_raise = float(np.mean([raised.get(one.name, 0.0) for one in objects]))
    tables = {}
    for one in objects:
        own = rig + np.array([0, 0, raised.get(one.name, 0.0) - mean_raise, 0, 0, 0])
        tables[one.name] = locate(fit, one, own, options.draws, rng)
        for row in tables[one.name]:
            print(one.name, {key: round(value, 2) for key, value in row.items()})
    draw_errors(tables, options.out / "error.png")
    found["poses"] = tables
    (options.out / "direct_sensor.json").write_text(json.dumps(found, indent=1), encoding="utf-8")
    return found


if __name__ == "__main__":
    main()
