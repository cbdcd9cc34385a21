"""The trials of a sweep: worlds rendered, frames captured once, and every method tried on them.

A sweep's trials are a file built in shards (:mod:`phasemark.data.shards.build`): interrupted runs go on, and the bytes
depend neither on the number of workers nor on where they run. Slabs are conditions and items are trials. Truth and
noise of a trial depend on the seed, its condition and its number alone, so all methods see the same frames.
"""

from __future__ import annotations

import importlib
import numbers
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark import PhasemarkError, UsageError
from phasemark.data import Bank, build_bank
from phasemark.data.files.hdf5_layout import Layout
from phasemark.data.files.json_text import json_text
from phasemark.data.files.narrow import narrowed
from phasemark.data.files.provenance import mesh_sha256, versions
from phasemark.data.scene_job import read_landmarks
from phasemark.data.seeds import stream
from phasemark.data.shards.build import Place
from phasemark.matcher.accuracy.cramer_rao import confusion_probability, cramer_rao
from phasemark.matcher.filters.filtered_frames import FilteredFrames, noise_free
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.filters.mean_phasor import phasor_mean
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.search_policy import DEFAULT_POLICY
from phasemark.matcher.match import Match, Matches
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.pixel_agreement import counts
from phasemark.matcher.sweep.plan import Method, SweepPlan
from phasemark.render import Background, Frames, PhasorImages, Renderer, Sensor, Views, capture
from phasemark.render.direct.capture import capture_ranges
from phasemark.render.direct.chip_renderer import ChipRenderer

FORMAT = "phasemark-trials"
SCHEMA_VERSION = 1
NONE = -1
"""Stands for "no landmark" where a class's number would be."""


def _own_fields(p: int) -> tuple[tuple[str, tuple[int, ...], str, str], ...]:
    """Return the fields that are stored of each method's match of a trial; views have p numbers."""
    names = ", ".join(VIEW[:p])
    order = ", ".join(name.split("_")[0] for name in VIEW[:p])
    return (
        ("bound", (p, p), "<f8", f"Cramér–Rao bound at the truth, in the order {order}"),
        ("estimate", (p,), "<f8", f"{names}; NaN where there is none"),
        ("covariance", (p, p), "<f8", "the method's own covariance; NaN where it has none"),
        ("chi2", (), "<f8", "whitened squared residual"),
        ("dof", (), "<i4", "degrees of freedom"),
        ("p_value", (), "<f8", "probability of a larger chi2"),
        ("p_none", (), "<f8", "probability of no landmark"),
        ("found", (), "<i2", "number of the class found, -1: none"),
        ("accepted", (), "|u1", "whether the match passed its test"),
        ("modes", (), "<i2", "explanations kept, the best included"),
        ("seconds", (), "<f8", "time of the match, an equal share of its batch"),
    )


def _shared_fields(p: int) -> tuple[tuple[str, tuple[int, ...], str, str], ...]:
    """Return the fields that are stored of each trial; views have p numbers."""
    return (
        ("truth", (p,), "<f8", ", ".join(VIEW[:p])),
        ("confusion", (), "<f8", "bound on the probability of a wrong class; NaN where it was not computed"),
    )


_CONFUSION_TRIALS = 4
"""Views of a condition, which hardly differ, for which the bound on class confusion is computed."""
_WIGGLES = (3, 5, 7)
_RENDERERS_KEPT = 16
_TERMINATED = 128 + signal.SIGTERM
"""The exit status with which the command line ends on SIGTERM: no error of a user's module."""


@dataclass(frozen=True)
class Round:
    """Some more trials of some conditions.

    Parameters
    ----------
    number : int
    conditions : tuple of int
        Their numbers in the plan's design.
    first : int
        Number of the first trial.
    trials : int
    """

    number: int
    conditions: tuple[int, ...]
    first: int
    trials: int


