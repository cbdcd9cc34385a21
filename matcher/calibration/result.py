"""Result of a calibration: the mounting with its covariance, as plain numbers and as a sensor file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from phasemark.matcher.calibration.known_poses import POSE_UNITS, KnownPoses
from phasemark.matcher.calibration.mounting import HALF_ANGLES, MOUNTING_NAMES, NAMES, PARAMETERS, Mounting
from phasemark.matcher.calibration.problem import Fitted, Solution, rms
from phasemark.matcher.calibration.recording_effects import own_title
from phasemark.matcher.likelihood.residuals import ResidualKind
from phasemark.matcher.likelihood.systematic import RECORDING_FIELDS
from phasemark.render import Sensor
from phasemark.render.integral.rounding import error_text, value_and_error, with_error
from phasemark.render.sensor.lens_fields import DERIVED, TERMS
from phasemark.render.sensor.sensor_file import rounded, sensor_toml

USES = {
    "albedo": "of the landmark: phasemark bank build --albedo, or 'albedo' in a plan",
    "floor_albedo": "of the floor: phasemark match --bounces … --floor-albedo",
}
"""Where the numbers go that a sensor file has no place for."""
_NOISE, _UNEXPLAINED = "calibrated: noise law of the residuals", "calibrated: what noise does not explain"
_COMMON = {
    **dict.fromkeys(("range_std_m", "range_shot_std_m", "range_ambient_std_m"), _NOISE),
    "zone_offset_m": "calibrated",
    "calibration_fields": "what was estimated",
    "calibration_covariance": "its covariance, in the units of the fields",
    **dict.fromkeys(("systematic_distance_m", "systematic_delta_deg", "systematic_bearing_deg"), _UNEXPLAINED),
    "systematic_height_m": _UNEXPLAINED,
    "systematic_time_s": "calibrated: jitter of the stamps",
    "overdispersion": "calibrated: scatter of χ² of the frames",
}
"""What stands behind the fields that no parameter of the mounting has."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration(Fitted):
    """Mounting of a camera with its covariance.

    Parameters
    ----------
    sensor : Sensor
        The camera after the calibration; fields that were not free keep their value, or the one of `start`.
    base : Sensor
        The camera before the calibration.
    mounting, assumed : Mounting
        The mounting after the calibration, and before it.
    free : tuple of str
        Names of what was estimated (:data:`NAMES`); the other numbers of `mounting` are assumptions.
    covariance : (p, p) float64
        In the order of `free`; radians, metres, pixels.
    covariance_from : str
        What it was made of, in words.
    chi2 : float
        Whitened squared residual.
    dof : int
        Its degrees of freedom.
    p_value : float
        Probability of a larger χ² if the model is right.
    on : {"ranges", "phasors"}
        What is compared: ranges, or phasors with the albedo unknown.
    poses : KnownPoses
        Known poses of the camera.
    pose_shift : (K, 3) float64
        Estimated errors of the poses in D, δ and b; zero where poses are taken as exact.
    pose_chi2 : (K,) float64
        Share of each pose in χ².
    pose_residuals : (K,) int64
        Number of residuals that it is made of.
    residual_m, residual_before_m : (K, rows, cols) float64
        Measured less modelled range with the mounting found and with the one assumed; NaN where a pixel does not count.
    range_std_m : (K, rows, cols) float64
        Standard deviation of the filtered range; NaN where a pixel does not count.
    notes : tuple of str
        Sentences on what is not observable, what does not fit, and what to do.
    doubts : tuple of str
        Why the result should not be used; empty for a calibration that can be trusted.
    cause : str
        What is likely wrong, if there are doubts.
    held_out_m : (before, after)
        Root mean square of the residuals of frames that were left out in turn: with the mounting assumed and with
        that from the other frames. NaN where it is not known.
    left_out : float
        Share of the pixels that see the landmark by the model, but disagree with it and have no weight.
    own : tuple of mapping of str to (float, float)
        What each recording of a moving camera has of its own, with its standard deviation: its difference in numbers of
        the mounting, and by how much the landmark is turned ("turn") against the axes of its poses.
    """

    sensor: Sensor
    base: Sensor
    mounting: Mounting
    assumed: Mounting
    free: tuple[str, ...]
    on: ResidualKind
    poses: KnownPoses
    pose_residuals: NDArray[np.int64]
    doubts: tuple[str, ...] = ()
    cause: str = ""

    def value(self, name: str) -> float:
        """Return one number of the mounting, radians, metres, pixels or albedo."""
        return self.mounting.number(name)

    def std(self, name: str) -> float:
        """Return its standard deviation; 0 if it was not free."""
        if name not in self.free:
            return 0.0
        k = self.free.index(name)
        return math.sqrt(float(self.covariance[k, k]))

    def __repr__(self) -> str:
        """Describe in one line what was free with its standard deviation, and the test of the fit."""
        words = []
        for name in self.free:
            one = PARAMETERS[name]
            number = with_error(one.shown * self.value(name), one.shown * self.std(name))
            words.append(f"{name} {number} {one.unit}".strip())
        return f"Calibration({len(self.poses)} poses: {', '.join(words)}; p = {self.p_value:.2g})"

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation matrix of what was free, (p, p)."""
        root = np.sqrt(np.diag(self.covariance))
        return np.asarray(self.covariance / np.outer(root, root))

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, lists and strings, for JSON; None where there is no number."""
        unit = np.array([PARAMETERS[name].shown for name in self.free])
        return {
            "parameters": {
                name: {
                    "value": PARAMETERS[name].shown * self.value(name),
                    "std": PARAMETERS[name].shown * self.std(name) if name in self.free else None,
                    "unit": {"°": "deg"}.get(PARAMETERS[name].unit, PARAMETERS[name].unit) or None,
                    "assumed": PARAMETERS[name].shown * self.assumed.number(name),
                    "sensor_field": PARAMETERS[name].field,
                }
                for name in shown_names(self)
            },
            "free": list(self.free),
            "covariance": (self.covariance * np.outer(unit, unit)).tolist(),
            "correlation": self.correlation.tolist(),
            "covariance_from": self.covariance_from,
            "chi2": self.chi2,
            "dof": self.dof,
            "p_value": self.p_value,
            "on": self.on,
            "held_out_rms_mm": dict(zip(("before", "after"), map(_mm, self.held_out_m), strict=True)),
            "left_out": self.left_out,
            "recordings": [
                {
                    name: {"value": factor * value, "std": factor * std, "unit": {"°": "deg"}.get(unit, unit)}
                    for name, (value, std) in own.items()
                    for _, factor, unit in (own_title(name),)
                }
                for own in self.own
            ],
            "doubts": list(self.doubts),
            "likely_cause": self.cause or None,
            "residual_rms_mm": {
                name: _mm(rms(residual[np.isfinite(residual)]))
                for name, residual in (("before", self.residual_before_m), ("after", self.residual_m))
            },
            "poses": [
                {
                    "distance_m": float(self.poses.distance_m[k]),
                    "delta_deg": math.degrees(self.poses.delta_rad[k]),
                    "bearing_deg": math.degrees(self.poses.bearing_rad[k]),
                    "chi2": float(self.pose_chi2[k]),
                    "residuals": int(self.pose_residuals[k]),
                    "error": {key: factor * float(self.pose_shift[k, i]) for i, (key, factor) in enumerate(POSE_UNITS)},
                }
                for k in range(len(self.poses))
            ],
            "notes": list(self.notes),
            "sensor": self.sensor.model_dump(mode="json"),
        }

    def to_toml(self, *, base_name: str) -> str:
        """Return the calibrated sensor as a file, its header with everything that is no field of a sensor.

        Parameters
        ----------
        base_name : str
            What the camera is called that gave all that was not estimated.
        """
        comments = {}
        distortion = []
        for name in self.free:
            parameter = PARAMETERS[name]
            error = error_text(self.std(name) * parameter.in_file)
            if name in TERMS[4:]:
                distortion.append(f"{name} ± {error}")
            elif parameter.field is not None:
                comments[parameter.field] = f"calibrated, ± {error} (standard deviation)"
        if distortion:
            comments["lens.distortion"] = f"calibrated, {', '.join(distortion)} (standard deviations)"
        between = "assumed: by how much two recordings of one sensor differed"
        if len(self.own) > 1:
            between = f"calibrated: by how much {len(self.own)} recordings differ"
        for field, what in {**_COMMON, **dict.fromkeys(RECORDING_FIELDS.values(), between)}.items():
            if field not in comments and getattr(self.sensor, field) != getattr(self.base, field):
                comments[field] = what
        header = [
            f"Calibrated by phasemark calibrate from {len(self.poses)} known poses, on {self.on}; covariance from"
            f" {self.covariance_from}.",
            f"chi2 = {self.chi2:.6g}, {self.dof} degrees of freedom, p = {self.p_value:.3g}.",
        ]
        for name, use in USES.items():
            if name in self.free:
                unit = f" {PARAMETERS[name].unit}" if PARAMETERS[name].unit else ""
                header.append(f"{name} = {' ± '.join(shown(self, name))}{unit}: {use}")
        before, after = self.held_out_m
        if math.isfinite(after):
            header.append(f"Held-out residuals, r.m.s.: {1e3 * before:.3g} mm before, {1e3 * after:.3g} mm after.")
        header += [f"Not to be trusted: {doubt}." for doubt in self.doubts]
        header += self.notes
        return sensor_toml(self.sensor, comments, header=header, otherwise=f"assumed: as in {base_name}")


