"""Pictures of a sensor's data sheet: simulated points on predicted curves, and the patterns of one camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from phasemark.render.bench.data_sheet.results import FIGURES, Characterisation, Comparison
from phasemark.render.charts import marked, panels, style
from phasemark.render.figures import draw_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LABELS = {
    "mean_code": "mean of a tap over the black level (codes)",
    "variance_code2": "variance of a tap (codes²)",
    "mean_e": "mean of a tap (e-)",
    "variance_e2": "variance of a tap (e-²)",
    "distance_m": "distance (m)",
    "range_m": "range (m)",
    "range_std_m": "σ of the range in one frame (m)",
    "mean_range_error_m": "mean range less true range (m)",
    "signal_e": "signal, both taps of a phase image (e-)",
    "flagged_share": "share of frames flagged",
    "no_return_share": "share of frames without return",
    "counts": "mean counts of a bin in one frame",
    "separation_m": "separation of two equal targets (m)",
    "two_targets_share": "share of frames with two targets",
    "ambient_photons": "ambient photons per cycle and bin",
    "half_found_m": "distance at which half of the frames find it (m)",
}
_TITLES = {
    "photon_transfer": "Photon transfer",
    "range_noise": "Range noise",
    "linearity": "Linearity",
    "saturation": "Saturation",
    "threshold": "Where the return is lost",
    "histogram": "Histogram against prediction",
    "merging": "Where two targets merge",
    "ambient": "Range against ambient light",
}
_LOGARITHMIC = ("photon_transfer", "range_noise")
_MAPS = {
    "range_offset_m": ("range offset", "mm", 1e3),
    "response_percent": ("sensitivity, mean of both taps", "% of the mean", 1.0),
    "dark_e": ("dark signal, mean of both taps", "e-", 1.0),
}


def characterisation_figures(found: Characterisation) -> dict[str, Figure]:
    """Draw every figure that the sensor has.

    Parameters
    ----------
    found : Characterisation

    Returns
    -------
    dict of str to matplotlib.figure.Figure
        By name, those of `FIGURES` that it has.
    """
    figures: dict[str, Figure] = {}
    for name in FIGURES:
        if name == "fixed_pattern":
            if found.maps:
                figures[name] = _pattern_figure(found)
        elif series := found.of_figure(name):
            figures[name] = _curve_figure(name, series, found)
    return figures


def _curve_figure(name: str, series: tuple[Comparison, ...], found: Characterisation) -> Figure:
    compared = any(one.degrees_of_freedom for one in series)
    figure = Figure(figsize=(8.6, (5.8 if compared else 4.2) + 0.4 * len(series)), layout="constrained")
    if compared:
        axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        _draw_deviations(below, series)
        lowest: Axes = below
    else:
        lowest = axes = figure.subplots()
    for k, one in enumerate(series):
        _draw_series(axes, one, k, alone=len(series) == 1)
    logarithmic = name in _LOGARITHMIC and found.sensor.kind == "phase"
    logarithmic &= all(
        ((one.predicted > 0) & (one.simulated > 0)).any() for one in series
    )  # a camera without noise has rounding to show
    if logarithmic:
        axes.set(xscale="log", yscale="log")
        positive = np.concatenate([one.simulated[one.simulated > 0] for one in series])
        axes.set_ylim(positive.min() / 3, positive.max() * 3)
    else:
        if name == "ambient":
            axes.set_xscale("log")
        low, high = axes.get_ylim()
        least_reach = 1e-6  # of an axis: nothing below is anything but rounding
        axes.set_ylim(0.0 if name in _LOGARITHMIC else min(low, -least_reach), max(high, least_reach))
    _mark_limits(axes, name, found)
    axes.set(title=_TITLES[name], ylabel=_LABELS[series[0].y_name])
    axes.grid(alpha=0.3, which="both" if logarithmic else "major")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize="small")
    lowest.set_xlabel(_LABELS[series[0].x_name])
    return figure


def _draw_series(axes: Axes, one: Comparison, k: int, *, alone: bool) -> None:
    (colour, marker, _), name = style(k), "" if alone else f", {one.label}"
    axes.plot(one.curve_x, one.curve_y, color=colour, linewidth=1.2, label=f"predicted{name}")
    if one.law_y is not None:
        label = None if k else "noise law without patterns"
        axes.plot(one.curve_x, one.law_y, color="0.45", linewidth=1.0, linestyle=":", label=label)
    axes.errorbar(
        one.x, one.simulated, yerr=one.half95, color=colour, marker=marker, linestyle="none", markersize=4.5,
        capsize=2, label=f"simulated{name}, 95 %, N = {one.samples[0]} a point",
    )  # fmt: skip
    beyond = ~one.compared
    if one.degrees_of_freedom and beyond.any():
        axes.plot(one.x[beyond], one.simulated[beyond], marker="o", linestyle="none", markersize=10,
                  markerfacecolor="none", markeredgecolor="0.4", label="beyond the prediction's claim")  # fmt: skip


def _draw_deviations(axes: Axes, series: tuple[Comparison, ...]) -> None:
    for k, one in enumerate(series):
        used = one.compared
        pull = (one.simulated - one.predicted)[used] / one.std_error[used]
        axes.plot(one.x[used], pull, **marked(k, linestyle="none"))
    axes.axhspan(-1.96, 1.96, color="0.9")
    axes.axhline(0, color="0.5", linewidth=0.8)
    reach = max(4.0, *(float(np.abs(line.get_ydata()).max(initial=0.0)) * 1.1 for line in axes.lines))
    axes.set(ylim=(-reach, reach), ylabel="deviation\n(standard errors)")
    axes.grid(alpha=0.3)


def _mark_limits(axes: Axes, name: str, found: Characterisation) -> None:
    sensor, half = found.sensor, found.quantity("saturation_flags_half_e")
    limit: tuple[float, str] | None = None
    if name == "photon_transfer" and np.isfinite(sensor.saturation_e):
        limit = sensor.saturation_e * (sensor.gain if sensor.adc_bits is not None else 1.0), "a tap saturates"
    if name == "linearity" and sensor.kind == "phase":
        limit = sensor.unambiguous_range_m, "wrap, c / 2f"
    if name == "saturation" and half is not None:
        limit = half.predicted, "half of the frames, predicted"
    if limit is not None:
        axes.axvline(limit[0], color="0.3", linestyle="--", linewidth=1, label=limit[1])


def _pattern_figure(found: Characterisation) -> Figure:
    figure, (row,) = panels(len(found.maps), width=4.2, height=4.3)
    for axes, (name, values) in zip(row, found.maps.items(), strict=True):
        title, unit, scale = _MAPS[name]
        shown = values * scale
        centre = float(np.nanmean(shown))
        reach = max(float(np.nanmax(np.abs(shown - centre))), 1e-9)
        draw_map(axes, shown, title, unit, cmap="PuOr", vmin=centre - reach, vmax=centre + reach)
        for mask, marker in ((found.defects["dead"], "x"), (found.defects["hot"], "+")):
            rows, cols = np.nonzero(mask)
            axes.plot(cols + 0.5, rows + 0.5, marker, color="black", markersize=8)
    if found.defects["dead"].any() or found.defects["hot"].any():
        figure.legend(
            handles=[Patch(facecolor="none", edgecolor="none", label="x dead     + hot")],
            loc="outside lower center", frameon=False, fontsize="small",
        )  # fmt: skip
    return figure
