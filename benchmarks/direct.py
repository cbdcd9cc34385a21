"""Benchmark of a direct sensor: capture of histograms, and matching of one class and of four."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, kalman_filter
from phasemark.render import Background, Views, capture, preset
from phasemark.render.direct import HistogramRenderer
from phasemark.render.direct.capture import capture_ranges

SENSOR = "vl53l5cx-8x8"
N_FRAMES, N_SINGLE = 400, 30


def direct(seed: int, median_seconds: Callable[..., float]) -> dict[str, Any]:
    """Time what becomes of histograms of 8 × 8 zones and 128 bins; threads as many as there are processors."""
    sensor = preset(SENSOR)
    rng = np.random.default_rng(seed)
    views = Views.broadcast(rng.uniform(0.8, 1.2, N_FRAMES), rng.uniform(0.0, math.pi, N_FRAMES))
    rows = []

    def add(what: str, seconds: float, n: int = N_FRAMES, first: float | str = "") -> None:
        rows.append({"what": what, "frames/s": float(f"{n / seconds:.3g}"), "first frame (s)": first})

    renderer = HistogramRenderer(build_mesh(catalog()["cone"]), sensor)
    add("expected histograms of views", median_seconds(lambda: renderer.render_views(views)))
    images = renderer.render_views(views)
    add("capture", median_seconds(lambda: capture(images, sensor, rng=np.random.default_rng(seed))))
    frames = capture(images, sensor, rng=rng)
    with tempfile.TemporaryDirectory() as folder:
        for classes in (("cone",), ("cylinder", "cone", "sphere", "post")):
            plan = BankPlan(
                classes=classes,
                distance_m="0.75:1.25:0.02",
                delta_deg="0:180:2",
                sensor_overrides=sensor.model_dump(mode="json"),
            )
            with build_bank(plan, Path(folder) / f"{len(classes)}.h5") as bank:
                for on in ("histograms", "targets"):
                    matcher = Matcher(bank, "refine", on=on, free=("distance_m", "delta_rad"))
                    start = time.perf_counter()
                    matcher.match(frames[:1])
                    first = time.perf_counter() - start
                    what = f"matching on {on}, {len(classes)} class{'es' if classes[1:] else ''}"
                    add(what, median_seconds(lambda m=matcher: m.match(frames), 3), first=round(first, 1))
    add(
        "one frame as the chip reports it, alone, from array to pose",
        float(np.median(seconds_of_single_frames(rng))),
        1,
    )
    return {"rows": rows}


def seconds_of_single_frames(rng: np.random.Generator) -> list[float]:
    """Return how long frames of a cone before a wall take by themselves, in one thread, as the chip reports them."""
    sensor, n = preset(SENSOR), N_SINGLE
    aside, up = rng.normal(0, 0.03, (2, n))
    views = Views.broadcast(rng.uniform(0.45, 0.9, n), rng.uniform(0.0, 2 * math.pi, n), aside, 0.0, up)
    wall = Background(wall_m=2.0)
    frames = capture_ranges(build_mesh(catalog()["cone"]), sensor, views, background=wall, rng=rng)
    seconds = []
    with build_bank(BankPlan(sensor=SENSOR, classes=("cone",), distance_m="0.3:1.2:0.01")) as bank:
        matcher = Matcher(bank, "refine", on="reported", workers=1)
        matcher.match(kalman_filter(frames[:1]))
        for k in range(n):
            start = time.perf_counter()
            matcher.match(kalman_filter(frames[k : k + 1]))
            seconds.append(time.perf_counter() - start)
    return seconds
