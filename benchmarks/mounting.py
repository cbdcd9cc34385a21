"""Benchmark of calibrating a mounting on 50 poses, and of designing a landmark."""

from __future__ import annotations

import json
import math
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher.calibration import KnownPoses, Mounting, filter_poses
from phasemark.matcher.calibration.mounting import NAMES
from phasemark.matcher.calibration.mounting_model import STEP, CalibrationModel
from phasemark.matcher.calibration.still_fit import StillFit
from phasemark.matcher.likelihood.residuals import Evidence, ResidualKind
from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render import Frames, Renderer, Views, capture, preset

SENSOR = preset("pmd-16x16")
MESH = build_mesh(catalog()["cylinder"])
POSES, FRAMES, ALBEDO = 50, 50, 0.8
COMMAND = "import sys; from phasemark.cli import main; sys.exit(main(sys.argv[1:]))"


def mounting() -> dict[str, Any]:
    """Time ``phasemark calibrate`` in a process of its own, its fit alone, and the same residuals in SciPy's solver."""
    rows = []
    frames, poses = recording(np.random.default_rng(2005))
    quantities: tuple[ResidualKind, ...] = ("phasors", "ranges")
    with tempfile.TemporaryDirectory() as folder:
        whole = {on: command_seconds(Path(folder), frames, poses, on) for on in quantities}
    for on in quantities:
        filtered = filter_poses([frames[k : k + 1] for k in range(POSES)], on)
        evidence = Evidence.from_frames(filtered, on)
        model = CalibrationModel(MESH, SENSOR, poses, albedo=ALBEDO)
        fit = StillFit(model, evidence, NAMES if on == "phasors" else NAMES[:-1], edges=True)
        begun = time.process_time()
        start = fit.start(Mounting.of_sensor(SENSOR, ALBEDO).vector)
        use = fit.pixels(model.images(start))
        started = time.process_time()
        found = fit.search(fit.solve(start, use))
        fit.knowledge(found)
        seconds = time.process_time() - started
        theirs, their_cost = peer(fit, start, found.use)
        rows.append(
            {
                "50 poses of 50 frames": on,
                "command (s)": round(statistics.median(whole[on]), 1),
                "registration (processor s)": round(started - begun, 1),
                "likelihood (processor s)": round(seconds, 1),
                "SciPy's least_squares, over ours": round(theirs / seconds, 1),
                "its χ² less ours": round(their_cost - found.cost, 1),
            }
        )
    return {"rows": rows}


def design() -> dict[str, Any]:
    """Run ``phasemark landmark design`` on its default plan, confirmation included."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", COMMAND, "landmark", "design", "--json", "--out", str(Path(folder) / "design")]
        before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        seconds, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    facts = json.loads(done.stdout)
    factor = facts["confirmation"]["worst_rmse_factor"]
    row = {
        "landmarks": len(facts["result"]["landmarks"]),
        "seconds": round(seconds),
        "processor seconds": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime),
        "worst position bound, over the catalogue's": f"1 / {facts['bound_factor']:.2f}",
        "worst error of simulated frames": "1 / {value:.2f} [{low:.2f}, {high:.2f}]".format(**factor),
    }
    return {"rows": [row]}


def recording(rng: np.random.Generator) -> tuple[Frames, KnownPoses]:
    """Return frames of 50 poses from a camera that is not mounted as thought."""
    poses = KnownPoses.polar(
        rng.uniform(0.8, 1.8, POSES), rng.uniform(0, 2 * math.pi, POSES), np.radians(rng.uniform(-4, 4, POSES))
    )
    thought = Mounting.of_sensor(SENSOR, ALBEDO)
    truth = replace(
        thought, pitch_rad=0.02, roll_rad=-0.01, height_m=0.015, bearing_rad=0.012, range_offset_m=0.03,
        half_angle_h_rad=thought.half_angle_h_rad - 0.004, half_angle_v_rad=thought.half_angle_v_rad + 0.003,
    )  # fmt: skip
    image = Renderer(MESH, truth.on(SENSOR), albedo=ALBEDO).render_views(
        Views(poses.distance_m, poses.delta_rad, poses.bearing_rad, poses.height_m)
    )
    frames = capture(image, truth.on(SENSOR), rng=rng, n_frames=FRAMES)
    return Frames(frames.range_m, frames.amplitude_e, frames.intensity_e, flags=frames.flags, sensor=SENSOR), poses


def command_seconds(folder: Path, frames: Frames, poses: KnownPoses, on: ResidualKind, runs: int = 3) -> list[float]:
    """Return wall clock seconds of whole commands, program start, files and figure included."""
    path, csv = folder / "frames.npz", folder / "poses.csv"
    np.savez(
        path, range=frames.range_m, amplitude=frames.amplitude_e, intensity=frames.intensity_e, unit="m",
        quantity="range",
    )  # fmt: skip
    rows = np.column_stack([poses.distance_m, np.degrees(poses.delta_rad), np.degrees(poses.bearing_rad)])
    np.savetxt(csv, rows, fmt="%.9f", delimiter=",", header="distance_m,delta_deg,bearing_deg", comments="")
    command = [
        sys.executable, "-c", COMMAND, "calibrate", "cylinder", str(path), "--poses", str(csv), "--on", on, "--force",
        "--out", str(folder / "mounted.toml"),
    ]  # fmt: skip
    seconds = []
    for _ in range(runs):
        started = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        seconds.append(time.perf_counter() - started)
    return seconds


def peer(fit: StillFit, start: np.ndarray, use: np.ndarray) -> tuple[float, float]:
    """Return processor seconds of SciPy's trust region solver on the same residuals and steps, and where it ended."""
    evidence, scale = fit.evidence, fit.scale
    root = np.sqrt(np.where(use, evidence.weight, 0.0))

    def residual(x: np.ndarray) -> np.ndarray:
        theta = start.copy()
        theta[fit.columns] += (x - 1) * scale
        phasor = fit.model.images(theta).phasor
        if evidence.on == "ranges":
            turned = np.angle(evidence.value * phasor.conj())
            lost = np.sqrt(DISAGREEMENT) * use
            return np.where(phasor == 0, lost, evidence.sensor.metres_per_radian * turned * root).ravel()
        difference = (evidence.value - phasor) * root
        return np.concatenate([difference.real, difference.imag]).ravel()

    started = time.process_time()
    found = least_squares(residual, np.ones(len(scale)), jac="3-point", diff_step=STEP / scale)  # relative to ones
    return time.process_time() - started, 2 * float(found.cost)
