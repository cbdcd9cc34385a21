"""Pictures of images and frames: in matplotlib figures, and in the terminal.

Figures are built without pyplot, so that nothing here needs a display or touches global state.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import offset_copy
from numpy.typing import NDArray
from rich.color import Color
from rich.style import Style
from rich.text import Text

from phasemark import UsageError
from phasemark.render.frames import Flag
from phasemark.render.view import Views

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

    from phasemark.render.frames import Frames
    from phasemark.render.phasor_images import PhasorImages
    from phasemark.render.sensor.sensor import Sensor

PAPER_CMAP = LinearSegmentedColormap.from_list("paper", ["#ffffff", "#2f6fe4", "#000000"])
"""The colours of the paper's figure 4, as :data:`RANGE_COLOURS` explains them."""

RANGE_COLOURS = (
    "White is the nearest, black the farthest, and blue in between: a surface there, or a pixel at an edge that mixes "
    "near and far."
)
"""What the colours of a range image say, for captions."""

SIGMA_SPAN = 5.0
"""Where the colours of a residual in σ end, to both sides."""
_LANDMARK_PERCENTILES = (2, 98)
_LANDMARK_DEPTH_M = 0.4
"""How far behind the nearest surface a measured frame's landmark is taken to reach, as in estimating backgrounds."""

_BEYOND = "#b4bac1"
_NOTHING = "#efe3d0"
_NOTHING_HATCH = "#b58a55"

_FLAG_COLOURS = {
    "valid": "#e8eef7",
    "no return": _NOTHING_HATCH,
    "missing": "#7b3f98",
    "saturated": "#d62728",
    "dead": "#202020",
}


def pixel_grid_figure(sensor: Sensor) -> Figure:
    """Draw the borders of a sensor's pixels on what it sees, in tangents.

    Parameters
    ----------
    sensor : Sensor

    Returns
    -------
    matplotlib.figure.Figure
        With many pixels only every n-th border is drawn; the title states n.
    """
    grid_lines = 32  # borders of pixels that are drawn along each side of an image, about
    step = max(1, math.ceil(max(sensor.rows, sensor.cols) / grid_lines))
    figure = Figure(figsize=(7.0, 7.0 * min(1.4, max(0.6, sensor.rows / sensor.cols))), layout="constrained")
    axes = figure.add_subplot()
    along_u, along_v = np.linspace(0.0, sensor.cols, 201), np.linspace(0.0, sensor.rows, 201)
    across = [(along_u, np.full(201, float(v))) for v in (*range(0, sensor.rows, step), sensor.rows)]
    upright = [(np.full(201, float(u)), along_v) for u in (*range(0, sensor.cols, step), sensor.cols)]
    for u, v in (*across, *upright):
        y, z = sensor.tangents(u, v)
        axes.plot(-y, z, color="#2f6fe4", linewidth=0.7)
    axes.plot(0.0, 0.0, "+", color="#d62728", markersize=12, label="optical axis")
    figure.legend(loc="outside lower center")
    between = "each pixel" if step == 1 else f"every {step}th pixel border"
    lens = "ideal lens" if sensor.lens is None else f"lens: {sensor.lens.model}"
    title = f"{sensor.rows} × {sensor.cols} pixels, {between}, {lens}"
    axes.set(aspect="equal", xlabel="tangent to the right", ylabel="tangent upwards", title=title)
    return figure


