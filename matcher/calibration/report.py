"""A calibration as a sensor file, as plain numbers, and as a figure of its residuals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from phasemark.matcher.calibration.calibration import Calibration
from phasemark.matcher.calibration.known_poses import POSE_UNITS
from phasemark.matcher.calibration.mounting_model import ALL_NAMES, NAMES, PARAMETERS
from phasemark.render.figures import draw_difference
from phasemark.render.integral.rounding import error_text, value_and_error
from phasemark.render.sensor.sensor_file import sensor_toml

USES = {"albedo": "of the landmark: phasemark bank build --albedo, or 'albedo' in a plan"}
"""Where the numbers go that a sensor file has no place for."""
_SIGMAS, _BINS = 5.0, 50
_COMMON = {
    "range_std_m": "calibrated: noise law of the residuals",
    "range_shot_std_m": "calibrated: noise law of the residuals",
    "range_ambient_std_m": "calibrated: noise law of the residuals",
    "zone_offset_m": "calibrated",
    "calibration_fields": "what was estimated",
    "calibration_covariance": "its covariance, in the units of the fields",
    "systematic_distance_m": "calibrated: what noise does not explain",
    "systematic_delta_deg": "calibrated: what noise does not explain",
    "systematic_bearing_deg": "calibrated: what noise does not explain",
    "systematic_height_m": "calibrated: what noise does not explain",
    "systematic_time_s": "calibrated: jitter of the stamps",
}
"""What stands behind the fields that no parameter of the mounting has."""


def calibration_toml(found: Calibration, *, base_name: str) -> str:
    """Return the calibrated sensor as a file, its header with everything that is no field of a sensor.

    Parameters
    ----------
    found : Calibration
    base_name : str
        What the camera is called that gave all that was not estimated.
    """
    comments = {}
    for name in found.free:
        parameter = PARAMETERS[name]
        if parameter.field is not None:
            comments[parameter.field] = f"calibrated, ± {error_text(_file_std(found, name))} (standard deviation)"
    for field, what in _COMMON.items():
        if field not in comments and getattr(found.sensor, field) != getattr(found.base, field):
            comments[field] = what
    header = [
        f"Calibrated by phasemark calibrate from {len(found.poses)} known poses, on {found.on}; covariance from"
        f" {found.covariance_from}.",
        f"chi2 = {found.chi2:.6g}, {found.dof} degrees of freedom, p = {found.p_value:.3g}.",
    ]
    for name, use in USES.items():
        if name in found.free:
            unit = f" {PARAMETERS[name].unit}" if PARAMETERS[name].unit else ""
            header.append(f"{name} = {shown(found, name)} ± {shown_std(found, name)}{unit}: {use}")
    before, after = found.held_out_m
    if math.isfinite(after):
        header.append(f"Held-out residuals, r.m.s.: {1e3 * before:.3g} mm before, {1e3 * after:.3g} mm after.")
    header += [f"Not to be trusted: {doubt}." for doubt in found.doubts]
    header += found.notes
    return sensor_toml(found.sensor, comments, header=header, otherwise=f"assumed: as in {base_name}")


def shown_names(found: Calibration) -> tuple[str, ...]:
    """Return the names of the numbers to show: the delay only where it was estimated or is stated."""
    return ALL_NAMES if "delay" in found.free or found.mounting.delay_s else NAMES


def shown(found: Calibration, name: str) -> str:
    """Return one number of a mounting as people read it, to the digits of its standard deviation."""
    return _value_and_std(found, name)[0]


def shown_std(found: Calibration, name: str) -> str:
    """Return its standard deviation."""
    return _value_and_std(found, name)[1] if name in found.free else "fixed"


def _value_and_std(found: Calibration, name: str) -> tuple[str, str]:
    value, std = PARAMETERS[name].shown * found.value(name), PARAMETERS[name].shown * found.std(name)
    text, error = value_and_error(value, std)
    return (text, error) if error else (f"{value:.3f}", error_text(std))


def calibration_dict(found: Calibration) -> dict[str, Any]:
    """Return everything as plain numbers, lists and strings, for JSON; None where there is no number."""
    unit = np.array([PARAMETERS[name].shown for name in found.free])
    return {
        "parameters": {
            name: {
                "value": PARAMETERS[name].shown * found.value(name),
                "std": PARAMETERS[name].shown * found.std(name) if name in found.free else None,
                "unit": {"°": "deg"}.get(PARAMETERS[name].unit, PARAMETERS[name].unit) or None,
                "assumed": PARAMETERS[name].shown * float(getattr(found.assumed, PARAMETERS[name].attribute)),
                "sensor_field": PARAMETERS[name].field,
            }
            for name in shown_names(found)
        },
        "free": list(found.free),
        "covariance": (found.covariance * np.outer(unit, unit)).tolist(),
        "correlation": found.correlation.tolist(),
        "covariance_from": found.covariance_from,
        "chi2": found.chi2,
        "dof": found.dof,
        "p_value": found.p_value,
        "on": found.on,
        "held_out_rms_mm": dict(zip(("before", "after"), map(_mm, found.held_out_m), strict=True)),
        "left_out": found.left_out,
        "doubts": list(found.doubts),
        "likely_cause": found.cause or None,
        "residual_rms_mm": {"before": _rms_mm(found.residual_before_m), "after": _rms_mm(found.residual_m)},
        "poses": [
            {
                "distance_m": float(found.poses.distance_m[k]),
                "delta_deg": math.degrees(found.poses.delta_rad[k]),
                "bearing_deg": math.degrees(found.poses.bearing_rad[k]),
                "chi2": float(found.pose_chi2[k]),
                "residuals": int(found.pose_residuals[k]),
                "error": {key: factor * float(found.pose_shift[k, i]) for i, (key, factor) in enumerate(POSE_UNITS)},
            }
            for k in range(len(found.poses))
        ],
        "notes": list(found.notes),
        "sensor": found.sensor.model_dump(mode="json"),
    }


def residual_figure(found: Calibration) -> Figure:
    """Draw what the calibration leaves: residuals by pixel before and after, by pose, and against the normal law.

    Parameters
    ----------
    found : Calibration

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = Figure(figsize=(11.6, 9.2), layout="constrained")
    (before, after), (by_pose, density) = figure.subplots(2, 2)
    means = [_mean_of_pixels(one, found.range_std_m) for one in (found.residual_before_m, found.residual_m)]
    span_mm = max(1e3 * float(np.nanpercentile(np.abs(means), 90)), 1.0)
    for axes, mean, residual, title in (
        (before, means[0], found.residual_before_m, "mounting as assumed"),
        (after, means[1], found.residual_m, "mounting as calibrated"),
    ):
        draw_difference(axes, mean, span_mm=span_mm)
        rms = np.sqrt(np.nanmean((residual / found.range_std_m) ** 2))
        axes.set_title(f"{title}: r.m.s. {rms:.3g} σ\nweighted mean over poses of measured − model")
    _draw_poses(by_pose, found)
    _draw_density(density, found)
    verdict = f"χ² = {found.chi2:.0f}, {found.dof} degrees of freedom, p = {found.p_value:.2g}"
    figure.suptitle(f"Calibration from {len(found.poses)} poses on {found.on}: {verdict}")
    return figure


