"""Diagnosis of a refused match: the cheapest change of a setting that makes the frame fit.

Every change is tried by matching: the frame as it would be read with another setting, or a matcher with another
setting. A change is named only if its match is accepted and explains the frame far better than before.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.data.bank.build_bank import rebuild_bank
from phasemark.data.measured.recording import Orientation
from phasemark.matcher.diagnosis.search import SIZES, Fit, Search, wider
from phasemark.matcher.filters.filtered_frames import FilteredFrames, PixelState
from phasemark.matcher.frequencies import OneFrequencyBank
from phasemark.matcher.likelihood.background_estimate import estimate_surroundings
from phasemark.matcher.likelihood.setup import check_free
from phasemark.matcher.match import TOLERANCE_M, TOLERANCE_RAD, Candidate, Match
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.recordings.bank_for_frames import distances_of_frames
from phasemark.render import Background, Frames, Sensor
from phasemark.render.view import delta_period_rad, wrap_delta_difference_rad

Parameter = Literal[
    "method",
    "on",
    "free",
    "bearing_offset_deg",
    "background",
    "flip_h",
    "flip_v",
    "rotate",
    "quantity",
    "unit_factor",
    "invalid_means",
    "half_angle_deg",
    "distance_m",
]
VIEW = ("distance_m", "delta_rad")
FEWEST_RETURNS = 3
"""Fewer returns give no view."""
FEWEST_DOF = 3
"""A fit with fewer degrees of freedom says too little to recommend a change."""
DECISIVE_RATIO = 1.5
"""A change must lower chi2 by this factor."""
DECISIVE_DROP = 40.0
"""And by this much: three free parameters lower chi2 by chance by more than 40 once in a hundred million frames."""
WORTH_A_MATCH = 60.0
"""Cost above what noise explains up to which a rough fit is matched: two pixels that contradict it, and a little."""
CLEARLY_ASIDE_RAD = math.radians(0.5)
"""Before a background a rough fit knows the bearing better than that."""
_FACTORS = (1000.0, 100.0, 10.0, 0.1, 0.01, 0.001)
_WINDOW_M, _WINDOW_RAD = 0.01, math.radians(1.0)


@dataclass(frozen=True)
class Change:
    """One setting changed.

    Parameters
    ----------
    parameter : str
        "method", "on", "free" and "background" of :class:`~phasemark.matcher.Matcher`; "flip_h", "flip_v", "rotate",
        "quantity" and "invalid_means" of :func:`phasemark.data.read_frames`, applied after those given;
        "unit_factor", by which the ranges are multiplied; "bearing_offset_deg" and "half_angle_deg" of the sensor the
        bank is built for; "distance_m", which the bank does not reach.
    value : object
        Its new value; of "half_angle_deg" both angles, horizontal and vertical.
    words : str
        The change in words, to follow "it fits with".
    """

    parameter: Parameter
    value: Any
    words: str

    def as_dict(self) -> dict[str, Any]:
        """Return plain values."""
        value = self.value
        if isinstance(value, Background):
            value = {"wall_m": value.wall_m, "floor_m": value.floor_m}
        elif isinstance(value, tuple):
            value = list(value)
        return {"parameter": self.parameter, "value": value, "words": self.words}


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Diagnosis of a refused frame: the changes of settings that make it fit.

    Parameters
    ----------
    index : int
        Which frame.
    refused : Match
        Its match as it was.
    changes : tuple of Change
        What makes the frame fit; empty if nothing does. One change is enough alone.
    match : Match or None
        The match that the changes lead to; None without a change.
    alternatives : tuple of Change
        Other single changes that make the frame fit too: the frame does not tell which of them is right.
    n_returned : int
        How many pixels returned.
    stopped : bool
        Whether time was up before every change was tried.
    among_unknown : bool
        Whether it was matched among unknown things, so that neither background nor field of view was changed.
    does_not_stand_out : bool
        Whether among unknown things the landmark fits, but the scene does not end at its outline.
    """

    index: int
    refused: Match
    changes: tuple[Change, ...] = ()
    match: Match | None = None
    alternatives: tuple[Change, ...] = ()
    n_returned: int = 0
    stopped: bool = False
    among_unknown: bool = False
    does_not_stand_out: bool = False

    @property
    def enough_alone(self) -> bool:
        """Whether a single change makes the frame fit."""
        return len(self.changes) == 1

    def message(self, remedy: Callable[[Change], str] | None = None) -> str:
        """Return the diagnosis in one line.

        Parameters
        ----------
        remedy : callable, optional
            Returns what to do for a change, in place of the library's own names: the options of a command line.
        """
        head = f"frame {self.index} is refused ({self._why()})"
        if not self.changes:
            if self.n_returned < FEWEST_RETURNS:
                return f"{head}: {self.n_returned} of its pixels return, and {FEWEST_RETURNS} are needed"
            if self.refused.reason in ("undetermined", "ambiguous"):
                return f"{head}: {self._what_is_open()}"
            if self.does_not_stand_out:
                return f"{head}: {self.refused.class_name} fits, but the pixels beside it do not show where it ends"
            if self.stopped:
                return f"{head}: none of the changes tried makes it fit, and time was up before all were tried"
            also = "" if self.among_unknown else ", background, field of view"
            return (
                f"{head}: no change of bearing, orientation, unit, quantity, distance{also}, pitch, roll or height"
                " makes it fit: it may show another landmark, or none"
            )

        told = remedy or _remedy
        words = " and ".join(change.words for change in self.changes)
        text = f"{head}: it fits with {words}: {', '.join(told(change) for change in self.changes)}"
        for other in self.alternatives:
            text += f"; it fits as well with {other.words}: {told(other)}"
        return text

    def __repr__(self) -> str:
        """Return the message in one line, as the text of a diagnosis."""
        return f"Diagnosis({self.message()})"

    def __str__(self) -> str:
        """Return the message with the library's names."""
        return self.message()

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, valid JSON."""
        return {
            "frame": self.index,
            "changes": [change.as_dict() for change in self.changes],
            "alternatives": [change.as_dict() for change in self.alternatives],
            "enough_alone": self.enough_alone,
            "stopped": self.stopped,
            "match": None if self.match is None else self.match.as_dict(),
            "message": self.message(),
        }

    def _what_is_open(self) -> str:
        """Tell which number a frame that the landmark explains leaves open."""
        match, name = self.refused, self.refused.class_name
        if match.reason == "ambiguous" and match.alternatives:
            others = [candidate for candidate in match.alternatives if _are_apart(match, candidate)]
            seen = " or ".join(
                f"{one.class_name} at {one.distance_m:.3f} m and {math.degrees(one.delta_rad):.1f}°"
                for one in (match, (others or match.alternatives)[0])
            )
            return f"it may show {seen}; nearer, or with more exposures, it may tell"
        known = ""
        if match.covariance is not None:
            std = 3 * np.sqrt(np.diag(match.covariance))
            known = f" (3 σ of D {std[0]:.2g} m, of δ {math.degrees(std[1]):.2g}°)"
        return f"it shows {name}, in too few pixels to place it{known}: go nearer, or take more exposures"

    def _why(self) -> str:
        match = self.refused
        reason = getattr(match, "reason", None) or ("no landmark" if match.class_name is None else "poor fit")
        if math.isfinite(match.chi2) and match.dof > 0:
            return f"{reason}, chi2/dof {match.chi2 / match.dof:.3g}"
        return str(reason)


def _are_apart(match: Match, other: Candidate) -> bool:
    """Return whether an answer and another explanation of its frame are not the same to within the usual tolerance."""
    turn_rad = abs(wrap_delta_difference_rad(other.delta_rad - match.delta_rad, delta_period_rad(match.symmetry or 1)))
    apart_m = abs(other.distance_m - match.distance_m)
    return other.class_name != match.class_name or apart_m > TOLERANCE_M or float(turn_rad) > TOLERANCE_RAD


_REMEDIES = {
    "flip_h": "flip_h the other way round",
    "flip_v": "flip_v the other way round",
    "rotate": "rotate by {0}° more",
    "unit_factor": "a unit {0:g} times as large",
    "half_angle_deg": "a bank of a sensor with half_angle_h_deg={0[0]:.4g}, half_angle_v_deg={0[1]:.4g}",
    "bearing_offset_deg": "a bank of a sensor with bearing_offset_deg={0:.3g}",
    "distance_m": "a bank with distances to {0:.3g} m",
}
"""What to do for a change, with the names of the library, where that is not to give a parameter its value."""


def _remedy(change: Change) -> str:
    """Return what to do, with the names of the library."""
    told = _REMEDIES.get(change.parameter)
    return f"{change.parameter}={change.value!r}" if told is None else told.format(change.value)


_Behind = Background | Literal["auto", "unknown"] | None


def diagnose(
    matcher: Matcher,
    frames: FilteredFrames,
    index: int = 0,
    *,
    background: Background | None = None,
    seconds: float = 20.0,
    refused: Match | None = None,
) -> Diagnosis:
    """Find the cheapest change of settings that makes a refused frame fit.

    Single changes are tried in the order of what they cost the user: a free bearing, another background, ranges as the
    chip reports them, the image turned or mirrored, another quantity or unit, a distance the bank does not reach,
    pitch, roll and height, another field of view, unknown things in view. Then pairs of a bearing with one of the
    others. Of a matcher among unknown things background and field of view are left as they are. It takes 1 to 5 s of
    processor time on usual views.

    Parameters
    ----------
    matcher : Matcher
        The one that refused.
    frames : FilteredFrames
        Filtered frames.
    index : int
        Which of them.
    background : Background, optional
        Background of a matcher of method "nearest", which does not keep it.
    seconds : float
        No further change is tried when this much time has passed; the change that is being tried is finished.
    refused : Match, optional
        The answer to the frame, if it is known: it is not matched again.

    Returns
    -------
    Diagnosis
        Without changes where nothing makes the frame fit.

    Raises
    ------
    UsageError
        The frame is accepted, there is no such frame, or the frames come from another camera than the bank.

    Notes
    -----
    A change counts if its match is accepted, has at least three degrees of freedom and a chi2 that is lower than
    before by a factor of 1.5 and by 40. What invalid pixels mean need not lower chi2: it is tried where the landmark
    fits, but what is beside it is missing.

    Of several modulation frequencies unwrapped ranges are compared, whatever the matcher compares.
    """
    if not -len(frames) <= index < len(frames):
        raise UsageError(f"'index' must be in 0 … {len(frames) - 1}, got {index}")
    index %= len(frames)
    frame = frames[index]
    refused = refused or matcher.match(frame)[0]
    if refused.accepted:
        raise UsageError(f"frame {index} is accepted: there is nothing to diagnose")
    n_returned = int((frame.state == PixelState.RETURN).sum())
    among_unknown = matcher.options["background"] == "unknown" or matcher.options["on"] == "reported"
    fits = refused.reason == "poor fit" and refused.p_value >= matcher.false_alarm
    nothing = Diagnosis(index, refused, n_returned=n_returned, among_unknown=among_unknown, does_not_stand_out=fits)
    end = time.monotonic() + seconds
    if n_returned < FEWEST_RETURNS or matcher.bank.plan.model != "ray":
        return nothing
    with ExitStack() as stack:
        trials = _Trials(matcher, frame, background, nothing, stack)
        for found in trials.in_order():
            if found:
                (changes, match), *others = found
                alternatives = tuple(other[0] for other, _ in others if len(other) == 1)
                return replace(nothing, changes=changes, match=match, alternatives=alternatives)
            if time.monotonic() > end:
                return replace(nothing, stopped=True)
    return nothing


_Found = list[tuple[tuple[Change, ...], Match]]


class _Trials:
    """The changes tried on one frame, by matchers that have the settings of the one that refused it."""

    def __init__(
        self,
        matcher: Matcher,
        frame: FilteredFrames,
        background: Background | None,
        so_far: Diagnosis,
        stack: ExitStack,
    ) -> None:
        told = matcher.options
        self.nearest, self.stack = matcher.method == "nearest", stack
        self.bank, self.frame = matcher.bank, frame.without_offset()
        if len(frame.sensor.frequencies_hz) > 1:
            self.bank = OneFrequencyBank(self.bank, "combined")
            self.frame = self.bank.one.frames(self.frame)
        self.options: dict[str, Any] = {"false_alarm": matcher.false_alarm}
        self.background: _Behind = background
        if not self.nearest:
            on = told["on"] if self.bank is matcher.bank else "ranges"
            self.options |= {"on": on, "pixels": told["pixels"], "robust": told["robust"]}
            # before unknown things was tried last of all: the fits before that tell more
            self.background = "auto" if told["background"] == "any" else told["background"]
            if on == "reported":
                self.background = "unknown"
        self.on_ranges = self.options.get("on", "ranges") == "ranges"
        self.is_default = not self.nearest and told["free"] is None
        self.default = matcher.free if self.background == "unknown" and self.is_default else None
        # elsewhere a bearing with a prior is searched again without one
        self.free = self.default or (VIEW if told["free"] is None else check_free(told["free"]))
        self.search = Search(self.bank)
        self.plain = self.matcher(self.free, self.background)
        self.reference = self.plain.match(self.frame)[0] if self.nearest else so_far.refused
        self.fits = so_far.does_not_stand_out
        self.bearing_free = "bearing_rad" in self.free and self.default is None
        self.with_bearing = check_free(tuple(dict.fromkeys((*self.free, "bearing_rad"))))
        self.stated = self._estimated() if isinstance(self.background, str) else self.background
        assert self.stated is None or isinstance(self.stated, Background)

    def matcher(
        self, free: Sequence[str] | None, background: _Behind, bank: Bank | None = None, **options: Any
    ) -> Matcher:
        """Build a matcher by maximum likelihood; free parameters that are free by default have their priors."""
        told = None if free == self.default else free
        return Matcher(bank or self.bank, "refine", free=told, background=background, **{**self.options, **options})

    def in_order(self) -> Iterator[_Found]:
        """Try changes, the cheapest first; yield those that make the frame fit, usually none."""
        if self.nearest and self.reference.accepted:
            yield [((_METHOD,), self.reference)]
        if self.background == "unknown":
            yield self._without_missing()
            yield self._freed(("bearing_rad",))
            yield self._transformed()
            yield self._outside_among_unknown()
            yield self._tilted()
            return
        rough = self._rough(self.frame, self.stated)
        outside = rough is not None and not self._inside(rough.distance_m)
        if not self.bearing_free and not outside:
            yield self._bearing(rough, self.frame, self.background, ())
        yield self._other_background()
        yield self._reported()
        yield self._transformed()
        yield self._outside(rough)
        yield self._tilted()
        yield self._field_of_view()
        yield self._among_unknown()
        if not self.bearing_free and rough is None:
            yield self._transformed_with_bearing()

    def _without_missing(self) -> _Found:
        """Match the frame with missing pixels read as no returns, where the landmark fits but nothing shows its end."""
        missing = self.frame.state == PixelState.MISSING
        if not (self.fits and missing.any()):
            return []
        state = np.where(missing, PixelState.NO_RETURN, self.frame.state).astype(np.uint8)
        match = self.plain.match(replace(self.frame, state=state, time_s=None))[0]
        change = Change("invalid_means", "no-return", "invalid pixels taken for no returns")
        return [((change,), match)] if match.accepted and match.dof >= FEWEST_DOF else []

    def _freed(self, names: Sequence[str]) -> _Found:
        """Match with more of the view free."""
        free = check_free(tuple(dict.fromkeys((*self.free, *names))))
        if free == self.free and self.default is None:
            return []
        match = self._matched(free, self.background)
        return [] if match is None else [((_free(match, free, self.free),), match)]

    def _tilted(self) -> _Found:
        """Match with pitch, roll or height free, or with all of them."""
        names = [name for name in ("pitch_rad", "roll_rad", "height_m") if name not in self.free]
        single = [found for name in names for found in self._freed((name,))]
        return single or (self._freed(names) if len(names) > 1 else [])

    def _reported(self) -> _Found:
        """Match as ranges that a chip reports, where the sensor is one and zones may see a background too."""
        if self.bank.sensor.histogram is None or not self.on_ranges:
            return []
        # least share of pixels that return where something stands behind the landmark, so that zones see two surfaces
        mixing = 0.5
        if (self.frame.state == PixelState.RETURN).mean() < mixing:
            return []
        match = Matcher(self.bank, "refine", on="reported", false_alarm=self.plain.false_alarm).match(self.frame)[0]
        change = Change("on", "reported", "ranges as the chip reports them, of the nearest surface of each zone")
        return [((change,), match)] if self._counts(match) else []

    def _among_unknown(self) -> _Found:
        """Match among unknown things."""
        if not self.on_ranges:
            return []
        match = self._matched(self.free, "unknown", robust=False)
        change = Change("background", "unknown", "other things before, beside or behind the landmark")
        return [] if match is None else [((change,), match)]

    def _matched(self, free: Sequence[str], background: _Behind, **options: Any) -> Match | None:
        """Match with other settings; None if it is refused or outside the bank."""
        match = self.matcher(free, background, **options).match(self.frame)[0]
        return match if self._counts(match) else None

    def _bearing(
        self, rough: Fit | None, frame: FilteredFrames, background: _Behind, before: tuple[Change, ...]
    ) -> _Found:
        """Match a frame with the bearing free, where a rough fit promises something."""
        if rough is None:
            return []
        match = self.matcher(self.with_bearing, background).match(frame)[0]
        if self._counts(match):
            return [((*before, _free(match, self.with_bearing, self.free)), match)]
        # the matcher's own search of bearings may miss what a camera stated to look there finds
        sensor = self._turned(rough)
        turned = self._match_window(rough, frame, sensor, self.with_bearing, background)
        if turned is None or not self._inside(turned.distance_m):
            return []
        match = self._turned_back(turned, sensor)
        bearing_deg = math.degrees(match.bearing_rad)
        offset_deg = self.bank.sensor.bearing_offset_deg + bearing_deg
        words = f"a bearing of {bearing_deg:.2g}°"
        return [((*before, Change("bearing_offset_deg", offset_deg, words)), match)]

    def _other_background(self) -> _Found:
        """Match with wall and floor estimated, or with none where some were stated."""
        tried: list[tuple[_Behind, Background | None]] = []
        if isinstance(self.background, Background):
            tried.append((None, None))
        estimated = self._estimated()
        if self.background != "auto" and estimated is not None:
            tried.append(("auto", estimated))
        for background, scene in tried:
            rough = self._rough(self.frame, scene)
            if scene is not None and scene.wall_m is not None:
                if rough is None:  # wide pixels average over the wall, and a bearing turns it
                    first = self.search.best(self.frame, scene, bearing=True)
                    scene = scene if first is None else self.search.with_fitted_background(self.frame, scene, first)
                    rough = self._rough(self.frame, scene)
                scene = scene if rough is None else self.search.with_fitted_background(self.frame, scene, rough)
            if rough is None:
                continue
            stated: list[_Behind] = [background]
            if scene is not None and scene.wall_m is not None:
                stated.append(scene)
            aside = abs(rough.bearing_rad) > CLEARLY_ASIDE_RAD and not self.bearing_free
            for told in () if aside else stated:
                match = self.matcher(self.free, told).match(self.frame)[0]
                if self._counts(match):
                    return [((_background(told, match.background),), match)]
            for told in () if self.bearing_free else stated:
                found = self._bearing(rough, self.frame, told, (_background(told, scene),))
                if found:
                    return found
        return []

    def _transformed(self) -> _Found:
        """Match the frame as other settings would have read it."""
        changed = list(_transforms(self.frame, self.bank))
        frames = FilteredFrames.joined([frame for _, frame in changed])
        matches = self.plain.match(replace(frames, time_s=None))  # one frame does not move
        return [((change,), match) for (change, _), match in zip(changed, matches, strict=True) if self._counts(match)]

    def _transformed_with_bearing(self) -> _Found:
        for change, frame in _transforms(self.frame, self.bank):
            if change.parameter not in ("flip_v", "quantity", "unit_factor") or change.value == "range":
                continue
            found = self._bearing(self._rough(frame, self.stated), frame, self.background, (change,))
            if found:
                return found
        return []

    def _outside(self, rough: Fit | None) -> _Found:
        """Match before images at distances that the bank does not have."""
        if rough is None or self._inside(rough.distance_m):
            return []
        for free in dict.fromkeys((self.free, self.with_bearing)):
            sensor = self._turned(rough) if free == self.with_bearing else self.bank.sensor
            found = self._match_window(rough, self.frame, sensor, free, self.background)
            if found is not None and not self._inside(found.distance_m):
                change = self._distance(found.distance_m)
                if free == self.free:
                    return [((change,), found)]
                match = self._turned_back(found, sensor)
                return [((change, _free(match, self.with_bearing, self.free)), match)]
        return []

    def _outside_among_unknown(self) -> _Found:
        """Match before images at all distances that the frame asks for."""
        returned = np.where(self.frame.state == PixelState.RETURN, self.frame.range_m, np.nan)
        seen = Frames(returned[:, None], sensor=self.frame.sensor)
        with suppress(UsageError):  # the landmark cannot be in the frame
            meshes = [self.bank.mesh(name) for name in self.bank.classes]
            distance_m = sorted({d for mesh in meshes for d in distances_of_frames(seen, mesh)})
            wide = self.stack.enter_context(
                rebuild_bank(self.bank, distance_m=distance_m, delta_deg=np.degrees(self.bank.delta_rad).tolist())
            )
            match = self.matcher(self.free, self.background, wide).match(self.frame)[0]
            if self._is_better(match) and not self._inside(match.distance_m):
                return [((self._distance(match.distance_m),), match)]
        return []

    def _distance(self, distance_m: float) -> Change:
        """Return the change to a bank that reaches a distance."""
        first, last = float(self.bank.distance_m[0]), float(self.bank.distance_m[-1])
        where = f"before its first, {first:.3g} m" if distance_m < first else f"beyond its last, {last:.3g} m"
        return Change("distance_m", distance_m, f"a bank that reaches {distance_m:.3g} m, {where}")

    def _field_of_view(self) -> _Found:
        """Match before images of a camera with another field of view."""
        aside = self.bearing_free or self.is_default
        fit = self.search.best(self.frame, self.stated, sizes=SIZES, bearing=aside)
        if fit is None or not _is_promising(fit):
            return []
        sensor = wider(self.bank.sensor, fit.size)
        free = None if self.is_default else self.free
        match = self._match_window(fit, self.frame, sensor, free, self.background)
        if match is None or not self._inside(match.distance_m):
            return []
        angles = (sensor.half_angle_h_deg, sensor.half_angle_v_deg)
        percent = 100 * (angles[0] / self.bank.sensor.half_angle_h_deg - 1)
        words = f"a field of view {abs(percent):.2g} % {'wider' if percent > 0 else 'narrower'}"
        return [((Change("half_angle_deg", angles, words),), match)]

    def _rough(self, frame: FilteredFrames, scene: Background | None) -> Fit | None:
        """Return a rough fit with the bearing free; None if it promises nothing."""
        fit = self.search.best(frame, scene, bearing=True)
        return None if fit is None or not _is_promising(fit) else fit

    def _match_window(
        self, rough: Fit, frame: FilteredFrames, sensor: Sensor, free: Sequence[str] | None, background: _Behind
    ) -> Match | None:
        """Match before a small bank of one class about a rough fit; None if it is refused."""
        window_steps = 4
        steps = np.arange(-window_steps, window_steps + 1)
        distance_m = rough.distance_m + _WINDOW_M * steps
        delta_deg = np.degrees(rough.delta_rad + _WINDOW_RAD * steps)
        with suppress(UsageError):  # a lens inside the landmark, a wall before it
            window = rebuild_bank(
                self.bank,
                distance_m=distance_m.tolist(),
                delta_deg=delta_deg.tolist(),
                classes=[rough.class_name],
                sensor=sensor,
            )
            self.stack.enter_context(window)
            match = self.matcher(free, background, window).match(replace(frame, sensor=sensor))[0]
            return match if self._is_better(match) else None
        return None

    def _turned(self, rough: Fit) -> Sensor:
        """Return the camera stated to look aside, so that a rough fit's bearing is 0."""
        sensor = self.bank.sensor
        return sensor.with_(bearing_offset_deg=sensor.bearing_offset_deg + math.degrees(rough.bearing_rad))

    def _turned_back(self, match: Match, sensor: Sensor) -> Match:
        """Return a match before images of a turned camera with the bearing of the bank's own."""
        turned = math.radians(sensor.bearing_offset_deg - self.bank.sensor.bearing_offset_deg)
        return replace(match, bearing_rad=match.bearing_rad + turned)

    def _counts(self, match: Match) -> bool:
        """Return whether a match is far better than the refused one, and in the range of the bank."""
        return self._is_better(match) and self._inside(match.distance_m)

    def _is_better(self, match: Match) -> bool:
        """Return whether a match is accepted, and far better than the refused one."""
        if not match.accepted or match.dof < FEWEST_DOF:
            return False
        before = self.reference.chi2
        if not math.isfinite(before):
            return True
        return match.chi2 * DECISIVE_RATIO <= before and match.chi2 + DECISIVE_DROP <= before

    def _inside(self, distance_m: float) -> bool:
        first, last = float(self.bank.distance_m[0]), float(self.bank.distance_m[-1])
        return first - 1e-3 <= distance_m <= last + 1e-3

    def _estimated(self) -> Background | None:
        return estimate_surroundings(self.frame, bearing_known=self.bearing_free).background


