"""The matcher in a world that is not quite its model's: what errors become, and whether the fit tells."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, Matches, kalman_filter
from phasemark.render import PhasorImages, Renderer, Sensor, Views, capture, preset

N_VIEWS = 400
DISTANCE_M = (0.8, 1.2)
CLASS = "cone"
POST_COLUMN, POST_BEFORE_M = 6, 0.4
FREE = ("distance_m", "delta_rad", "bearing_rad")


def tolerance(sensor: Sensor, seed: int) -> dict[str, Any]:
    """Change one thing at a time in what the frames are made with; the bank stays."""
    rng = np.random.default_rng(seed)
    views = Views.broadcast(rng.uniform(*DISTANCE_M, N_VIEWS), rng.uniform(0, math.pi, N_VIEWS))
    mesh = build_mesh(catalog()[CLASS])

    def seen(made_with: Sensor = sensor, size: float = 1.0, albedo: float = 0.8, **where: float) -> PhasorImages:
        moved = replace(views, **{name: np.full(N_VIEWS, value) for name, value in where.items()})
        scaled = mesh.copy()
        scaled.apply_scale(size)
        return Renderer(scaled, made_with, albedo=albedo).render_views(moved, workers=2)

    half = sensor.half_angle_h_deg, sensor.half_angle_v_deg
    wider = sensor.with_(half_angle_h_deg=1.005 * half[0], half_angle_v_deg=1.005 * half[1])
    real = preset("pmd-16x16-wiggle")
    aside = math.radians(0.5 * half[0])
    cases: list[tuple[str, Callable[[], PhasorImages], Sensor, dict[str, Any]]] = [
        ("as modelled", seen, sensor, {}),
        ("albedo 0.56, not 0.8", lambda: seen(albedo=0.56), sensor, {}),
        ("landmark 1 % larger", lambda: seen(size=1.01), sensor, {}),
        ("camera 1 cm lower", lambda: seen(height_m=0.01), sensor, {}),
        ("field of view 0.5 % wider", lambda: seen(wider), wider, {}),
        ("wiggling and fixed pattern", lambda: seen(real), real, {}),
        ("pitch 0.5°", lambda: seen(sensor.with_(pitch_deg=0.5)), sensor.with_(pitch_deg=0.5), {}),
        ("roll 0.5°", lambda: seen(sensor.with_(roll_deg=0.5)), sensor.with_(roll_deg=0.5), {}),
        ("partly out of view, bearing free", lambda: seen(bearing_rad=aside), sensor, {"free": FREE}),
        ("one column hidden by a post", lambda: behind_post(seen()), sensor, {}),
        ("the same, robust", lambda: behind_post(seen()), sensor, {"robust": True}),
    ]
    rows = []
    with tempfile.TemporaryDirectory() as folder, build_bank(BankPlan(), Path(folder) / "bank.h5") as bank:
        for title, make, made_with, options in cases:
            image = make()
            frames = capture(image, made_with, rng=rng, n_frames=50, workers=2)
            # the matcher believes in the bank's sensor
            believed = replace(kalman_filter(frames), sensor=sensor)
            rows.append(
                judged(title, Matcher(bank, "refine", **{"free": FREE[:2], **options}).match(believed), image.views)
            )
    return {
        "rows": rows,
        "note": f"{CLASS}, D {DISTANCE_M[0]} to {DISTANCE_M[1]} m, any δ, nothing behind, {N_VIEWS} views",
    }


def behind_post(image: PhasorImages) -> PhasorImages:
    """Let a bright post cover one column, from top to bottom."""
    ranges = image.views.distance_m[:, None] - POST_BEFORE_M
    light = 0.8 / ranges**2
    phasor, intensity = image.phasor.copy(), image.intensity.copy()
    phasor[:, :, POST_COLUMN] = light * np.exp(1j * ranges / image.sensor.metres_per_radian)
    intensity[:, :, POST_COLUMN] = light
    return replace(image, phasor=phasor, intensity=intensity)


def judged(title: str, matches: Matches, views: Views) -> dict[str, Any]:
    """Return errors of frames whose class was found, and what the fit says."""
    right = matches.class_name == CLASS
    distance = 1e3 * (matches.distance_m - views.distance_m)
    turn = matches.delta_rad - views.delta_rad
    delta = np.degrees(turn - math.pi * np.round(turn / math.pi))
    figures: dict[str, Any] = {"what is different": title, "class right": f"{right.mean():.1%}"}
    for name, error in (("D (mm)", distance[right]), ("δ (°)", delta[right])):
        figures[f"{name}: median"] = round(float(np.median(error)), 2) if error.size else ""
        figures[f"{name}: 95 % within ±"] = round(float(np.quantile(np.abs(error), 0.95)), 2) if error.size else ""
    figures["χ²/dof, median"] = round(float(np.median(matches.chi2 / np.maximum(matches.dof, 1))), 2)
    figures["accepted"] = f"{matches.accepted.mean():.1%}"
    return figures