class SweepJob:
    """One round of a sweep (:class:`phasemark.data.shards.build.Job`).

    Parameters
    ----------
    plan : SweepPlan
    of : Round
    """

    def __init__(self, plan: SweepPlan, of: Round) -> None:
        self.plan, self.of = plan, of
        self.all_conditions = plan.conditions()
        bank = plan.bank_plan(plan.methods[0])
        self.sensor = bank.build_sensor()
        known = read_landmarks(bank.landmarks, bank.meshes)
        self.class_names = tuple(part.name for part in known)
        self.objects = {part.name: part for part in (*known, *read_landmarks(plan.strangers, ()))}
        self._banks: dict[str, Bank] = {}
        self._matchers: dict[tuple[str, float], Callable[[FilteredFrames], Sequence[Match]]] = {}
        self._references: dict[float, Matcher] = {}
        self._renderers: dict[tuple[Any, ...], Renderer] = {}
        self._guard = threading.Lock()

    @property
    def maker(self) -> str:
        """What makes this job in another process."""
        return "phasemark.matcher.sweep.job:job_of"

    def spec(self) -> dict[str, Any]:
        """Return a description from which another process makes the same job."""
        return {
            "plan": self.plan.model_dump(mode="json"),
            "round": [self.of.number, list(self.of.conditions), self.of.first, self.of.trials],
        }

    @property
    def items(self) -> list[int]:
        """The number of trials of each condition."""
        most = self.plan.stranger_trials
        return [min(self.of.trials, most) if self.is_stranger(k) else self.of.trials for k in self.of.conditions]

    def is_stranger(self, number: int) -> bool:
        """Return whether a condition shows an object that stands in no bank."""
        return self.all_conditions[number].class_name not in self.class_names

    def identity(self) -> dict[str, Any]:
        """Return all that the trials depend on."""
        return {
            "plan": self.plan.model_dump(mode="json"),
            "round": self.spec()["round"],
            "versions": versions(),
            "mesh_sha256": {name: mesh_sha256(part.mesh) for name, part in self.objects.items()},
        }

    def lay_out(self) -> tuple[Layout, list[list[Place]]]:
        """Return all but the trials, and where these go."""
        n, methods = sum(self.items), len(self.plan.methods)
        with Layout() as layout:
            file = layout.file
            file.attrs["format"] = FORMAT
            file.attrs["schema_version"] = SCHEMA_VERSION
            file.attrs["identity"] = json_text(self.identity(), sort_keys=True)
            file.create_dataset(
                "condition", data=narrowed(np.repeat(self.of.conditions, self.items), "<i4", "conditions")
            )
            numbers = np.concatenate([self.of.first + np.arange(count) for count in self.items])
            file.create_dataset("trial", data=numbers.astype("<i8"))
            first = []
            for name, shape, kind, long_name in _shared_fields(self.plan.n_numbers):
                dataset, offset = layout.reserve(file, name, (n, *shape), kind)
                dataset.attrs["long_name"] = long_name
                first.append(Place(offset, int(np.prod(shape)) * np.dtype(kind).itemsize))
            for name, shape, kind, long_name in _own_fields(self.plan.n_numbers):
                dataset, offset = layout.reserve(file, name, (n, methods, *shape), kind)
                dataset.attrs["long_name"] = long_name
                first.append(Place(offset, methods * int(np.prod(shape)) * np.dtype(kind).itemsize))
        return layout, [
            [Place(place.offset + int(before) * place.stride, place.stride) for place in first]
            for before in np.cumsum([0, *self.items[:-1]])
        ]

    def check_views(self) -> None:
        """Refuse conditions whose camera is impossible or whose views cannot be rendered, before any is.

        Raises
        ------
        UsageError
            Naming the condition or the method.
        """
        for method in self.plan.methods:
            if method.on == "phasors" and self.sensor.kind == "direct":
                raise UsageError(f"method '{method.name}': on=\"phasors\" needs amplitudes, and the sensor is direct")
            if method.on == "reported" and self.sensor.histogram is None:
                raise UsageError(f"method '{method.name}': on=\"reported\" needs a sensor with a [histogram] table")
        for number, n in zip(self.of.conditions, self.items, strict=True):
            try:
                sensor = self.true_sensor(number)
                views = self.views(number, self.of.first, self.of.first + n).in_camera(sensor)
                self.renderer(number, sensor).check_can_be_seen(views, self.background(number))
            except UsageError as error:
                raise UsageError(f"condition {number}: {error}") from None

    def make(self, slab: int, start: int, stop: int) -> list[NDArray[Any]]:
        """Make some trials of a condition."""
        number = self.of.conditions[slab]
        first = self.of.first + start
        views = self.views(number, first, self.of.first + stop)
        truth = np.stack([getattr(views, name) for name in VIEW[: self.plan.n_numbers]], axis=1)
        p = self.plan.n_numbers
        own = _own_fields(p)
        out = {name: np.zeros((len(views), len(self.plan.methods), *shape), kind) for name, shape, kind, _ in own}
        image = self.image(number, views)
        frames: dict[tuple[str, str], FilteredFrames] = {}
        bounds: dict[tuple[Any, ...], NDArray[np.float64]] = {}
        for m, method in enumerate(self.plan.methods):
            on = "phasors" if method.on == "phasors" else "ranges"  # of a chip those that it reports
            kind = (on, method.filter)
            if kind not in frames:
                frames[kind] = self.frames(number, method, image, first)
            what = (on, method.parameters, method.pixels)
            if what not in bounds and self.is_stranger(number):
                bounds[what] = np.full((len(views), p, p), np.nan)
            elif what not in bounds:
                bounds[what] = self.bound(number, method, image)
            begun = time.perf_counter()
            matches = self._match(number, m, frames[kind], first)
            out["seconds"][:, m] = (time.perf_counter() - begun) / len(views)
            out["bound"][:, m] = bounds[what]
            for name, values in self._table(matches, method).items():
                out[name][:, m] = narrowed(values, out[name].dtype.str, name)
        confusion = self.confusion(number, views, first)
        return [truth.astype("<f8"), confusion.astype("<f8"), *(out[name] for name, *_ in own)]

    def explained(self, method: Method) -> Literal["ranges", "phasors", "reported"]:
        """Return the quantity of the frames that a method explains."""
        if method.on is None and method.method == "refine" and self.sensor.histogram is not None:
            return "reported"
        return method.on or "ranges"

    def views(self, number: int, first: int, stop: int) -> Views:
        """Return the true views of some trials of a condition."""
        condition = self.all_conditions[number]
        unit = stream(self.plan.seed, "sweep.views", number).random((stop, 2))[first:] - 0.5
        return Views.broadcast(
            condition.distance_m + self.plan.spread[0] * unit[:, 0],
            np.deg2rad(condition.delta_deg + self.plan.spread[1] * unit[:, 1]),
            np.deg2rad(condition.bearing_deg),
            condition.height_m,
            *(np.deg2rad([condition.pitch_deg, condition.roll_deg]) if self.plan.is_tilted else ()),
        )

    def believed_sensor(self, number: int) -> Sensor:
        """Return the camera as a method knows it: its noise, none of its errors."""
        factor = self.all_conditions[number].noise_factor
        return self.sensor.with_(signal_e=self.sensor.signal_e / factor**2)

    def true_sensor(self, number: int) -> Sensor:
        """Return the camera as it is."""
        condition = self.all_conditions[number]
        changes: dict[str, Any] = {}
        if not self.plan.is_tilted:  # a view of its own otherwise
            changes["pitch_deg"] = self.sensor.pitch_deg + condition.pitch_deg
        if condition.wiggling:
            changes["modulation"] = "harmonics"
            changes["harmonics"] = tuple((k, condition.wiggling / k**2, 0.0) for k in _WIGGLES)
        if condition.unit:
            changes["unit_seed"] = condition.unit
            changes["phase_offset_std_rad"] = self.plan.fixed_pattern_rad
        return self.believed_sensor(number).with_(**changes)

    def renderer(self, number: int, sensor: Sensor, *, dimension_error: float | None = None) -> Renderer:
        """Return the renderer of a condition's true landmark; the latest are kept, for analysing a mesh takes time.

        Of a sensor with a [histogram] table it renders the ranges that its chip reports.
        """
        condition = self.all_conditions[number]
        if dimension_error is None:
            dimension_error = condition.dimension_error
        key = (condition.class_name, dimension_error, condition.albedo, sensor.harmonic_orders)
        with self._guard:
            if key not in self._renderers:
                kind = Renderer if sensor.histogram is None else ChipRenderer
                self._renderers[key] = kind(self._mesh(number, dimension_error), sensor, albedo=condition.albedo)
                if len(self._renderers) > _RENDERERS_KEPT:
                    self._renderers.pop(next(iter(self._renderers)))
            return self._renderers[key].seen_by(sensor)

    def _mesh(self, number: int, dimension_error: float) -> trimesh.Trimesh:
        """Return the landmark of a condition, built larger than its plan by a share."""
        mesh = self.objects[self.all_conditions[number].class_name].mesh
        if dimension_error:
            mesh = mesh.copy()
            mesh.vertices *= 1 + dimension_error
        return mesh

    def background(self, number: int) -> Background | None:
        """Return the true background of a condition."""
        wall_m = self.all_conditions[number].wall_m
        return Background(wall_m=wall_m) if wall_m else None

    def image(self, number: int, views: Views) -> PhasorImages:
        """Return noise-free images of a condition's true camera at some views."""
        return self.renderer(number, self.true_sensor(number)).render_views(views, background=self.background(number))

    def frames(self, number: int, method: Method, image: PhasorImages, first: int) -> FilteredFrames:
        """Return the filtered frames of some trials, as a method gets them; `first` is the first one's number."""
        seen = self.raw_frames(number, image, first, on_phasors=method.on == "phasors")
        return (phasor_mean if method.filter == "phasor-mean" else kalman_filter)(seen)

    def raw_frames(self, number: int, image: PhasorImages, first: int, *, on_phasors: bool = False) -> Frames:
        """Return the frames of some trials, (n, n_frames, rows, cols), with the sensor that a method believes in."""
        true, believed = self.true_sensor(number), self.believed_sensor(number)
        if on_phasors:
            true, believed = (sensor.with_(max_phase_std_rad=None) for sensor in (true, believed))
        rng = stream(self.plan.seed, "sweep.noise", number)
        condition = self.all_conditions[number]
        if true.histogram is not None:  # what the chip makes of its counts
            frames = capture_ranges(
                self._mesh(number, condition.dimension_error), true, image.views, albedo=condition.albedo,
                background=self.background(number), rng=rng, n_frames=condition.n_frames, first_view=first,
            )  # fmt: skip
        else:
            frames = capture(image, true, rng=rng, n_frames=condition.n_frames, first_view=first)
        return frames if true == believed else frames.taken_by(believed)

    def bound(self, number: int, method: Method, image: PhasorImages) -> NDArray[np.float64]:
        """Return the Cramér–Rao bound of the true world at the views of an image of it.

        (n, p, p), NaN for what is not estimated.
        """
        free = method.parameters
        found = cramer_rao(
            self.renderer(number, self.true_sensor(number).with_(modulation="sine", harmonics=())), image.views,
            free=free, n_frames=self.all_conditions[number].n_frames,
            on="phasors" if method.on == "phasors" else "ranges", pixels=method.pixels,
            background=self.background(number),
        )  # fmt: skip
        return _spread(found.covariance, free, len(image), self.plan.n_numbers)

    def confusion(self, number: int, views: Views, first: int) -> NDArray[np.float64]:
        """Return a bound on how often another class explains a frame better, (n,); NaN beyond the first few trials.

        It is that of a matcher that knows the world: filtered frames without noise, as they would be were the model
        right, are matched, and the costs of the other classes are their distances (PHYSICS section 7). Beyond a squared
        distance of 100 the matcher does not follow a class; it then counts as that far away, which adds 3e-7.
        """
        found = np.full(len(views), np.nan)
        n = min(len(views), _CONFUSION_TRIALS - first)
        if n <= 0 or self.is_stranger(number):
            return found
        if len(self.class_names) == 1:
            found[:n] = 0.0
            return found
        condition = self.all_conditions[number]
        sensor = self.believed_sensor(number)
        plain = Views.broadcast(views.distance_m[:n], views.delta_rad[:n])
        renderer = self.renderer(number, sensor, dimension_error=0.0)
        image = renderer.render_views(plain, background=self.background(number))
        exact = noise_free(image, condition.n_frames, counts(image.phasor, image.intensity, sensor))
        squares = np.full((n, len(self.class_names)), DEFAULT_POLICY.likely_cost)
        squares[:, self.class_names.index(condition.class_name)] = np.inf
        for k, match in enumerate(self._reference(condition.wall_m).match(exact)):
            for other in match.alternatives:
                c = self.class_names.index(other.class_name)
                if other.class_name != condition.class_name:
                    squares[k, c] = min(squares[k, c], other.cost)
            if match.class_name not in (None, condition.class_name):
                squares[k, self.class_names.index(str(match.class_name))] = 0.0
        found[:n] = confusion_probability(squares)
        return found

    def _reference(self, wall_m: float) -> Matcher:
        """Return maximum likelihood on ranges before a known background."""
        with self._guard:
            if wall_m not in self._references:
                background = Background(wall_m=wall_m) if wall_m else None
                bank = self._bank(Method(name="reference"))
                on = self.explained(Method(name="reference"))
                self._references[wall_m] = Matcher(
                    bank, "refine", free=VIEW[:2], background=None if on == "reported" else background, on=on, workers=1
                )
            return self._references[wall_m]

    def matcher(self, number: int, m: int) -> Callable[[FilteredFrames], Sequence[Match]]:
        """Return a method, ready to match the frames of a condition."""
        method = self.plan.methods[m]
        wall_m = self.all_conditions[number].wall_m if method.knows == "wall" else 0.0
        with self._guard:
            if (method.name, wall_m) not in self._matchers:
                self._matchers[method.name, wall_m] = self._matcher(method, wall_m)
            return self._matchers[method.name, wall_m]

    def _matcher(self, method: Method, wall_m: float) -> Callable[[FilteredFrames], Sequence[Match]]:
        if method.is_program:
            return _imported(method.method)
        bank = self._bank(method)
        background: Background | Literal["auto"] | None = Background(wall_m=wall_m) if wall_m else None
        if method.knows == "auto":
            background = "auto"
        if method.method == "nearest":
            return Matcher(bank, background=background, false_alarm=method.false_alarm).match
        on = self.explained(method)
        return Matcher(
            bank, "refine", free=method.parameters, background=None if on == "reported" else background,
            false_alarm=method.false_alarm, on=on, pixels=method.pixels, workers=1,
        ).match  # fmt: skip

    def bank(self, m: int) -> Bank:
        """Return the bank of a method."""
        with self._guard:
            return self._bank(self.plan.methods[m])

    def _bank(self, method: Method) -> Bank:
        plan = self.plan.bank_plan(method)
        key = json_text(plan)
        if key not in self._banks:
            self._banks[key] = build_bank(plan, workers=1)
        return self._banks[key]

    def _match(self, number: int, m: int, frames: FilteredFrames, first: int) -> Matches:
        method = self.plan.methods[m]
        where = f"method '{method.name}', condition {number}, trials {first} … {first + len(frames) - 1}"
        if method.is_program:
            match = self.matcher(number, m)
            matches = _matches_of_plugin(match, method.method, frames, where, VIEW[: self.plan.n_numbers])
        else:
            try:
                matches = Matches(self.matcher(number, m)(frames))
            except PhasemarkError as error:
                raise type(error)(f"{where}: {error}") from None
        for k, one in enumerate(matches):
            if one.class_name is not None and not np.isfinite([getattr(one, name) for name in VIEW]).all():
                raise UsageError(f"{where}: trial {first + k} names '{one.class_name}' with a view that is not finite")
        return matches

    def _table(self, matches: Matches, method: Method) -> dict[str, Any]:
        n, p = len(matches), self.plan.n_numbers
        covariance = np.full((n, p, p), np.nan)
        for k, one in enumerate(matches):
            if one.covariance is not None:
                covariance[k] = _spread(one.covariance[None], one.free, 1, p)[0]
        found = [NONE if one.class_name is None else self._class_number(one.class_name, method) for one in matches]
        return {
            "estimate": np.stack([getattr(matches, name) for name in VIEW[:p]], axis=1),
            "covariance": covariance,
            "chi2": matches.chi2,
            "dof": matches.dof,
            "p_value": matches.p_value,
            "p_none": [one.class_probability.get("none", np.nan) for one in matches],
            "found": found,
            "accepted": matches.accepted,
            "modes": [1 + len(one.alternatives) if one.class_name is not None else 0 for one in matches],
        }

    def _class_number(self, name: str, method: Method) -> int:
        if name not in self.class_names:
            raise UsageError(f"method '{method.name}' found '{name}', which is none of {', '.join(self.class_names)}")
        return self.class_names.index(name)


