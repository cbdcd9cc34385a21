"""Effect of each tuning number of the likelihood search on accuracy and on the number of rendered views."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.data import BankPlan, build_bank, open_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import FilteredFrames, Matcher, Matches, SearchPolicy, phasor_mean
from phasemark.render import Background, PhasorImages, Renderer, Sensor, Views, capture

FIXED = ("distance_m", "delta_rad")
WALL = Background(wall_m=4.0)
NO_SEARCH = (
    "frames_at_once",
    "cache_bytes",
    "tolerated_sigma",
    "ambiguity",
)
"""What decides what is searched, or accepted, but not how."""


@dataclass(frozen=True)
class Setting:
    """Conditions of a trial: the way frames are matched, and their number for each class."""

    title: str
    options: dict[str, Any]
    n_views: int
    bearing_std_rad: float = 0.0
    hidden: bool = False


SETTINGS = (
    Setting("no background", {"free": FIXED}, 100),
    Setting("wall", {"free": FIXED, "background": WALL}, 15),
    Setting("bearing with prior", {}, 6, bearing_std_rad=math.radians(1.5)),
    Setting("one column hidden, robust", {"free": FIXED, "robust": True}, 25, hidden=True),
)


def policy(sensor: Sensor, seed: int) -> dict[str, Any]:
    """Halve and double every number that steers the search, one at a time."""
    with tempfile.TemporaryDirectory() as folder:
        with build_bank(BankPlan(), Path(folder) / "bank.h5"):
            pass
        with open_bank(Path(folder) / "bank.h5") as bank:
            frames = {one.title: _frames(one, sensor, np.random.default_rng(seed)) for one in SETTINGS}
            usual = {one.title: _matched(bank, one, frames[one.title], SearchPolicy()) for one in SETTINGS}
            rows = []
            for field in fields(SearchPolicy):
                if field.name in NO_SEARCH:
                    continue
                for factor in (0.5, 2.0):
                    changed = _changed(field.default, factor)
                    if changed == field.default:
                        continue
                    row: dict[str, Any] = {"field": field.name, "factor": factor}
                    for one in SETTINGS:
                        found = _matched(bank, one, frames[one.title], replace(SearchPolicy(), **{field.name: changed}))
                        row |= _compared(one.title, found, usual[one.title])
                    rows.append(row)
                    print(row, flush=True)
    return {"rows": rows}


def _changed(value: Any, factor: float) -> Any:
    """Return a value scaled; counts stay whole."""
    if isinstance(value, int):
        return max(1, round(factor * value))
    return factor * value


def _frames(setting: Setting, sensor: Sensor, rng: np.random.Generator) -> list[FilteredFrames]:
    """Return filtered frames of every class, off the bank's grid."""
    n = setting.n_views
    parts = []
    for spec in catalog().values():
        views = Views.broadcast(
            rng.uniform(0.8, 1.6, n), rng.uniform(0, 2 * math.pi, n), setting.bearing_std_rad * rng.standard_normal(n)
        )
        renderer = Renderer(build_mesh(spec), sensor, albedo=0.8)
        image = renderer.render_views(views, background=setting.options.get("background"), workers=2)
        found = phasor_mean(capture(image, sensor, rng=rng, n_frames=50))
        if setting.hidden:
            found.range_m[:, :, 7] = 0.6
        parts.append(found)
    return parts


_WITH_SLOPES = 2.2
"""Time of a view with its slopes, over that of the view alone."""


@contextmanager
def _counted() -> Iterator[list[float]]:
    """Count the views that are rendered inside."""
    counts, plain, with_slopes = [0.0], Renderer.render_views, Renderer.render_with_slopes

    def counting(self: Renderer, views: Views, **options: Any) -> PhasorImages:
        counts[0] += len(views)
        return plain(self, views, **options)

    def counting_slopes(
        self: Renderer, views: Views, *parameters: Any, **options: Any
    ) -> tuple[PhasorImages, NDArray[np.complex128]]:
        counts[0] += _WITH_SLOPES * len(views)
        return with_slopes(self, views, *parameters, **options)

    Renderer.render_views, Renderer.render_with_slopes = counting, counting_slopes  # type: ignore[method-assign]
    try:
        yield counts
    finally:
        Renderer.render_views, Renderer.render_with_slopes = plain, with_slopes  # type: ignore[method-assign]


def _matched(bank: Any, setting: Setting, frames: list[FilteredFrames], search: SearchPolicy) -> tuple[Matches, float]:
    """Return the answers, and the views rendered for a frame."""
    # in one thread: views are counted
    matcher = Matcher(bank, "refine", policy=search, workers=1, **setting.options)
    with _counted() as counts:
        answers = Matches([match for part in frames for match in matcher.match(part)])
    return answers, counts[0] / len(answers)


def _compared(title: str, found: tuple[Matches, float], usual: tuple[Matches, float]) -> dict[str, Any]:
    """Return how many answers are worse or better by 1 in χ², how many more are accepted, and the share of views."""
    change: NDArray[np.float64] = np.nan_to_num(found[0].chi2 - usual[0].chi2)
    views = f"{found[1] / usual[1]:.2f}" if usual[1] else "-"
    return {
        f"{title}: worse, better": f"{np.sum(change > 1)}, {np.sum(change < -1)}",
        f"{title}: accepted": f"{int(found[0].accepted.sum()) - int(usual[0].accepted.sum()):+d}",
        f"{title}: views": views,
    }