def _draw_poses(axes: Any, found: Calibration) -> None:
    """Draw the r.m.s. residual of each pose, in standard deviations, over its distance."""
    told = found.pose_residuals > 0
    n = np.maximum(found.pose_residuals, 1)
    size = np.sqrt(found.pose_chi2 / n)
    axes.axhline(1.0, color="0.5", lw=0.8)
    order = np.argsort(found.poses.distance_m[told])
    x, count = found.poses.distance_m[told][order], n[told][order]
    low, high = (np.sqrt(stats.chi2.ppf(q, count) / count) for q in (0.025, 0.975))
    axes.vlines(x, low, high, color="0.85", lw=5, label="95 % of poses, if noise is all")
    points = axes.scatter(
        x,
        size[told][order],
        c=np.degrees(np.angle(np.exp(1j * found.poses.bearing_rad[told][order]))),
        cmap="coolwarm",
        edgecolor="0.3",
        zorder=3,
    )
    axes.figure.colorbar(points, ax=axes, label="bearing (°)")
    axes.set(xlabel="distance (m)", ylabel="r.m.s. residual of a pose (σ)", title="poses")
    axes.set_ylim(0, max(2.0, float(size.max(initial=0.0)) * 1.1))
    axes.legend(frameon=False, fontsize="small", loc="upper left")
    axes.grid(alpha=0.3)


def _draw_density(axes: Any, found: Calibration) -> None:
    """Draw the density of the range residuals in standard deviations beside the normal law."""
    sigma = found.residual_m / found.range_std_m
    sigma = sigma[np.isfinite(sigma)]
    inside = sigma[np.abs(sigma) < _SIGMAS]
    beyond = 1 - len(inside) / max(len(sigma), 1)
    if len(inside):
        axes.hist(
            inside,
            bins=_BINS,
            range=(-_SIGMAS, _SIGMAS),
            weights=np.full(len(inside), _BINS / (2 * _SIGMAS) / len(sigma)),
            color="#9ecae1",
            label=f"{len(sigma)} range residuals, {100 * beyond:.2g} % beyond {_SIGMAS:g} σ",
        )
    x = np.linspace(-_SIGMAS, _SIGMAS, 201)
    axes.plot(x, stats.norm.pdf(x), color="0.3", lw=1, label="normal law")
    axes.set(xlabel="residual of a filtered range (σ)", ylabel="density", title="pixels")
    axes.set_ylim(0, 0.55)
    axes.legend(frameon=False, fontsize="small", loc="upper left")
    axes.grid(alpha=0.3)


def _mean_of_pixels(residual_m: NDArray[np.float64], std_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each pixel's mean over the poses in which it counts, weighted by 1/σ²; NaN where there is none."""
    there = np.isfinite(residual_m) & np.isfinite(std_m)
    weight = np.where(there, 1 / np.where(there, std_m, 1.0) ** 2, 0.0)
    total = (weight * np.where(there, residual_m, 0.0)).sum(axis=0)
    return np.where(there.any(axis=0), total / np.maximum(weight.sum(axis=0), 1e-300), np.nan)


def _mm(value_m: float) -> float | None:
    return 1e3 * value_m if math.isfinite(value_m) else None


def _rms_mm(residual_m: NDArray[np.float64]) -> float | None:
    values = residual_m[np.isfinite(residual_m)]
    return 1e3 * math.sqrt(float((values**2).mean())) if values.size else None


def _file_std(found: Calibration, name: str) -> float:
    """Return a standard deviation in the unit of the sensor's field: degrees or metres."""
    parameter = PARAMETERS[name]
    return found.std(name) * (parameter.shown if parameter.unit == "°" else 1.0)
