"""Fit a single-photon zone sensor to histograms of a plane, then locate objects by histograms from several poses.

``python examples/direct_sensor.py --data FOLDER --out out/direct``

FOLDER holds ``ladder.npz`` (histograms of a plane, ``distance_m``) and, for each object, ``NAME.npz`` (histograms,
``sensor2world``) with ``NAME.stl`` (object and table, metres): logs as `phasemark sensor fit-direct` reads them. The
data sets LCSPCData and SPAD-ICCP-Summer-School have recordings of this kind. Without ``--data`` one is simulated.

The fit sees every second distance of the plane and a quarter of the poses of each object. On what it has not seen, the
example prints how well ranges and centroids are predicted, draws predicted beside measured histograms, and locates each
object from 1, 4, 8 and 16 poses drawn at random: against where its own poses of the fit found it, and, as an object
that did not calibrate would be, against the mean of all objects. ``--others FOLDER`` locates the objects in recordings
of that folder instead, and the fit sees all poses of ``--data``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import trimesh
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phasemark.data.measured.histogram_logs import read_histograms, read_plane
from phasemark.matcher.histograms import (
    ModelError,
    ObjectScene,
    PoseCalibration,
    calibrate_poses,
    evidence_of,
    match_jointly,
    pose_covariance,
    solve_jointly,
)
from phasemark.render import Sensor, preset
from phasemark.render.direct import (
    DirectFit,
    HistogramFrames,
    ObjectRecording,
    SceneMesh,
    capture_histograms,
    expected_counts,
    fit_direct_sensor,
    footprint_grid,
    label_object,
    plane_samples,
    range_axis,
    support_height,
    world2cam,
    zone_transients,
)

NEAREST_M = 0.06
"""Nearer than this the sensor's own parallax and saturation decide."""
DOMINATES = 0.9
"""Share of a zone's light from which on the object counts as what the zone sees."""
POSES = (1, 4, 8, 16)
FREE = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad", "support")
INSIDE_95 = 12.592
"""95 % quantile of χ² with six degrees of freedom."""


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


def read_objects(folder: Path, base: Sensor) -> list[ObjectRecording]:
    """Return the objects of a folder, as a sensor's zones."""
    objects = []
    for path in sorted(folder.glob("*.stl")):
        mesh = trimesh.load(path)
        own = read_histograms(path.with_suffix(".npz"), sensor=base)
        objects.append(
            ObjectRecording(path.stem, own.frames, label_object(mesh, support_height(mesh)), own.sensor2world)
        )
    return objects


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
    fit: DirectFit, found: PoseCalibration, one: ObjectRecording, rest: NDArray[np.int64], name: str | None, draws: int,
    rng: np.random.Generator,
) -> list[dict[str, float]]:  # fmt: skip
    """Return errors of an object's pose from k poses that the fit has not seen, against where it should stand."""
    poses, place = fit.optical_poses(one.sensor2world), found.place(name)
    frames = HistogramFrames(one.frames.counts, sensor=fit.sensor, reference=one.frames.reference)
    scene = ObjectScene(one.mesh, fit.sensor)
    # one linearisation at that place serves all draws: errors are far smaller than a bin
    linear = scene.linearise(frames, poses, place, fit.parameters[f"{one.name}_support"], FREE)
    evidence = evidence_of(linear, frames.zone_counts, ModelError(0.05, 0.01))
    poisson = evidence_of(linear, frames.zone_counts)
    table = []
    for k in POSES:
        error, spread, inside, bound = [], [], [], []
        for _ in range(draws):
            chosen = rng.choice(rest, k, replace=False)
            seen = evidence.of_poses(chosen)
            step = solve_jointly(seen)[0][:6]
            covariance = np.nan_to_num(pose_covariance(seen, calibration=found, name=name)[0][:6, :6], posinf=1e6)
            error.append(step)
            spread.append(np.sqrt([np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])]))
            bound.append(np.trace(solve_jointly(poisson.of_poses(chosen))[1][:3, :3]))
            inside.append(step @ np.linalg.solve(covariance, step) <= INSIDE_95)
        shift = 1e3 * np.linalg.norm(np.array(error)[:, :3], axis=1)
        turn = np.degrees(np.linalg.norm(np.array(error)[:, 3:], axis=1))
        stated = np.median(spread, axis=0)
        table.append({
            "poses": k, "median_mm": float(np.median(shift)), "p90_mm": float(np.quantile(shift, 0.9)),
            "median_deg": float(np.median(turn)), "p90_deg": float(np.quantile(turn, 0.9)),
            "predicted_mm": float(1e3 * stated[0]), "predicted_deg": float(np.degrees(stated[1])),
            "inside_95": float(np.mean(inside)), "bound_mm": float(1e3 * np.sqrt(np.median(bound))),
        })  # fmt: skip
    return table


