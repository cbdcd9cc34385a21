"""Plan of a frame set: landmarks, a camera, and the distribution of views over distance, angle and the rest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BeforeValidator,
    Field,
    PlainSerializer,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    WithJsonSchema,
    model_serializer,
    model_validator,
)
from scipy import special

from phasemark import UsageError
from phasemark.data.files.narrow import narrowed
from phasemark.data.plans.bank_plan import MeshPlan, PlanModel, ScenePlan, find_symmetries
from phasemark.data.seeds import stream
from phasemark.landmarks import LandmarkSpec
from phasemark.render.view import FARTHEST_M

KINDS = ("fixed", "uniform", "normal", "sobol")
_DEFAULT_SPLITS = {"train": 0.8, "val": 0.1, "test": 0.1}
MOST_SPLITS = 256
"""The number of a view's split is a byte in the file."""
Variant = Literal["hard", "mixed", "shot"]

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Pair = tuple[_Finite, _Finite]


class Distribution(PlanModel):
    """Distribution of a quantity over the views: exactly one of the four.

    Parameters
    ----------
    fixed : float
        One value for all views; in a plan the number alone means the same.
    uniform : (low, high)
        Drawn uniformly between the two, for each view by itself.
    normal : (mean, standard deviation)
        Drawn from a normal distribution, for each view by itself.
    sobol : (low, high)
        Uniform between the two, from one scrambled Sobol sequence over all quantities that ask for it: the views fill
        their product more evenly than independent draws would.
    within : (low, high), optional
        Only with `normal`: limits beyond which no value is drawn.
    """

    fixed: _Finite | None = None
    uniform: _Pair | None = None
    normal: _Pair | None = None
    sobol: _Pair | None = None
    within: _Pair | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        given = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(given) != 1:
            raise UsageError(f"must be a number or have one of {', '.join(KINDS)}, got {', '.join(given) or 'none'}")
        for name in ("uniform", "sobol", "within"):
            pair = getattr(self, name)
            if pair is not None and not pair[0] <= pair[1]:
                raise UsageError(f"'{name}' must be [low, high] with low ≤ high, got {list(pair)}")
        if self.normal is not None and self.normal[1] < 0:
            raise UsageError(f"the standard deviation of 'normal' must not be negative, got {self.normal[1]}")
        if self.within is not None and self.normal is None:
            raise UsageError("'within' cuts the tails of 'normal': it stands for nothing without it")
        if self.within is not None and self.normal is not None and not _share_within(self.within, *self.normal) > 0:
            raise UsageError(f"no draw of 'normal' = {list(self.normal)} lies 'within' = {list(self.within)}")
        return self

    @property
    def limits(self) -> tuple[float, float]:
        """The least and the largest value that can be drawn."""
        if self.fixed is not None:
            return self.fixed, self.fixed
        if self.normal is not None:
            mean, std = self.normal
            return self.within or ((-math.inf, math.inf) if std else (mean, mean))
        pair = self.uniform or self.sobol
        assert pair is not None
        return pair

    @property
    def lowest(self) -> float:
        """The least value that can be drawn."""
        return self.limits[0]

    @property
    def highest(self) -> float:
        """The largest value that can be drawn."""
        return self.limits[1]

    def values(self, share: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values below which the shares `share`, in (0, 1), of all draws lie."""
        if self.normal is None:
            low, high = self.limits
            return low + (high - low) * share
        mean, std = self.normal
        if self.within is None or std == 0:
            return np.asarray(mean + std * special.ndtri(share))
        low, high = ((bound - mean) / std for bound in self.within)
        if low > 0:  # shares above the mean are rounded to 1: the other tail is exact
            low, high, share, std = -high, -low, 1 - share, -std
        below = special.ndtr(low)
        return np.clip(mean + std * special.ndtri(below + (special.ndtr(high) - below) * share), *self.within)


def _share_within(within: tuple[float, float], mean: float, std: float) -> float:
    """Return how much of a normal is left within its limits."""
    if std == 0:
        return float(within[0] <= mean <= within[1])
    if within[0] == within[1]:  # all draws are clipped to one value
        return 1.0
    low, high = ((bound - mean) / std for bound in within)
    return float(special.ndtr(-low) - special.ndtr(-high) if low > 0 else special.ndtr(high) - special.ndtr(low))


def _to_distribution(value: Any, info: ValidationInfo) -> Any:
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = {"fixed": value}
    if value is not None and not isinstance(value, Mapping | Distribution):
        kinds = ", ".join(KINDS)
        raise UsageError(f"'{info.field_name}' must be a number or a table with one of {kinds}, got {value!r}")
    if isinstance(value, Mapping):
        try:
            return Distribution(**value)
        except UsageError as error:
            raise UsageError(f"'{info.field_name}': {error}") from None
    return value


def _to_plain(value: Distribution | None) -> Any:
    if value is None:
        return None
    if value.fixed is not None:
        return value.fixed
    return {k: list(v) for k in (*KINDS, "within") if (v := getattr(value, k)) is not None}


_PAIR_SCHEMA = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
SPREAD_SCHEMA = {
    "description": "a number, or how the quantity is spread over the views",
    "anyOf": [
        {"type": "number"},
        {
            "type": "object",
            "additionalProperties": False,
            "properties": {
                "fixed": {"type": "number"},
                **dict.fromkeys(("uniform", "normal", "sobol", "within"), _PAIR_SCHEMA),
            },
        },
    ],
}
_FORM = (BeforeValidator(_to_distribution), PlainSerializer(_to_plain), WithJsonSchema(SPREAD_SCHEMA))
_Spread = Annotated[Distribution, *_FORM]
_MaybeSpread = Annotated[Distribution | None, *_FORM]
_Share = Annotated[float, Field(ge=0, le=1)]
FramesPerView = Annotated[int, Field(ge=1, le=2**31 - 1)]
Seed = Annotated[int, Field(ge=0, le=2**64 - 1)]
Splits = dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")], _Share]


def default_splits() -> Any:
    """Return the field of a plan that holds the splits."""
    return Field(default_factory=_DEFAULT_SPLITS.copy, json_schema_extra={"default": {**_DEFAULT_SPLITS}})


def check_splits(splits: Mapping[str, float]) -> None:
    """Refuse shares that do not add up to 1, and more splits than have numbers."""
    if not splits or abs(sum(splits.values()) - 1) > 1e-9:
        raise UsageError(f"'splits' must be shares that add up to 1, got {splits}")
    if len(splits) > MOST_SPLITS:
        raise UsageError(f"'splits' must be at most {MOST_SPLITS}, got {len(splits)}")


def split_of_views(seed: int, splits: Mapping[str, float], start: int, stop: int) -> NDArray[np.int64]:
    """Return the numbers of the splits of some views."""
    ends = np.cumsum(list(splits.values()))
    return np.minimum(np.searchsorted(ends, _uniform(seed, "split", start, stop), side="right"), len(ends) - 1)


def _uniform(seed: int, purpose: str, start: int, stop: int) -> NDArray[np.float64]:
    """Return numbers in (0, 1), one a view: number `start` of a stream, and those that follow."""
    rng = stream(seed, f"frames.{purpose}", 0)
    skipped, offset = divmod(start, 4)  # Philox counts blocks of four numbers
    rng.bit_generator.advance(skipped)  # type: ignore[attr-defined]
    return np.maximum(rng.random(stop - start + offset)[offset:], 2.0**-54)


TILT = ("pitch_deg", "roll_deg")
"""Quantities that a plan of a level camera does not have."""
QUANTITIES = ("distance_m", "delta_deg", "bearing_deg", "height_m", "albedo", "wall_m", "floor_m", *TILT)
"""What can be spread; the place in this list is part of what the random numbers depend on."""


class FramePlan(ScenePlan):
    """A frame set: noisy frames of many views, with their truth.

    Each view shows one of the landmarks, drawn with equal chances.

    Parameters
    ----------
    classes : sequence of str
        Names from the catalogue. Without classes, landmarks and meshes: the whole catalogue.
    landmarks : sequence of LandmarkSpec
        Further boxes with a solid of revolution, spelled out.
    meshes : sequence of MeshPlan
        Landmarks from mesh files.
    sensor : str
        A preset's name, or a sensor file (with a ``/`` or ending in ``.toml``).
    sensor_overrides : mapping
        Fields of the sensor that replace those of `sensor`.
    views : int
        Number of views.
    frames_per_view : int
        Number of noisy frames of each view.
    seed : int
        Root of all random numbers.
    distance_m : number or Distribution
        Distance D from the lens to the landmark's axis, metres (PHYSICS section 1).
    delta_deg : number or Distribution
        Viewing angle δ: the side from which the landmark is seen, degrees.
    bearing_deg : number or Distribution
        Azimuth of the landmark in the camera frame, degrees, positive to the left.
    height_m : number or Distribution
        Height of the landmark's origin above the lens, metres.
    pitch_deg : number or Distribution, optional
        Pitch of the camera's mount, degrees, within ± 90° (PHYSICS section 9); level if left out.
    roll_deg : number or Distribution, optional
        Roll of the camera's mount, degrees, within ± 180°; level if left out.
    albedo : number or Distribution, optional
        Share of light that the landmarks return, in place of their own.
    wall_m : number or Distribution, optional
        Distance of a wall behind the landmark, metres; no wall if left out.
    floor_m : number or Distribution, optional
        How far a floor lies below the lens, metres; no floor if left out.
    wall_albedo, floor_albedo : float
        Share of light that the wall and the floor return.
    variants : sequence of {"hard", "mixed", "shot"}
        What is stored beside the full frames. ``hard``: the range of each pixel's centre ray. ``mixed``: the range of
        the exact integral without noise. ``shot``: frames with shot noise alone.
    keep_taps : bool
        Whether the counts of each tap are stored, too.
    histograms : bool, optional
        Whether a direct sensor with a [histogram] table is simulated photon by photon: histograms and targets are kept,
        and `range` is that of the nearest target. False: ranges alone, with the noise that `range_std_m` states. Left
        out, it is true for a sensor with the table.
    splits : mapping of str to float
        Names of splits with their shares of the views, which add up to 1. All frames of a view are in one split.

    Raises
    ------
    UsageError
        With one line that names the key, its value and what would be right.

    Examples
    --------
    >>> FramePlan(views=10, distance_m={"uniform": [0.8, 1.2]}).distance_m.uniform
    (0.8, 1.2)
    """

    views: Annotated[int, Field(ge=1, le=2**32 - 1)]
    frames_per_view: FramesPerView = 1
    seed: Seed = 0
    distance_m: _Spread = Distribution(uniform=(0.7, 2.1))
    delta_deg: _Spread = Distribution(uniform=(0.0, 360.0))
    bearing_deg: _Spread = Distribution(fixed=0.0)
    height_m: _Spread = Distribution(fixed=0.0)
    pitch_deg: _MaybeSpread = None
    roll_deg: _MaybeSpread = None
    albedo: _MaybeSpread = None
    wall_m: _MaybeSpread = None
    floor_m: _MaybeSpread = None
    wall_albedo: _Share = 0.5
    floor_albedo: _Share = 0.5
    variants: tuple[Variant, ...] = ("hard", "mixed")
    keep_taps: bool = False
    histograms: bool | None = None
    splits: Splits = default_splits()

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        for name in ("distance_m", "wall_m", "floor_m"):
            spread = getattr(self, name)
            if spread is not None and spread.lowest <= 0:
                hint = "; cut the normal's tail with 'within'" if spread.normal and not spread.within else ""
                raise UsageError(f"'{name}' must be positive throughout, got {_to_plain(spread)}{hint}")
        for name in ("distance_m", "height_m", "wall_m", "floor_m"):
            spread = getattr(self, name)
            if spread is not None and any(math.isfinite(end) and abs(end) > FARTHEST_M for end in spread.limits):
                raise UsageError(f"'{name}' must be at most {FARTHEST_M:g} m throughout, got {_to_plain(spread)}")
        for name, most in (("pitch_deg", 90.0), ("roll_deg", 180.0)):
            spread = getattr(self, name)
            if spread is not None and not -most <= spread.lowest <= spread.highest <= most:
                hint = "; cut the normal's tails with 'within'" if spread.normal and not spread.within else ""
                raise UsageError(f"'{name}' must be within ± {most:g}° throughout, got {_to_plain(spread)}{hint}")
        if self.albedo is not None and not 0 < self.albedo.lowest <= self.albedo.highest <= 1:
            raise UsageError(f"'albedo' must be in (0, 1] throughout, got {_to_plain(self.albedo)}")
        check_splits(self.splits)
        if len(set(self.variants)) < len(self.variants):
            raise UsageError(f"'variants' must not repeat, got {list(self.variants)}")
        return self

    @model_serializer(mode="wrap")
    def _without_absent_keys(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit keys that a level phase camera does not have, so that its plans and files keep their bytes."""
        absent = (*TILT, "histograms")
        return {name: value for name, value in write(self).items() if name not in absent or value is not None}

    def resolve(self) -> Self:
        """Return the plan with every default made explicit; resolving again changes nothing.

        Raises
        ------
        UsageError
            A class or sensor is unknown, two landmarks have one name, or the sensor has no taps or histograms to keep.
        InputFileError
            The sensor file cannot be read.
        """
        specs, meshes = self.resolve_landmarks()
        sensor = self.build_sensor()
        if sensor.kind == "direct" and (self.keep_taps or "shot" in self.variants):
            raise UsageError("'keep_taps' and the variant 'shot' must be left out: a direct sensor has neither")
        if self.histograms and sensor.histogram is None:
            raise UsageError("'histograms' must be left out: the sensor has no [histogram] table")
        order: tuple[Variant, ...] = ("hard", "mixed", "shot")
        return self._resolved(
            specs, find_symmetries(meshes), sensor, variants=tuple(name for name in order if name in self.variants),
            histograms=True if self.has_histograms else self.histograms,
        )  # fmt: skip

    @property
    def has_histograms(self) -> bool:
        """Whether histograms of a direct sensor are made, and not ranges alone."""
        return self.build_sensor().histogram is not None if self.histograms is None else self.histograms

    def greatest_distances_m(self) -> dict[str, float]:
        """Return the far end of the landmarks' and walls' distances, metres."""
        spreads = {"distance_m": self.distance_m, "wall_m": self.wall_m}
        return {name: spread.highest for name, spread in spreads.items() if spread is not None}

    def landmark_names(self) -> list[str]:
        """Return the names of the classes of a resolved plan, in the order of their numbers."""
        return [*(spec.name for spec in self.landmarks), *(mesh.name for mesh in self.meshes)]

    def draw_truth(self, start: int = 0, stop: int | None = None) -> dict[str, NDArray[Any]]:
        """Return the truth of some views of a resolved plan; that of a view depends on seed and number alone.

        Returns
        -------
        dict of str to (n,) array
            The quantities in the plan's units (NaN: no wall, no floor), ``class_index`` and ``split_index``.
        """
        stop = self.views if stop is None else stop
        landmarks: list[LandmarkSpec | MeshPlan] = [*self.landmarks, *self.meshes]
        truth: dict[str, NDArray[Any]] = {}
        of_class = _uniform(self.seed, "class", start, stop) * len(landmarks)
        truth["class_index"] = narrowed(np.minimum(of_class.astype(np.int64), len(landmarks) - 1), "<i2", "classes")
        sobol = self._sobol(start, stop)
        for name in QUANTITIES:
            spread: Distribution | None = getattr(self, name)
            if spread is None:
                own = np.array([part.albedo for part in landmarks])
                absent = np.full(stop - start, 0.0 if name in TILT else np.nan)
                truth[name] = own[truth["class_index"]] if name == "albedo" else absent
            elif spread.sobol is not None:
                truth[name] = spread.values(sobol[name])
            elif spread.fixed is not None:
                truth[name] = np.full(stop - start, spread.fixed)
            else:
                truth[name] = spread.values(_uniform(self.seed, name, start, stop))
        truth["split_index"] = narrowed(split_of_views(self.seed, self.splits, start, stop), "|u1", "splits")
        return truth

    def _sobol(self, start: int, stop: int) -> dict[str, NDArray[np.float64]]:
        from scipy.stats import qmc  # slow to import

        names = [name for name in QUANTITIES if getattr(getattr(self, name), "sobol", None) is not None]
        if not names:
            return {}
        seed = int(stream(self.seed, "frames.sobol", 0).integers(2**63))  # SciPy spawns from it, which Philox cannot
        engine = qmc.Sobol(len(names), scramble=True, bits=32, rng=np.random.default_rng(seed))
        if start:
            engine.fast_forward(start)
        # SciPy warns when the first draw is not a power of two; one point is, and later draws may have any number
        points = [engine.random(1)] + ([engine.random(stop - start - 1)] if stop - start > 1 else [])
        return dict(zip(names, np.vstack(points).T, strict=True))
