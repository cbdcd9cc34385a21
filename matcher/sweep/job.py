"""The trials of a sweep: worlds rendered, frames captured once, and every method tried on them.

A sweep's trials are a file built in shards (:mod:`phasemark.data.shards.build`): interrupted runs go on, and the bytes
depend neither on the number of workers nor on where they run. Slabs are conditions and items are trials. Truth and
noise of a trial depend on the seed, its condition and its number alone, so all methods see the same frames.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import astuple, dataclass
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
from phasemark.inputs.own_program import imported_program
from phasemark.matcher.accuracy.cramer_rao import confusion_probability, cramer_rao
from phasemark.matcher.filters.filtered_frames import FilteredFrames, noise_free
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.filters.mean_phasor import phasor_mean
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.search_policy import DEFAULT_POLICY
from phasemark.matcher.match import Matches
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.pixel_agreement import counts
from phasemark.matcher.sweep.own_matcher import MatchFrames, own_matches
from phasemark.matcher.sweep.plan import Condition, Method, SweepPlan
from phasemark.render import Background, Frames, PhasorImages, Renderer, Sensor, Views, capture
from phasemark.render.direct.capture import capture_ranges
from phasemark.render.direct.chip_renderer import ChipRenderer

FORMAT = "phasemark-trials"
SCHEMA_VERSION = 1
NONE = -1
"""Stands for "no landmark" where a class's number would be."""


_Field = tuple[str, tuple[int, ...], str, str]
"""Name, shape, type and meaning of a field."""


