"""Compile beforehand what numba compiles: the first image and the first match wait for it, once."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np

from phasemark import UsageError
from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.filters.mean_phasor import phasor_mean
from phasemark.matcher.matcher import Matcher
from phasemark.render import Background, Renderer, Views, capture, preset
from phasemark.render.direct import HistogramRenderer, capture_histograms

__all__ = ["Work", "warm"]

Work = Literal["render", "match", "histograms"]
"""What is compiled for: images and simulated frames; matching them; images and matching of photon histograms."""

_MESH = "cylinder"
_GRID: dict[str, Any] = {"distance_m": "0.9:1.1:0.02", "delta_deg": "0:180:4"}
_BEHIND = Background(wall_m=3.0, floor_m=0.5)


def warm(work: Work) -> None:
    """Compile what some work needs, and keep it, by doing a little of it.

    Parameters
    ----------
    work : {"render", "match", "histograms"}

    Raises
    ------
    UsageError
        There is no such work.
    """
    if work not in get_args(Work):
        raise UsageError(f"'{work}' is no work to compile for: {', '.join(get_args(Work))}")
    {"render": _render, "match": _match, "histograms": _histograms}[work]()


def _render() -> None:
    renderer, rng = Renderer(build_mesh(catalog()[_MESH]), preset("pmd-16x16")), np.random.default_rng(0)
    renderer.jacobian(1.0, 0.3, background=_BEHIND)
    frames = capture(renderer.render(1.0, 0.3, background=_BEHIND), renderer.sensor, rng=rng, n_frames=3)
    kalman_filter(frames)
    phasor_mean(frames)


def _match() -> None:
    renderer, rng = Renderer(build_mesh(catalog()[_MESH]), preset("pmd-16x16")), np.random.default_rng(0)
    plan = BankPlan(classes=(_MESH, "cone"), **_GRID)
    with build_bank(plan, workers=1) as bank:
        for behind in (None, _BEHIND):
            image = renderer.render(1.0, 0.3, background=behind)
            frames = kalman_filter(capture(image, renderer.sensor, rng=rng, n_frames=50))
            for on in ("ranges", "phasors"):
                Matcher(bank, "refine", on=on, background=behind, workers=1).match(frames)
            Matcher(bank, "refine", free=("distance_m", "delta_rad"), background=behind, workers=1).match(frames)


def _histograms() -> None:
    sensor, rng = preset("vl53l5cx-8x8"), np.random.default_rng(0)
    image = HistogramRenderer(build_mesh(catalog()[_MESH]), sensor).expected(Views.broadcast(1.0, 0.3))
    plan = BankPlan(classes=(_MESH, "cone"), sensor="vl53l5cx-8x8", **_GRID)
    with build_bank(plan, workers=1) as bank:
        frames = capture_histograms(image, sensor, rng=rng, n_frames=10)
        for on in ("histograms", "targets"):
            Matcher(bank, "refine", on=on, workers=1).match(frames if on == "histograms" else frames.targets)