def range_figure(
    range_m: NDArray[np.float64],
    *,
    near_m: float | None = None,
    far_m: float | None = None,
    title: str | None = None,
) -> Figure:
    """Draw a range image in the style of the paper's figure 4.

    Parameters
    ----------
    range_m : (rows, cols) ndarray
        Metres; NaN where nothing returned, drawn hatched.
    near_m, far_m : float, optional
        Ranges drawn white and black; by default the image's own nearest and farthest. What lies farther is grey.
    title : str, optional
        Title above the figure.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = Figure(figsize=(4.6, 3.8), layout="constrained")
    axes = figure.add_subplot()
    draw_range(axes, range_m, near_m=near_m, far_m=far_m)
    if title is not None:
        axes.set_title(title)
    return figure


def draw_range(
    axes: Axes,
    range_m: NDArray[np.float64],
    *,
    near_m: float | None = None,
    far_m: float | None = None,
    colour_bar: bool = True,
) -> AxesImage:
    """Draw a range image into axes of a larger figure; the arguments are those of :func:`range_figure`.

    Raises
    ------
    UsageError
        `range_m` is not an image.
    """
    near, far = _limits(range_m, near_m, far_m)
    # What is NaN stays unpainted and shows the hatched paper behind.
    axes.patch.set(facecolor=_NOTHING, edgecolor=_NOTHING_HATCH, hatch="////", linewidth=0)
    image = _draw_pixels(axes, range_m, cmap=PAPER_CMAP.with_extremes(over=_BEYOND), vmin=near, vmax=far)
    if colour_bar:
        _colour_bar(axes, image, "range (m)")
    if np.isnan(range_m).any():
        hatched = Patch(facecolor=_NOTHING, edgecolor=_NOTHING_HATCH, hatch="////", linewidth=0, label="no range")
        _legend_below(axes, [hatched])
    return image


def landmark_limits_m(
    range_m: NDArray[np.float64], coverage: NDArray[np.float64]
) -> tuple[float, float] | tuple[None, None]:
    """Return the ranges between which a landmark lies, for the colours of a range image with a wall behind it.

    Parameters
    ----------
    range_m : (rows, cols) float64
        Metres; NaN where nothing returned.
    coverage : (rows, cols) float64
        Share of each pixel on the landmark. Pixels that are half covered or more count.

    Returns
    -------
    near_m, far_m : float or None
        From the 2nd to the 98th percentile, at least 2 cm apart; None if the landmark covers no pixel that returned.
        If no pixel beside the landmark returned, no range is mixed: then from its nearest to its farthest pixel, but
        for ranges more than half that span outside, which are noise.
    """
    returned = np.isfinite(range_m)
    landmark_coverage = 0.5
    seen = range_m[returned & (coverage >= landmark_coverage)]
    if not seen.size:
        return None, None
    near, far = (float(one) for one in np.percentile(seen, _LANDMARK_PERCENTILES))
    if not (returned & (coverage == 0.0)).any():
        # how far beyond the percentiles a range is still the landmark's own where nothing stands beside it; of their
        # span
        own_reach = 0.5
        reach = own_reach * (far - near)
        own = range_m[returned & (range_m >= near - reach) & (range_m <= far + reach)]
        near, far = float(own.min()), float(own.max())
    least_span_m = 0.02
    widen = max(0.0, least_span_m - (far - near)) / 2
    return near - widen, far + widen


def draw_sigma(axes: Axes, residual: NDArray[np.float64]) -> AxesImage:
    """Draw residuals in standard deviations into axes of a larger figure; the colours end at ±5 σ.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    residual : (rows, cols) ndarray
        Residual over its standard deviation; what is NaN stays grey.

    Returns
    -------
    matplotlib.image.AxesImage
    """
    return _draw_residual(axes, residual, SIGMA_SPAN, "residual (σ)")


def draw_difference(axes: Axes, difference_m: NDArray[np.float64], *, span_mm: float | None = None) -> AxesImage:
    """Draw a difference of ranges into axes of a larger figure, in millimetres.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    difference_m : (rows, cols) ndarray
        Metres; what is NaN stays grey.
    span_mm : float, optional
        What the colour bar ends at, to both sides; None: nine tenths of the pixels lie within it.

    Returns
    -------
    matplotlib.image.AxesImage
    """
    known = 1e3 * np.abs(difference_m[np.isfinite(difference_m)])
    span = max(float(np.percentile(known, 90)) if known.size else 1.0, 1.0) if span_mm is None else span_mm
    return _draw_residual(axes, 1e3 * difference_m, span, "difference (mm)")


def _draw_residual(axes: Axes, values: NDArray[np.float64], span: float, label: str) -> AxesImage:
    axes.set_facecolor("#d0d0d0")
    image = _draw_pixels(axes, values, cmap="RdBu", vmin=-span, vmax=span)
    _colour_bar(axes, image, label)
    return image


def phasor_figure(images: PhasorImages, index: int = 0) -> Figure:
    """Draw range, amplitude and coverage of one view side by side.

    Parameters
    ----------
    images : PhasorImages
    index : int
        Which view.

    Returns
    -------
    matplotlib.figure.Figure
    """
    check_index("view", index, len(images))
    figure = Figure(figsize=(12.4, 4.0), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    left.set_title("range")
    near, far = landmark_limits_m(images.range_m[index], images.coverage[index])
    draw_range(left, images.range_m[index], near_m=near, far_m=far)
    draw_map(middle, images.amplitude[index], "amplitude", "amplitude |S| (1: albedo 1 at 1 m)", cmap="gray", vmin=0.0)
    share = "share of the pixel on the landmark"
    draw_map(right, images.coverage[index], "coverage", share, cmap="gray", vmin=0, vmax=1)
    figure.suptitle(image_in_words(images.views, index))
    return figure


def image_in_words(views: Views | None, index: int) -> str:
    """Return the number of an image, and its view where it shows one."""
    return f"image {index}" if views is None else f"view {index}: {view_in_words(views, index)}"


def view_in_words(views: Views, index: int) -> str:
    """Return the numbers of a view; pitch and roll only where it is tilted."""
    angles = {"δ": views.delta_rad, "b": views.bearing_rad, "pitch": views.pitch_rad, "roll": views.roll_rad}
    told = {name: f"{name} = {math.degrees(values[index]):.2f}°" for name, values in angles.items()}
    words = [f"D = {views.distance_m[index]:.3f} m", told["δ"], told["b"], f"h = {views.height_m[index]:.3f} m"]
    if views.pitch_rad[index] or views.roll_rad[index]:
        words += [told["pitch"], told["roll"]]
    return ", ".join(words)


def frame_figure(
    frames: Frames, index: int = 0, frame: int = 0, *, coverage: NDArray[np.float64] | None = None
) -> Figure:
    """Draw range, amplitude (if there is one) and flags of one frame side by side; the colours span the landmark.

    Parameters
    ----------
    frames : Frames
    index : int
        Which position.
    frame : int
        Which frame of that position.
    coverage : (rows, cols) float64, optional
        Share of each pixel on the landmark; without it, the landmark reaches from the nearest surface to 0.4 m behind.

    Returns
    -------
    matplotlib.figure.Figure
    """
    check_index("position", index, len(frames))
    check_index("frame", frame, frames.n_frames)
    n_panels = 2 if frames.amplitude_e is None else 3
    figure = Figure(figsize=(0.4 + 4.0 * n_panels, 4.0), layout="constrained")
    panels = figure.subplots(1, n_panels)
    panels[0].set_title("range")
    range_m = frames.range_m[index, frame]
    near, far = nearest_limits_m(range_m) if coverage is None else landmark_limits_m(range_m, coverage)
    draw_range(panels[0], range_m, near_m=near, far_m=far)
    if frames.amplitude_e is not None:
        draw_map(panels[1], frames.amplitude_e[index, frame], "amplitude", "amplitude (e-)", cmap="gray", vmin=0.0)
    _draw_flags(panels[-1], frames.flags[index, frame])
    figure.suptitle(f"position {index}, frame {frame}")
    return figure


def nearest_limits_m(range_m: NDArray[np.float64]) -> tuple[float, float] | tuple[None, None]:
    """Return the ranges between which the nearest surface lies, for the colours of a measured frame.

    Parameters
    ----------
    range_m : (rows, cols) float64
        Metres; NaN where nothing returned.

    Returns
    -------
    near_m, far_m : float or None
        Those of :func:`landmark_limits_m`, where a landmark reaches from the nearest surface to 0.4 m behind it.
    """
    seen = range_m[np.isfinite(range_m)]
    nearest = np.percentile(seen, _LANDMARK_PERCENTILES[0]) if seen.size else np.nan
    return landmark_limits_m(range_m, (range_m <= nearest + _LANDMARK_DEPTH_M).astype(np.float64))


def terminal_figure(
    range_m: NDArray[np.float64],
    *,
    width: int = 32,
    near_m: float | None = None,
    far_m: float | None = None,
) -> Text:
    """Draw a range image for a terminal with 24-bit colour, two pixels to a character, and a legend below.

    Parameters
    ----------
    range_m : (rows, cols) ndarray
        Metres; NaN where nothing returned.
    width : int
        Characters a line may have; pixels are magnified by the whole number that fits, at least 1.
    near_m, far_m : float, optional
        Ranges drawn white and black; by default the image's own nearest and farthest.

    Returns
    -------
    rich.text.Text
        Print it with a ``rich.console.Console``. Without colour it says nothing.

    Raises
    ------
    UsageError
        `range_m` is not an image.
    """
    near, far = _limits(range_m, near_m, far_m)
    rgba = PAPER_CMAP.with_extremes(over=_BEYOND)((range_m - near) / (far - near), bytes=True)
    rgba[np.isnan(range_m)] = [*bytes.fromhex(_NOTHING_HATCH[1:]), 255]
    scale = max(1, width // range_m.shape[1])
    rgb = rgba[..., :3].repeat(scale, axis=0).repeat(scale, axis=1)
    text = Text(no_wrap=True)
    for top in range(0, len(rgb), 2):
        for col in range(rgb.shape[1]):
            # The upper half block shows the character's own colour above and the background's below.
            below = Color.from_rgb(*rgb[top + 1, col]) if top + 1 < len(rgb) else None
            text.append("▀", Style(color=Color.from_rgb(*rgb[top, col]), bgcolor=below))
        text.append("\n")
    for step in np.linspace(0.0, 1.0, 8):
        text.append("█", Style(color=Color.from_rgb(*PAPER_CMAP(step, bytes=True)[:3])))
    text.append(f" {near:.2f} … {far:.2f} m")
    if np.isnan(range_m).any():
        text.append("  ").append("█", Style(color=Color.parse(_NOTHING_HATCH))).append(" no range")
    return text


def _limits(range_m: NDArray[np.float64], near_m: float | None, far_m: float | None) -> tuple[float, float]:
    if range_m.ndim != 2:
        raise UsageError(f"'range_m' must be one image, (rows, cols), got shape {range_m.shape}")
    seen = range_m[np.isfinite(range_m)]
    nearest, farthest = (float(seen.min()), float(seen.max())) if seen.size else (0.0, 1.0)
    near = nearest if near_m is None else near_m
    far = farthest if far_m is None else far_m
    return near, max(far, near + 1e-3)  # a flat image still needs two ends to its colour bar


def check_index(what: str, index: int, count: int) -> None:
    """Refuse the number of a view, position or frame that there is not."""
    if not 0 <= index < count:
        raise UsageError(f"there is no {what} {index}: they count from 0 to {count - 1}")


def _draw_pixels(axes: Axes, values: NDArray[np.generic], **how: object) -> AxesImage:
    """Draw an image in the coordinates of PHYSICS section 2, where pixel (r, c) covers u ∈ [c, c+1], v ∈ [r, r+1]."""
    rows, cols = values.shape
    image = axes.imshow(values, extent=(0, cols, rows, 0), interpolation="nearest", **how)  # type: ignore[arg-type]
    whole_ticks(axes)
    axes.set(xlabel="u (pixel columns)", ylabel="v (pixel rows)")
    return image


def whole_ticks(axes: Axes) -> None:
    """Put a few whole numbers on both axes of an image."""
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(nbins=8, integer=True, steps=[1, 2, 4, 5, 10]))


def draw_map(axes: Axes, values: NDArray[np.float64], title: str, label: str, **how: object) -> None:
    """Draw one number of every pixel into axes, with a title and a colour bar; `how` goes to ``imshow``."""
    axes.set_title(title)
    _colour_bar(axes, _draw_pixels(axes, values, **how), label)


def _colour_bar(axes: Axes, image: AxesImage, label: str) -> None:
    figure = axes.get_figure(root=True)
    if figure is not None:
        values, (low, high) = np.ma.filled(np.ma.asarray(image.get_array(), np.float64), np.nan), image.get_clim()
        ends = bool(np.nanmin(values, initial=np.inf) < low), bool(np.nanmax(values, initial=-np.inf) > high)
        extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[ends]
        figure.colorbar(image, ax=axes, label=label, shrink=0.9, pad=0.04, aspect=18, extend=extend)


def _draw_flags(axes: Axes, flags: NDArray[np.uint8]) -> None:
    names = list(_FLAG_COLOURS)
    kind = np.zeros(flags.shape, dtype=np.int64)
    # Later entries say more about the cause, so they win.
    for number, flag in enumerate((Flag.NO_RETURN, Flag.MISSING, Flag.SATURATED, Flag.DEAD), 1):
        kind[(flags & int(flag)) != 0] = number
    norm = BoundaryNorm(np.arange(len(names) + 1) - 0.5, len(names))
    _draw_pixels(axes, kind, cmap=ListedColormap(list(_FLAG_COLOURS.values())), norm=norm)
    axes.set_title("flags")
    present = [names[value] for value in np.unique(kind)]
    _legend_below(axes, [Patch(facecolor=_FLAG_COLOURS[name], edgecolor="0.5", label=name) for name in present])


def _legend_below(axes: Axes, handles: list[Patch]) -> None:
    """Put a legend below the label of the axis, whatever the image's shape."""
    label_points = 36.0  # room below an image for ticks and the label of its axis
    below = offset_copy(axes.transAxes, fig=axes.get_figure(root=True), y=-label_points, units="points")
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0.0), bbox_transform=below, ncols=len(handles),
        frameon=False, fontsize="small", borderaxespad=0.0,
    )  # fmt: skip