def _is_promising(fit: Fit) -> bool:
    """Return whether a rough fit is good enough to be matched."""
    n = fit.n_pixels
    return fit.cost <= n + 4 * math.sqrt(2 * n) + WORTH_A_MATCH


_METHOD = Change("method", "refine", "views between the bank's images")


def _free(match: Match, free: Sequence[str], before: Sequence[str]) -> Change:
    """Return the change that frees parameters, with what is found of those that were not free."""
    added = [name for name in free if name not in before] or ["bearing_rad"]
    found = [
        f"{name.removesuffix('_m')} {getattr(match, name):.3f} m"
        if name.endswith("_m")
        else f"{name.removesuffix('_rad')} {math.degrees(getattr(match, name)):.2g}°"
        for name in added
    ]
    words = " and ".join(name.removesuffix("_rad").removesuffix("_m") for name in added)
    return Change("free", tuple(free), f"the {words} free ({', '.join(found)})")


def _background(background: _Behind, found: Background | None) -> Change:
    if background is None:
        return Change("background", None, "nothing behind the landmark")
    planes = []
    if found is not None and found.wall_m is not None:
        planes.append(f"wall at {found.wall_m:.3g} m")
    if found is not None and found.floor_m is not None:
        planes.append(f"floor {found.floor_m:.3g} m below the lens")
    if isinstance(background, Background):
        return Change("background", background, f"a {' and '.join(planes)}")
    return Change("background", "auto", f"the background estimated ({', '.join(planes)})")


