"""A calibration as a figure of its residuals."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from phasemark.matcher.calibration.result import Calibration
from phasemark.render.charts import explain, panels
from phasemark.render.figures import draw_difference

_SIGMAS, _BINS = 5.0, 50


def residual_figure(found: Calibration) -> Figure:
    """Draw what the calibration leaves: residuals by pixel before and after, by pose, and against the normal law.

    Parameters
    ----------
    found : Calibration

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure, ((before, after), (by_pose, density)) = panels(2, 2, width=5.8, height=4.6)
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
    bearing_deg = np.degrees(np.angle(np.exp(1j * found.poses.bearing_rad[told][order])))
    points = axes.scatter(x, size[told][order], c=bearing_deg, cmap="coolwarm", edgecolor="0.3", zorder=3)
    axes.figure.colorbar(points, ax=axes, label="bearing (°)")
    axes.set_ylim(0, max(2.0, float(size.max(initial=0.0)) * 1.1))
    explain(axes, "distance (m)", "r.m.s. residual of a pose (σ)", "poses", legend="upper left")


def _draw_density(axes: Any, found: Calibration) -> None:
    """Draw the density of the range residuals in standard deviations beside the normal law."""
    sigma = found.residual_m / found.range_std_m
    sigma = sigma[np.isfinite(sigma)]
    inside = sigma[np.abs(sigma) < _SIGMAS]
    beyond = 1 - len(inside) / max(len(sigma), 1)
    if len(inside):
        weights = np.full(len(inside), _BINS / (2 * _SIGMAS) / len(sigma))
        label = f"{len(sigma)} range residuals, {100 * beyond:.2g} % beyond {_SIGMAS:g} σ"
        axes.hist(inside, bins=_BINS, range=(-_SIGMAS, _SIGMAS), weights=weights, color="#9ecae1", label=label)
    x = np.linspace(-_SIGMAS, _SIGMAS, 201)
    axes.plot(x, stats.norm.pdf(x), color="0.3", lw=1, label="normal law")
    axes.set_ylim(0, 0.55)
    explain(axes, "residual of a filtered range (σ)", "density", "pixels", legend="upper left")


def _mean_of_pixels(residual_m: NDArray[np.float64], std_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each pixel's mean over the poses in which it counts, weighted by 1/σ²; NaN where there is none."""
    there = np.isfinite(residual_m) & np.isfinite(std_m)
    weight = np.where(there, 1 / np.where(there, std_m, 1.0) ** 2, 0.0)
    total = (weight * np.where(there, residual_m, 0.0)).sum(axis=0)
    return np.where(there.any(axis=0), total / np.maximum(weight.sum(axis=0), 1e-300), np.nan)