def shown_names(found: Calibration) -> tuple[str, ...]:
    """Return the names of the numbers to show: half angles or a lens, a delay and a floor where they were estimated."""
    shown = {*NAMES, *found.free, *(["delay"] if found.mounting.delay_s else [])}
    names = tuple(name for name in MOUNTING_NAMES if name in shown)
    if found.mounting.lens is None:
        return names
    return (*(name for name in names if name not in HALF_ANGLES), *found.mounting.lens.terms)


def shown(found: Calibration, name: str) -> tuple[str, str]:
    """Return one number of a mounting as people read it, to the digits of its standard deviation, and the latter."""
    value, std = PARAMETERS[name].shown * found.value(name), PARAMETERS[name].shown * found.std(name)
    text, error = value_and_error(value, std)
    text, error = (text, error) if error else (f"{value:.3f}", error_text(std))
    return text, error if name in found.free else "fixed"


def _mm(value_m: float) -> float | None:
    return 1e3 * value_m if math.isfinite(value_m) else None


def concluded(solution: Solution, doubts: tuple[str, ...], cause: str) -> Calibration:
    """Return the calibration that a solution means, with the sensor that it makes."""
    problem, use = solution.problem, solution.use
    sensor, one, names = problem.sensor, problem.one, problem.common
    mounting = Mounting.of_vector(solution.theta, sensor)
    calibrated = _calibrated(sensor, mounting, names, solution.covariance).with_(**solution.sensor_fields)
    shared = {each.name: getattr(solution, each.name) for each in fields(Fitted)}
    if mounting.albedo > 1 and "albedo" in names:
        shared["notes"] += (
            f"An albedo of {mounting.albedo:.3g} cannot be: signal_e of the sensor is too low, or the amplitudes are"
            " not in electrons. Only their product was measured.",
        )
    return Calibration(
        sensor=calibrated if one is None else one.camera_like(calibrated),
        base=sensor if one is None else one.camera,
        mounting=mounting,
        assumed=problem.assumed,
        free=names,
        on=problem.on,
        poses=KnownPoses.joined(
            [
                one.poses_with(mounting.delay_s + own.get("delay", (0.0, 0.0))[0])
                for one, own in zip(problem.recordings, solution.own or ({},), strict=True)
            ]
        ),
        pose_residuals=use.sum(axis=1) * (1 if problem.on == "ranges" else 2),
        doubts=doubts,
        cause=cause,
        **shared,
    )