def _transforms(frame: FilteredFrames, bank: Bank) -> Iterator[tuple[Change, FilteredFrames]]:
    """Return the frame as other settings would have read it."""
    yield Change("flip_h", True, "the image mirrored left to right"), frame.with_pixels(lambda a: a[..., ::-1])
    yield Change("flip_v", True, "the image mirrored top to bottom"), frame.with_pixels(lambda a: a[..., ::-1, :])
    yield Change("rotate", 180, "the image rotated by 180°"), frame.with_pixels(lambda a: a[..., ::-1, ::-1])
    if frame.sensor.rows == frame.sensor.cols:
        for angle in (90, 270):
            words = f"the image rotated by {angle}°"
            yield Change("rotate", angle, words), frame.with_pixels(Orientation(rotate=angle).apply)
    cosine = frame.sensor.axis_cosine()
    yield Change("quantity", "z", "the values taken as z, along the optical axis"), _scaled(frame, 1 / cosine)
    yield Change("quantity", "range", "the values taken as ranges, along the ray"), _scaled(frame, cosine)
    nearest, farthest = (float(np.nanpercentile(frame.range_m, q)) for q in (5, 95))
    first, last = float(bank.distance_m[0]), float(bank.distance_m[-1])
    for factor in _FACTORS:
        # the nearest surface lies before the landmark's axis, and what stands behind is not thousands of times farther
        if first / 2 < nearest * factor < last and farthest * factor < frame.sensor.unambiguous_range_m:
            words = f"ranges {factor:g} times as large" if factor > 1 else f"ranges {1 / factor:g} times smaller"
            yield Change("unit_factor", factor, words), _scaled(frame, np.full(cosine.shape, factor))


def _scaled(frame: FilteredFrames, factor: NDArray[np.float64]) -> FilteredFrames:
    """Multiply ranges, and their standard deviations where these come from the ranges' own scatter."""
    std_m = frame.std_m * factor if frame.std_from_scatter else frame.std_m
    return replace(frame, range_m=frame.range_m * factor, std_m=std_m)