def job_of(spec: dict[str, Any]) -> SweepJob:
    """Return the job that :meth:`SweepJob.spec` describes."""
    number, conditions, first, trials = spec["round"]
    return SweepJob(SweepPlan(**spec["plan"]), Round(number, tuple(conditions), first, trials))


def check_matcher(text: str) -> None:
    """Refuse a ``module:callable`` that cannot be imported.

    Raises
    ------
    UsageError
        With the reason; if the module's own code failed, its traceback is a note of the error (:pep:`678`).
    """
    _imported(text)


def _imported(text: str) -> Callable[[FilteredFrames], Sequence[Match]]:
    module, _, name = text.partition(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:
        if isinstance(error, SystemExit) and error.code == _TERMINATED:
            raise
        failed = UsageError(f"the matcher '{text}' cannot be imported ({_named(error)})")
        if own := _own_traceback(error):
            failed.add_note(own)
        raise failed from None
    if not callable(found):
        raise UsageError(f"the matcher '{text}' must be callable, got {type(found).__name__}")
    match: Callable[[FilteredFrames], Sequence[Match]] = found
    return match


def _matches_of_plugin(
    match: Callable[[FilteredFrames], Any], text: str, frames: FilteredFrames, where: str, names: Sequence[str]
) -> Matches:
    """Call a user's matcher, and refuse what is not a Match for each frame."""
    due = f"{where}: the matcher '{text}' must return a Match for each of the {len(frames)} frames"
    try:
        found = match(frames)
        matches = list(found) if isinstance(found, Iterable) else None
    except (Exception, SystemExit) as error:
        failed = UsageError(f"{where}: the matcher '{text}' raised {_named(error)}")
        failed.add_note(_own_traceback(error) or _named(error))
        raise failed from None
    if matches is None:
        raise UsageError(f"{due}, got {'None' if found is None else f'an object of type {type(found).__name__}'}")
    for k, one in enumerate(matches):
        if not isinstance(one, Match):
            raise UsageError(f"{due}, got an object of type {type(one).__name__} for frame {k}")
        if (wrong := _wrong_field(one, names)) is not None:
            raise UsageError(f"{due}, but the Match for frame {k} has {wrong}")
    if len(matches) != len(frames):
        raise UsageError(f"{due}, got {len(matches)}")
    return Matches(matches)


def _wrong_field(match: Match, names: Sequence[str]) -> str | None:
    """Return the fault in the types of a user's match, or None."""
    if not isinstance(match.class_name, str | None):
        return f"'class_name' {match.class_name!r}: it must be a str or None"
    for name in (*names, "chi2", "p_value"):
        value = getattr(match, name)
        if not isinstance(value, numbers.Real):
            return f"'{name}' of type {type(value).__name__}: it must be a number"
    if not isinstance(match.dof, numbers.Integral):
        return f"'dof' of type {type(match.dof).__name__}: it must be a whole number"
    if not isinstance(match.class_probability, Mapping):
        return f"'class_probability' of type {type(match.class_probability).__name__}: it must be a mapping"
    if match.covariance is not None:
        n = len(match.free)
        if not set(match.free) <= set(names):
            return f"'free' {match.free!r}: it must name some of {', '.join(names)}"
        if np.shape(match.covariance) != (n, n):
            return f"'covariance' of shape {np.shape(match.covariance)}: it must be {(n, n)}, as 'free' has {n} names"
    return None


def _named(error: BaseException) -> str:
    """Return type and message of an exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split()).rstrip(":")


def _own_traceback(error: BaseException) -> str:
    """Return the traceback of a user's code, without our calls and those that import it; empty if nothing is left."""
    own = error.__traceback__
    while own is not None and _is_ours_or_import(own.tb_frame.f_code.co_filename):
        own = own.tb_next
    return "" if own is None else "".join(traceback.format_exception(type(error), error, own)).rstrip()


def _is_ours_or_import(filename: str) -> bool:
    return filename in (__file__, importlib.__file__) or filename.startswith("<frozen importlib")


def _spread(matrix: NDArray[np.float64], free: Sequence[str], n: int, p: int) -> NDArray[np.float64]:
    """Put matrices over some parameters into matrices over the first p of a view, NaN elsewhere."""
    full = np.full((n, p, p), np.nan)
    at = [VIEW.index(name) for name in free]
    full[:, np.array(at)[:, None], at] = matrix
    return full
