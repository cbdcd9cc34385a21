"""Matching frames against a bank: the paper's nearest image, or maximum likelihood in between."""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.matcher.chi_squared import usual_count
from phasemark.matcher.estimate.acceptance import Rules, with_parts
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.filters.region import read_region
from phasemark.matcher.frequencies import OneFrequencyBank
from phasemark.matcher.histograms.direct_matcher import check_histogram_sensor, refuse_other_sensor
from phasemark.matcher.histograms.histogram_matcher import HistogramMatcher
from phasemark.matcher.histograms.scene_models import relative_poses
from phasemark.matcher.histograms.target_matcher import TargetMatcher
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.likelihood_matcher import LikelihoodMatcher, usual_workers
from phasemark.matcher.likelihood.search_policy import DEFAULT_POLICY, SearchPolicy
from phasemark.matcher.likelihood.setup import BEARING_STD_RAD, TILT_STD_RAD, Pixels, check_free, setup_of
from phasemark.matcher.likelihood.shared_errors import with_motion
from phasemark.matcher.likelihood.systematic import SYSTEMATICS, carried_errors, check_systematic, declared_covariance
from phasemark.matcher.match import TOLERANCE_M, TOLERANCE_RAD, Match, Matches, views_of
from phasemark.matcher.nearest.nearest_matcher import NearestMatcher
from phasemark.matcher.one_frequency import OneFrequency
from phasemark.render import Background, Frames, Renderer, Sensor
from phasemark.render.direct.histogram_frames import HistogramFrames
from phasemark.render.direct.targets import Targets
from phasemark.render.threads import check_workers

METHODS = ("nearest", "refine")
Measured = Literal["ranges", "reported", "phasors", "histograms", "targets"]
"""What is matched on."""
DIRECT_KINDS = ("histograms", "targets")
"""What of it a direct sensor alone measures."""
_LEAST = 1e-9
"""Least standard deviation or tolerance, metres or radians: the square of a smaller one is lost in rounding."""


