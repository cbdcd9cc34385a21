"""Pictures of histograms: every zone's counts in its place of the image, beside a map of the zones."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.histogram_frames import HistogramFrames
from phasemark.render.direct.histogram_images import HistogramImages
from phasemark.render.direct.targets import Status
from phasemark.render.figures import check_index, draw_range, image_in_words, whole_ticks
from phasemark.render.sensor.sensor import Sensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COUNTS_COLOUR, _TARGET_COLOUR = "#2f6fe4", "#D55E00"
_HEIGHT = 0.78


def histogram_figure(frames: HistogramFrames, index: int = 0, frame: int = 0) -> Figure:
    """Draw the histograms of one frame, each in its zone with its targets, beside the range of the nearest target.

    Parameters
    ----------
    frames : HistogramFrames
    index : int
        Which position.
    frame : int
        Which frame of that position.

    Returns
    -------
    matplotlib.figure.Figure
    """
    check_index("position", index, len(frames))
    check_index("frame", frame, frames.n_frames)
    return _figure(frames.counts[index, frame], frames.sensor, "counts", f"position {index}, frame {frame}")


def expected_figure(images: HistogramImages, index: int = 0) -> Figure:
    """Draw the expected histograms of one view, each in its zone, beside the range that the chip makes of them.

    Parameters
    ----------
    images : HistogramImages
    index : int
        Which view.

    Returns
    -------
    matplotlib.figure.Figure
    """
    check_index("view", index, len(images))
    return _figure(images.expected[index], images.sensor, "expected counts", image_in_words(images.views, index))


def _figure(counts: NDArray[np.float64], sensor: Sensor, what: str, title: str) -> Figure:
    """Draw (rows, cols, bins) counts beside the ranges that the chip makes of them."""
    one = HistogramFrames(counts, sensor=sensor)
    figure = Figure(figsize=(12.4, 6.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    _draw_histograms(left, counts, one, what)
    right.set_title("range of the nearest target")
    draw_range(right, one.ranges.range_m[0, 0])
    figure.suptitle(title)
    return figure


def _draw_histograms(axes: Axes, counts: NDArray[np.float64], one: HistogramFrames, what: str) -> None:
    """Draw (rows, cols, bins) counts, the square root upwards, and the targets as marks above."""
    histogram = histogram_of(one.sensor)
    rows, cols = counts.shape[:2]
    places = _places(one)
    seen = np.concatenate([places[row, col] for row in range(rows) for col in range(cols)])
    beyond_targets = 1.3  # histograms are drawn up to this multiple of the farthest target's place
    bins = min(counts.shape[2], int(beyond_targets * seen.max()) + 1) if len(seen) else counts.shape[2]
    counts = counts[..., :bins]
    most = max(float(counts.max()), 1.0)
    margin = 0.06  # of a zone, on each side of its histogram
    steps = np.repeat(margin + (1 - 2 * margin) * np.arange(bins + 1) / bins, 2)
    areas, marks = [], []
    mark_at = 0.08  # of a zone from its top; counts end below
    for row in range(rows):
        for col in range(cols):
            floor = row + 1 - margin
            height = floor - _HEIGHT * np.sqrt(counts[row, col] / most)
            outline = np.concatenate([[floor], np.repeat(height, 2), [floor]])
            areas.append(np.column_stack([col + steps, outline]))
            marks += [(col + margin + (1 - 2 * margin) * place / bins, row + mark_at) for place in places[row, col]]
    axes.add_collection(PolyCollection(areas, facecolor=_COUNTS_COLOUR, edgecolor="none"))
    axes.vlines(range(cols + 1), 0, rows, color="0.8", linewidth=0.6)
    axes.hlines(range(rows + 1), 0, cols, color="0.8", linewidth=0.6)
    axes.set(xlim=(0, cols), ylim=(rows, 0), aspect="equal")
    whole_ticks(axes)
    last_m = histogram.start_m + bins * histogram.bin_width_m
    axes.set_title(f"{what} in each zone")
    axes.set_xlabel(f"zone columns; in each the range, {histogram.start_m:.3g} to {last_m:.3g} m")
    axes.set_ylabel(f"zone rows; in each the square root of counts, 0 to {most:.4g}")
    if marks:
        x, y = np.array(marks).T
        axes.plot(x, y, "v", color=_TARGET_COLOUR, markersize=4, linestyle="none", label="target of the chip")
        figure = axes.get_figure(root=True)
        assert figure is not None
        figure.legend(loc="outside lower left", frameon=False, fontsize="small")


def _places(one: HistogramFrames) -> NDArray[np.object_]:
    """Return where the targets of one frame lie in each zone's histogram, bins."""
    found, sensor, histogram = one.targets, one.sensor, histogram_of(one.sensor)
    cosine = sensor.axis_cosine()[..., None] if histogram.reports == "z" else 1.0
    scale = np.array(histogram.zone_bin_scale or ((1.0,) * sensor.cols,) * sensor.rows)[..., None]
    delay = (sensor.zone_offsets + sensor.range_offset_m)[..., None]
    bins = (found.distance_m[0, 0] / cosine + delay - histogram.start_m) / (histogram.bin_width_m * scale)
    valid = found.status[0, 0] == Status.VALID
    out = np.empty((sensor.rows, sensor.cols), object)
    for row in range(sensor.rows):
        for col in range(sensor.cols):
            out[row, col] = bins[row, col][valid[row, col]]
    return out