def _fields(p: int) -> tuple[tuple[_Field, ...], tuple[_Field, ...]]:
    """Return the fields that are stored of each trial, and of each method's match of it; views have p numbers."""
    names = ", ".join(VIEW[:p])
    order = ", ".join(name.split("_")[0] for name in VIEW[:p])
    return (
        ("truth", (p,), "<f8", names),
        ("confusion", (), "<f8", "bound on the probability of a wrong class; NaN where it was not computed"),
    ), (
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


STORED = ("condition", "trial", *(name for fields in _fields(0) for name, *_ in fields))
"""Names of all arrays that a file of trials holds."""
_REFERENCE = Method(name="reference", knows="bounces")
"""Maximum likelihood on ranges before a known background."""
_WIGGLES = (3, 5, 7)


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

    @classmethod
    def first_of(cls, plan: SweepPlan) -> Round:
        """Return the first round of a sweep: all conditions."""
        most = plan.max_trials if plan.until_percent is not None else None
        return cls(0, tuple(range(len(plan.conditions()))), 0, min(plan.trials, most or plan.trials))


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
        self._matchers: dict[tuple[Method, Background | Literal["auto"] | None], MatchFrames] = {}
        self._renderers: dict[tuple[Any, ...], Renderer] = {}
        self._guard = threading.RLock()

    @property
    def maker(self) -> str:
        """What makes this job in another process."""
        return "phasemark.matcher.sweep.job:job_of"

    def spec(self) -> dict[str, Any]:
        """Return a description from which another process makes the same job."""
        number, conditions, first, trials = astuple(self.of)
        return {"plan": self.plan.model_dump(mode="json"), "round": [number, list(conditions), first, trials]}

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
        meshes = {name: mesh_sha256(part.mesh) for name, part in self.objects.items()}
        return {**self.spec(), "versions": versions(), "mesh_sha256": meshes}

    def lay_out(self) -> tuple[Layout, list[list[Place]]]:
        """Return all but the trials, and where these go."""
        n = sum(self.items)
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
            for fields, each in zip(_fields(self.plan.n_numbers), ((), (len(self.plan.methods),)), strict=True):
                for name, shape, kind, long_name in fields:
                    dataset, offset = layout.reserve(file, name, (n, *each, *shape), kind)
                    dataset.attrs["long_name"] = long_name
                    first.append(Place(offset, math.prod((*each, *shape)) * np.dtype(kind).itemsize))
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
        p = self.plan.n_numbers
        truth = np.stack([getattr(views, name) for name in VIEW[:p]], axis=1)
        _, own = _fields(p)
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
            if what not in bounds:
                bounds[what] = self.bound(number, method, views)
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
        factor, sensor = self.all_conditions[number].noise_factor, self.sensor
        changes = {name: getattr(sensor, name) / factor**2 for name in ("signal_e", "ambient_e", "dark_e")}
        changes["read_noise_e"] = sensor.read_noise_e / factor
        return sensor.with_(**{name: value for name, value in changes.items() if value != getattr(sensor, name)})

    def albedo_before(self, number: int, name: str) -> float:
        """Return the albedo of another landmark under a condition."""
        if "albedo" in self.plan.axes:
            return self.all_conditions[number].albedo
        return next(one.albedo for one in self.all_conditions if one.class_name == name)

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
                renderers_kept = 16
                if len(self._renderers) > renderers_kept:
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
        return self.all_conditions[number].background()

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
                self._mesh(number, condition.dimension_error), true, self.views(number, first, first + len(image)),
                albedo=condition.albedo, background=self.background(number), rng=rng, n_frames=condition.n_frames,
                first_view=first,
            )  # fmt: skip
        else:
            frames = capture(image, true, rng=rng, n_frames=condition.n_frames, first_view=first)
        return frames if true == believed else frames.taken_by(believed)

    def bound(self, number: int, method: Method, views: Views) -> NDArray[np.float64]:
        """Return the Cramér–Rao bound of the true world at some views.

        (n, p, p), NaN for what is not estimated, and for strangers.
        """
        free, p = method.parameters, self.plan.n_numbers
        if self.is_stranger(number):
            return np.full((len(views), p, p), np.nan)
        found = cramer_rao(
            self.renderer(number, self.true_sensor(number).with_(modulation="sine", harmonics=())), views,
            free=free, n_frames=self.all_conditions[number].n_frames,
            on="phasors" if method.on == "phasors" else "ranges", pixels=method.pixels,
            background=self.background(number),
        )  # fmt: skip
        return _spread(found.covariance, free, len(views), p)

    def confusion(self, number: int, views: Views, first: int) -> NDArray[np.float64]:
        """Return a bound on how often another class explains a frame better, (n,); NaN beyond the first few trials.

        It is that of a matcher that knows the world: filtered frames without noise, as they would be were the model
        right, are matched, and the costs of the other classes are their distances (PHYSICS section 7). Beyond a squared
        distance of 100 the matcher does not follow a class; it then counts as that far away, which adds 3e-7.
        """
        found = np.full(len(views), np.nan)
        # views of a condition, which hardly differ, for which the bound on class confusion is computed
        confusion_trials = 4
        n = min(len(views), confusion_trials - first)
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
        for k, match in enumerate(self.matcher(_REFERENCE, condition)(exact)):
            for other in match.alternatives:
                c = self.class_names.index(other.class_name)
                if other.class_name != condition.class_name:
                    squares[k, c] = min(squares[k, c], other.cost)
            if match.class_name not in (None, condition.class_name):
                squares[k, self.class_names.index(str(match.class_name))] = 0.0
        found[:n] = confusion_probability(squares)
        return found

    def matcher(self, method: Method, condition: Condition) -> MatchFrames:
        """Return a method, ready to match frames before the background that it may know; it is kept."""
        background: Background | Literal["auto"] | None = None
        if method.knows in ("wall", "bounces"):
            background = condition.background(bounces=method.knows == "bounces")
        elif method.knows == "auto":
            background = "auto"
        with self._guard:
            if (method, background) not in self._matchers:
                self._matchers[method, background] = self._matcher(method, background)
            return self._matchers[method, background]

    def _matcher(self, method: Method, background: Background | Literal["auto"] | None) -> MatchFrames:
        if method.is_program:
            match: MatchFrames = imported_program(method.method, "the matcher")
            return match
        bank = self.bank(method)
        if method.method == "nearest":
            return Matcher(bank, background=background, false_alarm=method.false_alarm).match
        on = self.explained(method)
        return Matcher(
            bank, "refine", free=method.parameters, background=None if on == "reported" else background,
            false_alarm=method.false_alarm, on=on, pixels=method.pixels, workers=1,
        ).match  # fmt: skip

    def bank(self, method: Method) -> Bank:
        """Return the bank of a method; it is kept."""
        plan = self.plan.bank_plan(method)
        key = json_text(plan)
        with self._guard:
            if key not in self._banks:
                self._banks[key] = build_bank(plan, workers=1)
            return self._banks[key]

    def _match(self, number: int, m: int, frames: FilteredFrames, first: int) -> Matches:
        method = self.plan.methods[m]
        where = f"method '{method.name}', condition {number}, trials {first} … {first + len(frames) - 1}"
        condition = self.all_conditions[number]
        if method.is_program:
            match = self.matcher(method, condition)
            matches = own_matches(match, method.method, frames, where, VIEW[: self.plan.n_numbers])
        else:
            try:
                matches = Matches(self.matcher(method, condition)(frames))
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


def _spread(matrix: NDArray[np.float64], free: Sequence[str], n: int, p: int) -> NDArray[np.float64]:
    """Put matrices over some parameters into matrices over the first p of a view, NaN elsewhere."""
    full = np.full((n, p, p), np.nan)
    at = [VIEW.index(name) for name in free]
    full[:, np.array(at)[:, None], at] = matrix
    return full
