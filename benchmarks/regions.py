"""Benchmark of adding up the pixels of a large camera: accuracy lost, bytes and time saved."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from phasemark.data import BankPlan
from phasemark.data.plans import planned_size
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import cramer_rao
from phasemark.render import Renderer, Sensor, Views
from phasemark.render.sensor.region import Region

BINNING = (1, 2, 4, 7)
N_VIEWS = 24


def regions(sensor: Sensor, seed: int) -> dict[str, Any]:
    """Compare the bound, the time of a view and the size of a bank, by binning."""
    large = sensor.with_(
        rows=168, cols=224, half_angle_h_deg=31.0, half_angle_v_deg=22.5, signal_e=sensor.signal_e / 20
    )
    rng = np.random.default_rng(seed)
    views = Views.broadcast(rng.uniform(0.8, 1.8, N_VIEWS), rng.uniform(0, np.pi, N_VIEWS))
    rows = []
    for n in BINNING:
        camera = Region(0, large.rows, 0, large.cols, n).camera(large)
        std, seconds = [], []
        for name in ("cone", "post"):
            renderer = Renderer(build_mesh(catalog()[name]), camera)
            renderer.render_views(views[:2])
            start = time.perf_counter()
            renderer.render_views(views)
            seconds.append((time.perf_counter() - start) / N_VIEWS)
            covariance = cramer_rao(renderer, views, n_frames=50).covariance
            std.append(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
        plan = BankPlan(
            classes=("cone",),
            sensor_overrides=large.model_dump(mode="json"),
            region="landmark",
            binning=n,
            layout="full",
        )
        across = np.median(np.concatenate(std), axis=0)
        rows.append(
            {
                "binning": n,
                "pixels": f"{camera.cols} × {camera.rows}",
                "σ of D (mm)": round(1e3 * across[0], 4),
                "σ of δ (°)": round(float(np.degrees(across[1])), 4),
                "one view (ms)": round(1e3 * float(np.mean(seconds)), 2),
                "bank of 25 380 images, landmark alone (MB)": round(planned_size(plan)["bytes"] / 1e6),
            }
        )
    return {"rows": rows}