def search(
    fit: DirectFit, found: PoseCalibration, one: ObjectRecording, rest: NDArray[np.int64], rng: np.random.Generator
) -> None:
    """Print what a search from 6 mm and 2° away finds with a few poses."""
    chosen, place = rng.choice(rest, min(POSES[1], len(rest)), replace=False), found.place(one.name)
    frames = HistogramFrames(one.frames.counts, sensor=fit.sensor, reference=one.frames.reference)
    whole = match_jointly(
        frames[chosen], fit.optical_poses(one.sensor2world[chosen]), ObjectScene(one.mesh, fit.sensor),
        start=place + np.array([0.004, -0.004, 0.003, 0, 0, 0.04]), calibration=found, name=one.name,
    )  # fmt: skip
    off = whole.displacement - place
    print(
        f"{one.name}: searched from 6 mm and 2° away with {len(chosen)} poses: {1e3 * np.linalg.norm(off[:3]):.1f} mm,"
        f" {np.degrees(np.linalg.norm(off[3:])):.1f}° in {whole.steps} steps, chi2/dof {whole.chi2 / whole.dof:.2f}"
    )
    print("  1 sigma of x by term (mm):", {key: round(1e3 * t[0, 0] ** 0.5, 2) for key, t in whole.terms.items()})


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
    parser.add_argument("--others", type=Path, help="folder of other recordings of the objects, to be located")
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
    plane = read_plane(folder / "ladder.npz", sensor=preset("tmf8820-3x3"), nearest_m=NEAREST_M)
    objects = read_objects(folder, plane.frames.sensor)
    seen = [np.arange(len(one.frames)) if options.others else split(len(one.frames))[0] for one in objects]
    calibrating = [one[k] for one, k in zip(objects, seen, strict=True)]
    every_second = np.arange(0, len(plane.frames), 2)
    fit = fit_direct_sensor(
        plane[every_second], calibrating, base=plane.frames.sensor,
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
    calibration = calibrate_poses(fit, calibrating)
    errors = calibration.errors.as_fields()
    print("errors of the model, the arm and the mesh:", errors, f"sides left out: {calibration.left_out:.2f}")
    found["errors"] = {**errors, "left_out": calibration.left_out}
    known: dict[str, list[dict[str, float]]] = {}
    another: dict[str, list[dict[str, float]]] = {}
    for one in objects if options.others is None else read_objects(options.others, plane.frames.sensor):
        rest = split(len(one.frames))[1] if options.others is None else np.arange(len(one.frames))
        search(fit, calibration, one, rest, rng)
        for name, tables in ((one.name, known), (None, another)):
            tables[one.name] = locate(fit, calibration, one, rest, name, options.draws, rng)
            for row in tables[one.name]:
                print(one.name, "known" if name else "as another", {key: round(x, 2) for key, x in row.items()})
    draw_errors(known, options.out / "error.png")
    found |= {"poses": known, "poses_of_another": another}
    (options.out / "direct_sensor.json").write_text(json.dumps(found, indent=1), encoding="utf-8")
    return found


if __name__ == "__main__":
    main()