def _calibrated(sensor: Sensor, mounting: Mounting, free: Sequence[str], covariance: NDArray[np.float64]) -> Sensor:
    """Return a sensor with the numbers that were estimated or restated, to the digits of a file, and their covariance.

    What an earlier calibration estimated and this one left stays, uncorrelated with the rest; not half angles beside
    terms of a lens, from which they follow.
    """
    there, before = mounting.on(sensor), Mounting.of_sensor(sensor, mounting.albedo)
    changed = [
        one.field
        for name, one in PARAMETERS.items()
        if one.field is not None
        and (sensor.lens is None or name not in HALF_ANGLES)
        and (name in free or mounting.number(name) != before.number(name))
    ]
    index = [k for k, name in enumerate(free) if PARAMETERS[name].field is not None]
    own_fields = [str(PARAMETERS[free[k]].field) for k in index]
    unit = np.array([PARAMETERS[free[k]].in_file for k in index])
    own = covariance[np.ix_(index, index)] * np.outer(unit, unit)
    replaced = {*own_fields, *(DERIVED if set(free) & set(TERMS) else ())}
    older = [k for k, name in enumerate(sensor.calibration_fields) if name not in replaced]
    kept = sensor.calibration_matrix[np.ix_(older, older)]
    whole = linalg.block_diag((own + own.T) / 2, kept) if older else (own + own.T) / 2
    return sensor.with_numbers({field: rounded(there.number(field)) for field in changed}).with_(
        calibration_fields=(*own_fields, *(sensor.calibration_fields[k] for k in older)),
        calibration_covariance=rounded(tuple(tuple(row) for row in whole.tolist())),
    )
