"""The matcher beside what people use today, on the same noisy frames: errors over the Cramér–Rao bound."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from phasemark.data import Bank, BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import FilteredFrames, Matcher, cramer_rao, kalman_filter
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.statistics import rms_interval, wrapped_errors
from phasemark.render import Background, Renderer, Sensor, Views, capture

N_VIEWS = 1000
DISTANCE_M = (0.9, 1.2)
START = (0.01, math.radians(5.0))
"""How far from the truth, in D and δ, registration is started: it finds the nearest minimum only."""
OUTLIER = 5.0
Estimates = np.ndarray  # (n, 2): D and δ


def matching(sensor: Sensor, seed: int) -> dict[str, Any]:
    """Compare errors with the bound, and times, for one class without and with a wall behind it."""
    mesh = build_mesh(catalog()["cylinder"])
    rng = np.random.default_rng(seed)
    truth = np.column_stack([rng.uniform(*DISTANCE_M, N_VIEWS), rng.uniform(0, math.pi, N_VIEWS)])
    views = Views.broadcast(*truth.T)
    started_at = truth + rng.choice([-1.0, 1.0], truth.shape) * START
    rows = []
    with tempfile.TemporaryDirectory() as folder, build_bank(BankPlan(), Path(folder) / "bank.h5") as bank:
        for title, background in (("none", None), ("wall at 4 m", Background(wall_m=4.0))):
            renderer = Renderer(mesh, sensor, albedo=0.8)
            image = renderer.render_views(views, background=background, workers=2)
            frames = kalman_filter(capture(image, sensor, rng=rng, n_frames=50, workers=2))
            bound = cramer_rao(renderer, views, background=background, workers=2)
            std = np.column_stack([bound.std("distance_m"), bound.std("delta_rad")])
            methods = [
                ("phasemark, refine", ours(Matcher(bank, "refine", free=VIEW[:2], background=background), frames)),
                ("phasemark, nearest", ours(Matcher(bank, background=background), frames)),
                ("scikit-learn, nearest neighbour", neighbours(bank, frames, background)),
                ("Open3D, point-to-plane ICP", registration(mesh, frames, started_at)),
            ]
            rows += [row(title, name, method, truth, std) for name, method in methods if method is not None]
    return {
        "rows": rows,
        "note": f"cylinder, D {DISTANCE_M[0]} to {DISTANCE_M[1]} m, any δ, {N_VIEWS} views of 50 exposures; median of "
        f"|error| over the bound's (0.6745 σ), and r.m.s. of errors below {OUTLIER:g} bounds; ICP started "
        f"{100 * START[0]:g} cm and {math.degrees(START[1]):g}° from the truth",
    }


def row(
    background: str, name: str, method: Callable[[], Estimates], truth: np.ndarray, std: np.ndarray
) -> dict[str, Any]:
    """Run a method once unseen and once timed, and compare its errors with the bound."""
    method()
    began = time.perf_counter()
    estimate = method()
    seconds = time.perf_counter() - began
    error = wrapped_errors(estimate - truth, VIEW[:2], math.pi)
    scaled = np.abs(error / std)
    inner = (scaled < OUTLIER).all(axis=1)
    figures: dict[str, Any] = {"background": background, "method": name}
    for k, symbol in enumerate("Dδ"):
        figures[f"{symbol}: median"] = round(float(np.nanmedian(scaled[:, k])) / 0.6745, 2)
    for k, symbol in enumerate("Dδ"):
        ratio = rms_interval(scaled[inner, k]) if inner.sum() > 1 else None
        figures[f"{symbol}: r.m.s."] = "" if ratio is None else round(ratio.value, 2)
    figures["beyond 5 bounds"] = f"{1 - inner.mean():.1%}"
    figures["ms a frame"] = float(f"{1e3 * seconds / len(truth):.2g}")
    return figures


def ours(matcher: Matcher, frames: FilteredFrames) -> Callable[[], Estimates]:
    """Match with the program itself."""

    def run() -> Estimates:
        matches = matcher.match(frames)
        return np.column_stack([matches.distance_m, matches.delta_rad])

    return run


def neighbours(bank: Bank, frames: FilteredFrames, background: Background | None) -> Callable[[], Estimates] | None:
    """Match ranges of the lower half with the bank's, Euclidean; where nothing returns, the range counts as 0."""
    try:
        from sklearn.neighbors import NearestNeighbors
    except ImportError:
        return None
    assert bank.lower is not None
    sensor = bank.sensor
    phasor = bank.lower.phasor.astype(np.complex128)
    if background is not None:
        behind = Renderer(None, sensor).render_views(Views.broadcast(1.0), background=background)
        rows = slice(*sensor.lower_rows)
        phasor = phasor + (1 - bank.lower.coverage) * behind.phasor[0, rows]
    ranges = np.angle(phasor.reshape(-1, phasor.shape[-2] * phasor.shape[-1])) % (2 * np.pi)
    table = np.where(np.abs(phasor.reshape(ranges.shape)) > 0, ranges * sensor.metres_per_radian, 0.0)
    # a bank's image has light in pixels the sensor would refuse: those of a hundredth of the brightest
    dim = np.abs(phasor.reshape(ranges.shape))
    table[dim < 0.01 * dim.max(axis=1, keepdims=True)] = 0.0
    seen = np.nan_to_num(frames.range_m[:, slice(*sensor.lower_rows)].reshape(len(frames), -1))
    n_delta = len(bank.delta_rad)
    index = NearestNeighbors(n_neighbors=1, algorithm="brute").fit(table)

    def run() -> Estimates:
        best = index.kneighbors(seen, return_distance=False)[:, 0]
        return np.column_stack([bank.distance_m[best // n_delta], bank.delta_rad[best % n_delta]])

    return run


def registration(mesh: Any, frames: FilteredFrames, started_at: np.ndarray) -> Callable[[], Estimates] | None:
    """Register each frame's points with the landmark's surface by Open3D, from a start near the truth."""
    try:
        import open3d
    except (ImportError, OSError):
        return None
    rays = frames.sensor.pixel_directions()
    points, faces = mesh.sample(20_000, return_index=True, seed=1)
    surface = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    surface.normals = open3d.utility.Vector3dVector(mesh.face_normals[faces])
    register = open3d.pipelines.registration
    method = register.TransformationEstimationPointToPlane()
    starts = []
    for distance, delta in started_at:
        rotation, translation = Views.broadcast(distance, delta).landmark2cam()
        start = np.eye(4)
        start[:3, :3] = rotation[0].T
        start[:3, 3] = -rotation[0].T @ translation[0]
        starts.append(start)

    def run() -> Estimates:
        out = np.empty((len(frames), 2))
        for k, range_m in enumerate(frames.range_m):
            near = np.isfinite(range_m) & (range_m < DISTANCE_M[1] + 0.3)  # what is farther is the wall
            cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(rays[near] * range_m[near][:, None]))
            lens = register.registration_icp(cloud, surface, 0.05, starts[k], method).transformation[:3, 3]
            out[k] = math.hypot(lens[0], lens[1]), math.atan2(-lens[1], -lens[0])
        return out

    return run