class Matcher:
    """Matches filtered frames against a bank.

    ``Matcher(bank, "refine", background="auto").match(kalman_filter(frames))`` is the usual call. State what is known:
    `background`, what stands behind the landmark, and `free`, what of the view is estimated. Few need to change the
    other parameters.

    Parameters
    ----------
    bank : Bank
        Model images.
    method : {"nearest", "refine"}
        "nearest" is the paper's minimum-distance classifier: the answer is the nearest model image. In a factored
        bank the lower pixels choose distance and angle, and the upper pixels the class at that distance; in a full
        bank all pixels choose all three. "refine" is maximum likelihood over a continuous view, with its covariance.
    free : sequence of str, optional
        What "refine" estimates: distance_m and delta_rad, and on request any of bearing_rad, height_m, pitch_rad and
        roll_rad; what is not free is 0. None: distance, delta and the bearing, whose Gaussian prior has mean 0 and the
        standard deviation `bearing_std_rad` before the frame is seen; of reported ranges pitch and roll too.
        ``("distance_m", "delta_rad")`` fixes the bearing at 0.
    background : Background, "auto", "unknown", "any" or None
        What stands behind the landmark. None: nothing is expected to return beside it. "auto", with "refine": wall and
        floor are estimated from each frame's own far pixels; of histograms a wall alone, its distance and brightness.
        "any", with "refine" on ranges or phasors: None, then "auto", then "unknown", up to what explains the frame.
        "unknown", with "refine" on ranges: other things may stand before, beside and behind it; what the landmark does
        not explain costs a disagreement when views and classes are compared, and is left out of the test of the fit.
        Histograms take the albedos of a Background as guesses, targets as known.
    false_alarm : float
        Share of good frames that the test of the fit may refuse.
    on : {"ranges", "reported", "phasors", "histograms", "targets"}
        What "refine" explains: ranges, or amplitude · exp(iφ) with the landmark's albedo estimated too. Phasors need
        frames with amplitudes, best from :func:`~phasemark.matcher.phasor_mean`. Of several modulation frequencies
        ranges are the unwrapped ones with their combined variance; phasors, and the phases that "nearest" compares, are
        those of every frequency, each wrapped by itself: nothing is unwrapped, and mixed pixels count. Of a direct
        sensor with a [histogram] table also the counts of every bin, Poisson, with the landmark's brightness and the
        ambient light of every zone estimated, or the targets that its chip reports. "reported": its ranges
        as the chip makes them, of the nearest surface of each zone; all else that returns is left to unknown things.
    pixels : {"all", "lower"}
        Which pixels give "refine" the view. All of them tell the class.
    robust : bool
        Whether "refine" counts residuals beyond 3 σ linearly (Huber); the covariance is then the jackknife's.
    bearing_std_rad : float, optional
        How well the mount points at the landmark, where `free` is None: the standard deviation of a Gaussian prior.
        None: 1.5°, of reported ranges 3°.
    height_std_m, pitch_std_rad, roll_std_rad : float
        How well height, pitch and roll are known where they are free: standard deviations of Gaussian priors with mean
        0, or the pitch and roll that frames state; infinite where nothing is known. Where pitch or roll is not free, it
        is as stated. Starts are looked for up to three of them away, within a quarter of the
        image.
    systematic : collection of {"calibration", "recording", "declared", "multipath", "motion"}, optional
        Which errors that all frames of the camera share are added to the covariance of "refine": what the calibration
        of the frames' sensor leaves, what differs in another recording than those that calibrated it, what the sensor
        declares of a pose, light that bounces off a floor below the landmark where no background says how often it may
        (`lamp_half_angle_deg` of the sensor is needed), and what the jitter of its stamps makes of the camera's motion.
        None: all; of histograms and targets "declared" and "motion".
    tolerance_m, tolerance_rad : float
        How far off an accepted answer may be. An answer is refused as "undetermined" where the frame leaves a free
        length or angle open by more than this, and as "ambiguous" where another class, or a view farther away than
        this, explains the frame too.
    workers : int, optional
        Threads that render (None: one for each processor), where "refine" renders; the answer does not depend on it.
    policy : SearchPolicy, optional
        How wide and how long "refine" searches in ranges and phasors: see :class:`~phasemark.matcher.SearchPolicy`.

    Attributes
    ----------
    bank, method, false_alarm
        As given.
    options : mapping
        What `free`, `background`, `on`, `pixels` and `robust` were given as.
    free : tuple of str
        Parameters of the view that are estimated.

    Raises
    ------
    UsageError
        The method or an option is unknown, an option does not go with the method, or the false-alarm rate is not in
        (0, 1).

    Notes
    -----
    `chi2` of "nearest" tests how well the nearest image explains the frame, after the linear change of the ranges
    within its grid cell is taken out: the frame lies between grid points, and what the interpolation cannot follow (at
    edges) is added to the variance. Its p-value is therefore approximate. With "refine" it is that of the fit.
    """

    def __repr__(self) -> str:
        """Describe in one line the method and the bank."""
        usual = (None, False, "all", "ranges")
        stated = [f"{name}={value!r}" for name, value in self.options.items() if value not in usual]
        return f"Matcher({', '.join([self.method, *stated])}, {self.bank!r})"

    def __init__(
        self,
        bank: Bank,
        method: str = "nearest",
        *,
        free: Sequence[str] | None = None,
        background: Background | Literal["auto", "unknown", "any"] | None = None,
        false_alarm: float = 0.01,
        on: Measured = "ranges",
        pixels: Pixels = "all",
        robust: bool = False,
        bearing_std_rad: float | None = None,
        height_std_m: float = math.inf,
        pitch_std_rad: float = TILT_STD_RAD,
        roll_std_rad: float = TILT_STD_RAD,
        systematic: Collection[str] | None = None,
        tolerance_m: float = TOLERANCE_M,
        tolerance_rad: float = TOLERANCE_RAD,
        workers: int | None = None,
        policy: SearchPolicy | None = None,
    ) -> None:
        if not hasattr(bank, "sensor"):
            raise UsageError(f"'bank' must be a bank, got {type(bank).__name__}: open_bank opens a file")
        _check_word("method", method, METHODS)
        _check_word("on", on, ("ranges", "phasors", "reported", *DIRECT_KINDS))
        _check_word("pixels", pixels, ("all", "lower"))
        if not isinstance(robust, bool | np.bool_):
            raise UsageError(f"'robust' must be True or False, got {robust!r}")
        if workers is not None:
            check_workers(workers)
        if background is not None and not isinstance(background, Background):
            _check_word("background", background, ("auto", "unknown", "any"), "a Background, None, ")
        stated = {
            "bearing_std_rad": bearing_std_rad,
            "height_std_m": height_std_m,
            "pitch_std_rad": pitch_std_rad,
            "roll_std_rad": roll_std_rad,
            "tolerance_m": tolerance_m,
            "tolerance_rad": tolerance_rad,
        }
        for name, value in stated.items():
            if value is None:
                continue
            if not value > 0:
                raise UsageError(f"'{name}' must be positive, got {value!r}")
            if value < _LEAST:
                raise UsageError(f"'{name}' must be at least {_LEAST:g}, got {value!r}: leave out of 'free' what is 0")
            widest = math.pi if name == "tolerance_rad" else math.pi / 4
            if name.endswith("_rad") and widest < value < math.inf:
                raise UsageError(
                    f"'{name}' is an angle in radians, at most {widest:.3g}, got {value!r}: use math.radians of degrees"
                )
        if not 0 < false_alarm < 1:
            raise UsageError(f"'false_alarm' must be in (0, 1), got {false_alarm!r}")
        limits = {"false_alarm": false_alarm, "tolerance_m": tolerance_m, "tolerance_rad": tolerance_rad}
        self.bank = bank
        self.method = method
        self.false_alarm, self.tolerance_m, self.tolerance_rad = false_alarm, tolerance_m, tolerance_rad
        self.options: Mapping[str, Any] = MappingProxyType(
            {"free": free, "background": background, "on": on, "pixels": pixels, "robust": robust}
        )
        arguments = {
            **self.options, **stated, "false_alarm": false_alarm, "systematic": systematic, "workers": workers,
            "policy": policy,
        }  # fmt: skip
        self._made_from = bank, method, arguments
        self._one: OneFrequency | None = None
        self._systematic = check_systematic(SYSTEMATICS if systematic is None else systematic)
        self._by_evidence: list[Matcher] = []
        self._direct: HistogramMatcher | TargetMatcher | None = None
        self.free: tuple[str, ...] = VIEW[:2]
        if on in DIRECT_KINDS:
            _refuse_direct_options(method, on, background, pixels, robust, systematic or (), policy is not None)
            known = {"height_m": height_std_m, "pitch_rad": pitch_std_rad, "roll_rad": roll_std_rad}
            if free is None:
                known["bearing_rad"] = bearing_std_rad or BEARING_STD_RAD
            self.free = VIEW[:3] if free is None else check_free(free)
            check_histogram_sensor(bank)
            common: dict[str, Any] = {
                "prior_std": [known.get(name, math.inf) for name in self.free],
                "rules": Rules.of_bank(bank, self.free, **limits),
                "background": background,
                "workers": workers or usual_workers(),
            }
            self._direct = HistogramMatcher(bank, **common) if on == "histograms" else TargetMatcher(bank, **common)
            return
        if len(bank.sensor.frequencies_hz) > 1:
            # mixed pixels have no range that the frequencies agree on, and before a background they are at every edge
            unwraps = method == "refine" and on == "ranges" and not isinstance(background, Background)
            bank = OneFrequencyBank(bank, "combined" if unwraps else "stacked")
            self._one = bank.one
        self._method: LikelihoodMatcher | NearestMatcher
        if on == "reported" and (method != "refine" or bank.sensor.histogram is None):
            raise UsageError('on="reported" goes with method "refine" and a direct sensor with a [histogram] table')
        if on == "reported" and (background == "auto" or isinstance(background, Background)):
            raise UsageError(
                "on=\"reported\" takes what stands behind the landmark for unknown: leave 'background' out"
            )
        if method == "refine" and background == "any" and on != "reported":
            self._by_evidence = self._stages(arguments)
            self.free = self._by_evidence[0].free
            return
        if method == "refine":
            told: dict[str, Any] = {**self.options, **stated, "false_alarm": false_alarm}
            setup = setup_of(bank, **told, policy=policy or DEFAULT_POLICY)
            self._method, self.free = LikelihoodMatcher(setup, self._systematic, workers), setup.free
            return
        if systematic is not None or policy is not None:
            raise UsageError("'systematic' and 'policy' belong to method 'refine', not 'nearest'")
        if isinstance(background, Background) and background.bounces:
            raise UsageError("light that bounces belongs to method 'refine', not 'nearest': leave 'bounces' out")
        fixed = free is None or tuple(free) == VIEW[:2]
        if not fixed or on != "ranges" or pixels != "all" or robust or isinstance(background, str):
            raise UsageError(
                "'free', 'on', 'pixels', 'robust' and an automatic background belong to method 'refine', not 'nearest'"
            )
        self._method = NearestMatcher(bank, background=background, **limits)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle a matcher as what it was made from."""
        bank, method, arguments = self._made_from
        return functools.partial(Matcher, bank, method, **arguments), ()

    @property
    def table_bytes(self) -> int:
        """How much memory a table of histograms takes, which is rendered when frames come first; 0 on ranges."""
        return 0 if self._direct is None else self._direct.table_bytes

    def match(self, frames: FilteredFrames | HistogramFrames | Targets) -> Matches:
        """Match a batch of filtered frames, or of what a direct sensor counted or reported.

        Parameters
        ----------
        frames : FilteredFrames, HistogramFrames or Targets
            n positions. The range offset that their sensor states is taken off: a bank has none. ``on="histograms"``
            takes histograms, the frames of a position added up; ``on="targets"`` takes targets, or the histograms that
            the chip makes them of.

        Returns
        -------
        Matches
            n answers; one with class None where there is no landmark.

        Raises
        ------
        UsageError
            The frames come from another camera than the bank, or are not what is matched on.
        """
        on = self.options["on"]
        if self._by_evidence:
            return self._match_by_evidence(frames)
        if self._direct is not None:
            return Matches(self._matched_directly(self._direct, frames))
        if isinstance(frames, Frames):
            raise UsageError("frames must be filtered first: kalman_filter(frames)")
        if not isinstance(frames, FilteredFrames):
            raise UsageError(
                f'on="{on}" takes filtered frames: match histograms on="histograms", or their targets on="targets"'
            )
        frames = self.read_out(frames).without_offset()
        if self.method == "nearest" and frames.tilts_rad.any():
            raise UsageError('frames with a tilt take method="refine": the images of a bank are level')
        found = self._method.match(self._with_noise(frames))
        if self._one is None and (guessed := _of_unknown_noise(frames, found)):
            again = self._method.match(self._with_noise(frames[guessed], [found[k] for k in guessed]))
            for k, answer in zip(guessed, again, strict=True):
                found[k] = answer
        return Matches(found)

    def _with_noise(self, frames: FilteredFrames, seen: Sequence[Match] = ()) -> FilteredFrames:
        """Return frames as they are compared, of noise that few of them tell with that in the light of answers."""
        light = np.zeros((2, *frames.range_m.shape))
        for name in sorted({match.class_name for match in seen if match.class_name is not None}):
            which, renderer = [k for k, match in enumerate(seen) if match.class_name == name], self.renderer(name)
            views = views_of([seen[k] for k in which])
            aimed = views.in_camera(renderer.sensor)
            behind = [
                own and replace(own, bounces=0).giving_way(renderer.footprint, aimed[i : i + 1])
                for i, own in enumerate(seen[k].background for k in which)
            ]
            image = renderer.render_views(views, background=behind)
            light[:, which] = image.amplitude, image.intensity
        frames = frames.with_pooled_noise((light[0], light[1])).with_fixed_pattern()
        if self.options["on"] == "reported":
            frames = frames.with_chip_error()
        return frames if self._one is None else self._of_one_frequency(frames, self._one)

    def renderer(self, class_name: str) -> Renderer:
        """Return what renders a landmark of the bank, with what matching has computed of the light around it.

        Parameters
        ----------
        class_name : str

        Returns
        -------
        Renderer

        Raises
        ------
        UsageError
            The bank does not have the class.
        """
        mesh = self.bank.mesh(class_name)
        own = self._by_evidence[0] if self._by_evidence else self
        if own.method == "refine" and isinstance(own._method, LikelihoodMatcher):
            return own._method.scenes.rendered.renderer(self.bank.classes.index(class_name))
        return Renderer(mesh, self.bank.sensor, albedo=float(mesh.metadata["albedo"]))

    @property
    def is_quick(self) -> bool:
        """Whether a search of a frame renders nothing: some milliseconds, so that tracking saves no time."""
        return not self._by_evidence and self._direct is None and getattr(self._method, "is_quick", False)

    def track(self, frames: FilteredFrames, near: Sequence[Match]) -> Match:
        """Match one frame from the views that are expected of it: no search, and no look for rivals elsewhere.

        What a camera shows a moment later costs a refinement. The answer is refused for the reasons of
        :meth:`match`, but the rivals it is compared with are the expected views alone; so a full match has to be made
        from time to time. Errors that all frames share are those of the first expected view.

        Parameters
        ----------
        frames : FilteredFrames
            One position.
        near : sequence of Match
            Answers for earlier frames, with the views that are expected now.

        Returns
        -------
        Match

        Raises
        ------
        UsageError
            The method is not "refine", histograms or targets are matched, no view is expected, there are several
            frames, or the frame comes from another camera than the bank.
        """
        if self.method != "refine" or self._direct is not None:
            raise UsageError('track takes method="refine" on ranges, reported ranges or phasors')
        near = [one for one in near if one.class_name is not None]
        if not near or len(frames) != 1:
            raise UsageError("track takes one frame and at least one expected view")
        if self._by_evidence:
            kinds = {None: near[0].background is None and not near[0].among_unknown, "unknown": near[0].among_unknown}
            own = (one for one in self._by_evidence if kinds.get(one.options["background"], True))
            return next(own, self._by_evidence[0]).track(frames, near)
        assert isinstance(self._method, LikelihoodMatcher)
        frames = self.read_out(frames).without_offset()
        seen = near[:1] if self._one is None and _of_unknown_noise(frames, near[:1]) else ()
        found = self._method.track(self._with_noise(frames, seen), near)
        return with_parts(self._method.setup.rules, found, dict(near[0].systematic))

    def match_jointly(self, frames: HistogramFrames, camera2world: ArrayLike) -> Match:
        """Match histograms of several known poses as those of one landmark that is seen from all of them.

        The likelihoods of all frames are multiplied, so that their information adds. The brightness of the landmark and
        the ambient light are estimated in each frame, as is the wall of an automatic background. Frames that contradict
        each other are a poor fit: the test is of all frames together, of each, and of what they gain by views and
        classes of their own.

        Parameters
        ----------
        frames : HistogramFrames
            n positions, of one sensor that is moved or of n sensors of the bank's kind.
        camera2world : (n, 4, 4) array_like
            Pose of the camera at each position, in a frame that all have in common: x along the axis, y left, z up.

        Returns
        -------
        Match
            The view is that of the first position; `free` names its parameters.

        Raises
        ------
        UsageError
            The matcher is not one of histograms, a wall is stated, which stands at another distance at every position,
            the poses are not as many as the positions, one is not rigid, or the frames are not what is matched on.
        """
        if not isinstance(self._direct, HistogramMatcher):
            raise UsageError(f'match_jointly takes on="histograms", got on="{self.options["on"]}"')
        behind = self.options["background"]
        if isinstance(behind, Background) and behind.wall_m is not None:
            raise UsageError(
                "'background' must have no wall in match_jointly, for its distance changes with the pose: give \"auto\""
            )
        measured = cast(HistogramFrames, self._direct_frames(frames))
        found = self._direct.match_jointly(measured, relative_poses(len(measured), camera2world))
        return self._with_direct_errors(self._direct.rules, frames.sensor, None, [found])[0]

    def _matched_directly(self, method: HistogramMatcher | TargetMatcher, frames: object) -> list[Match]:
        """Return answers for histograms or targets, with what all frames of the sensor share."""
        found = method.match(self._direct_frames(frames))  # type: ignore[arg-type]
        sensor, time_s = self.bank.camera, None
        if isinstance(frames, HistogramFrames):
            sensor, time_s = frames.sensor, frames.time_s
        return self._with_direct_errors(method.rules, sensor, time_s, found)

    def _direct_frames(self, frames: object) -> HistogramFrames | Targets:
        """Return frames as histograms or targets are matched; refuse what is not matched on."""
        on = self.options["on"]
        if isinstance(frames, HistogramFrames):
            refuse_other_sensor(self.bank.camera, frames.sensor)
            return frames.targets if on == "targets" else frames
        if on == "targets" and isinstance(frames, Targets):
            return frames
        takes = "HistogramFrames" if on == "histograms" else "Targets, or HistogramFrames"
        raise UsageError(f'on="{on}" takes {takes}, got {type(frames).__name__}')

    def _with_direct_errors(
        self, rules: Rules, sensor: Sensor, time_s: NDArray[np.float64] | None, answers: list[Match]
    ) -> list[Match]:
        """Return answers whose covariances hold what the sensor declares and what the jitter of stamps makes of motion.

        They are refused as "undetermined" where they no longer are within the tolerance.
        """
        declared = declared_covariance(sensor, rules.free)
        if "declared" in self._systematic and declared.any():
            answers = [with_parts(rules, match, {"declared": declared}) for match in answers]
        if "motion" not in self._systematic or time_s is None:
            return answers
        return with_motion(rules.free, sensor.systematic_time_s, time_s.mean(axis=1), answers)

    def _stages(self, arguments: dict[str, Any]) -> list[Matcher]:
        """Return the matchers whose backgrounds are tried in turn: each takes less for known than the one before."""
        on, several = arguments["on"], len(self.bank.sensor.frequencies_hz) > 1
        behind: list[str | None] = [None]
        if on == "ranges" or (on == "phasors" and not several):
            behind.append("auto")
        if on != "phasors":
            behind.append("unknown")
        return [Matcher(self.bank, "refine", **{**arguments, "background": own}) for own in behind]

    def _match_by_evidence(self, frames: FilteredFrames | HistogramFrames | Targets) -> Matches:
        """Match frames before the first background that explains them; where none does, answer as the last but one.

        Among unknown things nearly all can be left out: what they say counts where they show a landmark.
        """
        answers = list(self._by_evidence[0].match(frames))
        tilted = np.zeros(len(frames), np.bool_)
        if isinstance(frames, FilteredFrames):
            tilted |= frames.tilts_rad.any(axis=1)
        for matcher in self._by_evidence[1:]:
            left = [k for k, answer in enumerate(answers) if not self._explains(answer)]
            if matcher.options["background"] == "auto":  # walls and floors are told from level frames
                left = [k for k in left if not tilted[k]]
            if not left:
                continue
            again = matcher.match(cast(FilteredFrames, frames)[np.array(left)])
            for k, answer in zip(left, again, strict=True):
                if answer.class_name is not None or not answer.among_unknown:
                    answers[k] = answer
        return Matches(answers)

    def _explains(self, answer: Match) -> bool:
        """Return whether a frame is explained, be it that other views explain it too, or that it tells too little."""
        return answer.accepted or (answer.class_name is not None and answer.p_value >= self.false_alarm)

    def _of_one_frequency(self, frames: FilteredFrames, one: OneFrequency) -> FilteredFrames:
        """Return the frames that a camera of one frequency would have measured in place of the camera of several."""
        if one.stacked and self.method == "refine":
            for term, left in carried_errors(frames.sensor, self._systematic).items():
                raise UsageError(
                    f"what a {term} leaves of '{left.fields[0]}' is carried over on unwrapped ranges alone with several"
                    f" modulation frequencies: leave \"{term}\" out of 'systematic'"
                )
        return one.frames(frames)

    def read_out(self, frames: FilteredFrames) -> FilteredFrames:
        """Return frames as the bank has its images: those of the whole camera cut down to the bank's region.

        Parameters
        ----------
        frames : FilteredFrames
            Of the bank's camera, or of one that reads the region itself.

        Returns
        -------
        FilteredFrames

        Raises
        ------
        UsageError
            The frames come from another camera, or pixels are to be added up whose amplitudes are unknown.
        """
        bank = self.bank
        difference = frames.sensor.optics_difference(bank.sensor)
        if difference is None:
            return frames
        if bank.region is not None:
            difference = frames.sensor.optics_difference(bank.camera)
            if difference is None:
                return read_region(frames, bank.region)
        raise UsageError(f"the frames were taken with another sensor than the bank's: {difference}")


def _of_unknown_noise(frames: FilteredFrames, answers: Sequence[Match]) -> list[int]:
    """Return which frames of a phase camera say little of their noise, of those whose answer tells their light."""
    if frames.sensor.kind != "phase" or not frames.std_from_scatter or frames.amplitude_e is not None:
        return []
    enough = 50.0  # exposures of which the scatter of a pixel says as much as a law
    hopeless = 20.0  # χ² over its degrees of freedom that no light of a landmark explains
    few = usual_count(frames) < enough
    return [
        k
        for k, answer in enumerate(answers)
        if few[k] and answer.class_name is not None and not answer.chi2 > hopeless * max(answer.dof, 1)
    ]


def _check_word(name: str, value: object, words: tuple[str, ...], before: str = "") -> None:
    """Refuse what is not one of some words; an array, which other functions take there, is named by its type."""
    if not isinstance(value, str) or value not in words:
        shown = repr(value) if isinstance(value, str) else type(value).__name__
        raise UsageError(f"'{name}' must be {before}{' or '.join(map(repr, words))}, got {shown}")


def _refuse_direct_options(
    method: str, on: str, background: Background | Literal["auto", "unknown", "any"] | None, pixels: str, robust: bool,
    systematic: Collection[str], policy: bool,
) -> None:  # fmt: skip
    """Refuse options that do not go with histograms and targets.

    `systematic` was asked for, `policy` says whether one was.

    Raises
    ------
    UsageError
        Naming the option.
    """
    wrong = {
        "'method' must be refine": method != "refine",
        "'background' must be a Background, 'auto' or None": background in ("unknown", "any"),
        "'background' must be a Background or None, for targets do not tell it": on == "targets"
        and background == "auto",
        "'pixels' must be all": pixels != "all",
        "'robust' must be False": robust,
        **{
            f"'systematic' must be without '{term}', which is carried into ranges and phasors alone": term in systematic
            for term in ("calibration", "recording")
        },
        "'policy' must be None, for it steers the search in ranges and phasors alone": policy,
    }
    for problem, is_wrong in wrong.items():
        if is_wrong:
            raise UsageError(f'on="{on}": {problem}')
