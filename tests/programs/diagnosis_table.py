"""Count how often the diagnosis of a refused frame names the known cause of its refusal.

usage: python -m programs.diagnosis_table --sensor pmd-16x16 --frames 10 --seed 1

Each frame of a cone or a post, 0.7 to 1.1 m away, is spoiled in one way: its camera looks aside, up or down, is turned
about its axis or mounted at another height; a wall stands in view that is not stated, or is stated and not there; a
post stands beside the landmark; the image is mirrored, upside down or turned; its unit, its quantity or the field of
view is another one; the view lies beyond the bank. Of each cause it prints how many frames were refused, and how many
named it.
"""

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.data import BankPlan, build_bank
from phasemark.data.measured.recording import Orientation
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import FilteredFrames, Matcher, diagnose, kalman_filter
from phasemark.matcher.diagnosis import Diagnosis
from phasemark.matcher.filters.filtered_frames import PixelState
from phasemark.matcher.statistics import binomial_interval
from phasemark.render import Background, Renderer, Sensor, capture, preset

CLASSES = "cone", "post"
DISTANCE = "0.6:1.2:0.02"


class Spoiled(NamedTuple):
    """A frame with the cause of its refusal, the options of its matcher, and what a diagnosis may name."""

    cause: str
    frame: FilteredFrames
    options: dict[str, Any]
    names: set[str]


def spoiled(sensor: Sensor, rng: np.random.Generator) -> Iterator[Spoiled]:
    """Yield one frame of a random view for every cause."""
    renderers = {name: Renderer(build_mesh(catalog()[name]), sensor, albedo=0.8) for name in CLASSES}
    name = str(rng.choice(CLASSES))
    distance_m, delta_rad = rng.uniform(0.7, 1.1), rng.uniform(-math.pi, math.pi)

    def taken(*view: float, by: Sensor = sensor, background: Background | None = None) -> FilteredFrames:
        """Return the filtered frames of a view, D, δ, bearing, height, pitch and roll."""
        renderer = renderers[name] if by is sensor else Renderer(build_mesh(catalog()[name]), by, albedo=0.8)
        return kalman_filter(capture(renderer.render(*view, background=background), by, rng=rng, n_frames=50))

    def beside(low: float, high: float) -> float:
        """Return a random number of either sign."""
        return float(rng.uniform(low, high) * rng.choice([-1, 1]))

    view = distance_m, delta_rad
    wall = Background(wall_m=distance_m + rng.uniform(0.5, 1.5))
    fixed = {"free": ("distance_m", "delta_rad")}
    aside, up, about = (math.radians(beside(low, high)) for low, high in ((1, 3), (1, 4), (2, 6)))
    yield Spoiled("bearing", taken(*view, aside), fixed, {"free", "bearing_offset_deg"})
    yield Spoiled("pitch", taken(*view, 0, 0, up), {}, {"pitch_rad"})
    yield Spoiled("roll", taken(*view, 0, 0, 0, about), {}, {"roll_rad"})
    yield Spoiled("height", taken(*view, 0, beside(0.02, 0.06)), {}, {"height_m"})
    yield Spoiled("wall not stated", taken(*view, background=wall), {}, {"background"})
    yield Spoiled("wall that is not there", taken(*view), {"background": wall}, {"background"})
    yield Spoiled("post beside", with_post(taken(*view), rng, distance_m), {}, {"background"})
    turned = {
        "mirrored": Orientation(flip_h=True),
        "upside down": Orientation(flip_h=True, rotate=180),
        "turned": Orientation(rotate=90),
    }
    for cause, orientation in turned.items():
        moved = taken(*view).with_pixels(orientation.apply)
        yield Spoiled(cause, moved, {}, {"flip_h", "flip_v", "rotate"})
    yield Spoiled("unit", scaled(taken(*view), rng.choice([1e-3, 0.1, 10])), {}, {"unit_factor"})
    cosine = sensor.axis_cosine() ** rng.choice([-1, 1])
    yield Spoiled("quantity", scaled(taken(*view), cosine), {}, {"quantity"})
    factor = rng.choice([0.85, 0.9, 1.1, 1.15])
    wide = sensor.with_(
        half_angle_h_deg=factor * sensor.half_angle_h_deg, half_angle_v_deg=factor * sensor.half_angle_v_deg
    )
    yield Spoiled("field of view", replace(taken(*view, by=wide), sensor=sensor), {}, {"half_angle_deg"})
    beyond_m = rng.choice([rng.uniform(0.42, 0.52), rng.uniform(1.3, 1.6)])
    yield Spoiled("distance", taken(float(beyond_m), delta_rad), {}, {"distance_m"})


def scaled(frame: FilteredFrames, factor: float | NDArray[np.float64]) -> FilteredFrames:
    """Return a frame whose ranges were read with another unit or as another quantity."""
    std_m = frame.std_m * factor if frame.std_from_scatter else frame.std_m
    return replace(frame, range_m=frame.range_m * factor, std_m=std_m)


def with_post(frame: FilteredFrames, rng: np.random.Generator, distance_m: float) -> FilteredFrames:
    """Return a frame with a post a little nearer than the landmark at one side of the image, a fifth of it wide."""
    width = max(frame.sensor.cols // 5, 1)
    cols = slice(0, width) if rng.random() < 0.5 else slice(frame.sensor.cols - width, None)
    post: dict[str, float] = {"range_m": distance_m - rng.uniform(0.05, 0.15), "state": PixelState.RETURN}
    changed: dict[str, Any] = {}
    for name in ("range_m", "std_m", "amplitude_e", "intensity_e", "state", "n_effective"):
        values = getattr(frame, name)
        if values is not None:
            changed[name] = values.copy()
            changed[name][..., cols] = post.get(name, np.nanmedian(values))
    return replace(frame, **changed)


def named(diagnosis: Diagnosis, matcher: Matcher) -> set[str]:
    """Return what a diagnosis names: settings, and numbers of the view that would have to be free."""
    names: set[str] = set()
    for change in (*diagnosis.changes, *diagnosis.alternatives):
        names.add(change.parameter)
        if change.parameter == "free":
            names |= set(change.value) - set(matcher.free)
    return names


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="pmd-16x16")
    parser.add_argument("--frames", type=int, default=10, help="of each cause")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    sensor, rng = preset(options.sensor), np.random.default_rng(options.seed)
    counts: dict[str, list[int]] = {}
    begun = time.process_time()
    with build_bank(BankPlan(sensor=options.sensor, classes=CLASSES, distance_m=DISTANCE)) as bank:
        for _ in range(options.frames):
            for one in spoiled(sensor, rng):
                matcher = Matcher(bank, "refine", **one.options)
                count = counts.setdefault(one.cause, [0, 0, 0])
                refused = not matcher.match(one.frame)[0].accepted
                is_named = bool(refused and named(diagnose(matcher, one.frame, 0), matcher) & one.names)
                counts[one.cause] = [a + b for a, b in zip(count, (1, refused, is_named), strict=True)]
    for cause, (n, n_refused, n_named) in counts.items():
        print(f"{cause}: {n} frames, {n_refused} refused, {n_named} named")
    total = [sum(own[k] for own in counts.values()) for k in (2, 1)]
    low = binomial_interval(*total).low
    spent_s = time.process_time() - begun
    print(f"all: {total[0]} of {total[1]} named, at least {low:.1%}; {spent_s:.0f} s of processor time")


if __name__ == "__main__":
    main()
