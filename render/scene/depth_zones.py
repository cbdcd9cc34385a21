"""Depth in, zones out: what a sensor's zones see of the depth image of any other program (PHYSICS section 13).

Every pixel of the depth image is a piece of surface: it has a range, an amplitude ρ cos θ / r² and an area of tangents.
A zone adds up those that it sees; pixels that its border cuts count in part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, vstack

from phasemark import UsageError
from phasemark.render.direct.bin_counts import detected_counts
from phasemark.render.direct.footprints import footprints_of
from phasemark.render.direct.histogram_images import HistogramImages
from phasemark.render.direct.sample_counts import signal_of_samples
from phasemark.render.integral.scene_samples import SceneSamples
from phasemark.render.phasor_images import PhasorImages
from phasemark.render.scene.depth_pieces import Pieces, cut_pixels
from phasemark.render.scene.depth_slopes import fill_amplitudes
from phasemark.render.sensor.frequencies import phasor_frequencies_hz
from phasemark.render.sensor.sensor import Sensor, refuse_no_sensor

_ALBEDO = 0.8
_NEAREST_M, _FARTHEST_M = 1e-4, 1e6  # no surface is nearer or farther
_FEWEST = 8  # pixels a side of a depth image
_COARSE = 2  # pixels of the images of less resolution that the error is estimated from


@dataclass(frozen=True, eq=False)
class DepthZones:
    """Noise-free images that a sensor's zones make of n depth images.

    Parameters
    ----------
    images : PhasorImages
        Its `coverage` is the share of a zone from which anything returns.
    histograms : HistogramImages or None
        Of a direct sensor with a [histogram] table.
    discretisation_error : (n,) float64
        Estimated error of the phasors because the depth image has pixels: r.m.s. over zones, as share of the brightest
        zone; the largest of the modulation frequencies. In furnished rooms it is within a factor of two of the truth.
    """

    images: PhasorImages
    histograms: HistogramImages | None
    discretisation_error: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.images)


def zones_from_depth(
    depth_m: ArrayLike,
    intrinsics: ArrayLike,
    sensor: Sensor,
    albedo: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    quantity: Literal["z", "range"] = "z",
    *,
    depth2camera: ArrayLike | None = None,
    allow_uncovered: bool = False,
) -> DepthZones:
    """Turn depth images of any program into what the zones of a sensor see.

    The lens of the depth image is the sensor's. Means are uniform over each zone as in PHYSICS sections 2 and 3, and
    pixels that the border of a zone cuts count in part.

    Parameters
    ----------
    depth_m : (H, W) or (n, H, W) array_like
        Metres, floating point. 0, negative, NaN, infinite, below 0.1 mm and above 1000 km: nothing returns.
    intrinsics : (fx, fy, cx, cy) or (3, 3) array_like
        Of the depth image, pixels, as OpenCV has them: the centre of the first pixel is (0, 0). An image of W columns
        and a horizontal field of view φ has fx = W / (2 tan(φ/2)) and, with the axis in the middle, cx = (W − 1) / 2.
    sensor : Sensor
        The camera; it may have a lens with distortion.
    albedo : float, (H, W) or (n, H, W) array_like, optional
        Of Lambertian surfaces, 0 … 1. None: 0.8, as for :class:`~phasemark.render.Renderer`.
    normals : (H, W, 3) or (n, H, W, 3) array_like, optional
        Unit normals that face the camera, in the optical frame of the depth image: x right, y down, z forward. None:
        differences of neighbours on the same side of a depth step. These need depth without noise.
    quantity : {"z", "range"}
        Whether `depth_m` is measured along the optical axis or along the ray.
    depth2camera : (3, 3) array_like, optional
        Rotation from the optical frame of the depth image to that of the sensor. None: they look the same way.
    allow_uncovered : bool
        Whether the depth image may see less than the zones; nothing returns from beyond it.

    Returns
    -------
    DepthZones

    Raises
    ------
    UsageError
        An argument has another shape, unit or range, or the depth image does not cover the zones.

    Examples
    --------
    >>> import numpy as np
    >>> from phasemark.render import preset, zones_from_depth
    >>> fx = 128 / np.tan(np.radians(22.5))  # 256 columns that see 45°
    >>> wall_m = np.full((256, 256), 1.5)
    >>> zones = zones_from_depth(wall_m, (fx, fx, 127.5, 127.5), preset("vl53l5cx-8x8"))
    >>> zones.images.range_m[0, 4, 4].round(3), zones.histograms.expected.shape
    (np.float64(1.505), (1, 8, 8, 128))
    """
    refuse_no_sensor(sensor)
    if quantity not in ("z", "range"):
        raise UsageError(f"'quantity' must be z or range, got {quantity!r}")
    depth = _depth_images(depth_m)
    shape = depth.shape[1:]
    camera = _camera_numbers(intrinsics)
    turn = _rotation(depth2camera)
    rho = _albedos(albedo, depth.shape)
    facing = None if normals is None else _normal_images(normals, depth.shape)
    plan = _plan(shape, camera, turn, sensor, allow_uncovered)
    seen = [
        _see(depth[k], plan, sensor, quantity, rho[k], None if facing is None else facing[k]) for k in range(len(depth))
    ]
    return _zones(seen, sensor)


class _Plan(NamedTuple):
    """Geometry of a depth image before the zones of a sensor.

    Parameters
    ----------
    x, y : (W,), (H,) float64
        Tangents of pixel centres, to the right and downwards.
    length : (H, W) float64
        Length of the ray (x, y, 1).
    falloff : (H, W) or () float64
        Vignetting.
    pieces : Pieces or None
        Of a sensor with a [histogram] table.
    shares : (zones, H · W) sparse
        Which share of each zone's active area each pixel fills.
    coarse : (4 · zones, H · W) sparse
        The same of the four images that every second row and column make.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    length: NDArray[np.float64]
    falloff: NDArray[np.float64]
    pieces: Pieces | None
    shares: csr_array
    coarse: csr_array


class _Seen(NamedTuple):
    """Sums over the zones of one depth image: phasors (columns, zones), the rest (zones,) and an error."""

    phasors: NDArray[np.complex128]
    intensity: NDArray[np.float64]
    coverage: NDArray[np.float64]
    signal: NDArray[np.float64] | None
    error: float


@lru_cache(maxsize=4)
def _plan(
    shape: tuple[int, int],
    camera: tuple[float, ...],
    turn: tuple[float, ...],
    sensor: Sensor,
    allow_uncovered: bool,
) -> _Plan:
    """Return the geometry of a depth image, which images of one camera share."""
    if not allow_uncovered:
        _check_covered(shape, camera, turn, sensor)
    (x, x_borders), (y, y_borders) = _axes(shape, camera)
    x_borders, y_borders = _widened(x_borders), _widened(y_borders)
    rotation, n = np.reshape(turn, (3, 3)), math.prod(shape)
    pieces = cut_pixels(x_borders, y_borders, sensor, rotation)
    number = np.arange(n).reshape(shape)
    coarse = []
    for i in range(_COARSE):
        for j in range(_COARSE):
            part = cut_pixels(_coarser(x, x_borders, j), _coarser(y, y_borders, i), sensor, rotation)
            coarse.append(part._replace(pixel=number[i::_COARSE, j::_COARSE].ravel()[part.pixel]).weights(sensor, n))
    shares, coarser = pieces.weights(sensor, n), vstack(coarse, format="csr")
    length = np.sqrt(1 + x**2 + y[:, None] ** 2)
    ahead = rotation[2, 0] * x + rotation[2, 1] * y[:, None] + rotation[2, 2]
    falloff = (ahead / length) ** 4 if sensor.vignetting else np.ones(())
    if sensor.lamp_shapes_light:
        falloff = falloff * sensor.lamp_intensity(ahead / length)
    return _Plan(x, y, length, falloff, None if sensor.histogram is None else pieces, shares, coarser)


def _axes(shape: tuple[int, int], camera: tuple[float, ...]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return centres and borders of the columns, and of the rows, as tangents."""
    axes = zip(shape[::-1], camera[:2], camera[2:], strict=True)
    return [((np.arange(n, dtype=float) - c) / f, (np.arange(n + 1, dtype=float) - 0.5 - c) / f) for n, f, c in axes]


def _widened(borders: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return borders of pixels of which the outermost are half a pixel wider: rounded intrinsics uncover no zone."""
    half = 0.5 * (borders[1] - borders[0])
    return np.concatenate([[borders[0] - half], borders[1:-1], [borders[-1] + half]])


def _coarser(centres: NDArray[np.float64], borders: NDArray[np.float64], first: int) -> NDArray[np.float64]:
    """Return the borders of every second pixel."""
    own = centres[first::_COARSE]
    return np.concatenate([borders[:1], 0.5 * (own[1:] + own[:-1]), borders[-1:]])


def _see(
    depth: NDArray[np.float64],
    plan: _Plan,
    sensor: Sensor,
    quantity: str,
    albedo: NDArray[np.float64],
    normals: NDArray[np.float64] | None,
) -> _Seen:
    """Add up what the zones see of one depth image."""
    returns = np.isfinite(depth)
    z = depth / plan.length if quantity == "range" else depth
    inverse = 1 / z
    range_m = np.where(returns, z * plan.length, 0.0)
    amplitudes = np.empty((2, *depth.shape))
    if normals is None:
        for step, amplitude in zip((1, _COARSE), amplitudes, strict=True):
            fill_amplitudes(inverse, plan.x, plan.y, step, amplitude)
    else:
        amplitudes[:] = _cosine(normals, plan, returns) * np.where(returns, inverse / plan.length, 0.0) ** 2
    fine, blunt = ((albedo * plan.falloff * amplitude).ravel() for amplitude in amplitudes)
    columns_hz = phasor_frequencies_hz(sensor.frequencies_hz, sensor.harmonic_orders)
    phasors, coarse = [], []
    for hz in columns_hz:
        phase = (hz / (columns_hz[0] * sensor.metres_per_radian)) * range_m.ravel()
        real, imag = np.cos(phase), np.sin(phase)
        phasors.append(plan.shares @ (fine * real) + 1j * (plan.shares @ (fine * imag)))
        coarse.append(plan.coarse @ (blunt * real) + 1j * (plan.coarse @ (blunt * imag)))
    return _Seen(
        np.array(phasors),
        plan.shares @ fine,
        plan.shares @ returns.ravel().astype(np.float64),
        None if plan.pieces is None else _signal(plan.pieces, fine, range_m.ravel(), sensor),
        _error(np.array(phasors), np.array(coarse).reshape(len(columns_hz), _COARSE**2, -1)),
    )


def _error(phasors: NDArray[np.complex128], coarse: NDArray[np.complex128]) -> float:
    """Estimate the r.m.s. error of sums over a depth image from those over images of half the resolution.

    The error E of pixels with width h grows as h^p. The coarse images scatter about their mean, which is as good as the
    fine one, so that E(2h)² = E(h)² + variance: edges, with p from 1, along rows and columns, to 1.5 in any other
    direction. The mean differs from the fine image by E(2h) − E(h) of all that is no chance: normals of neighbours
    beside silhouettes, with p near 1.65.

    Parameters
    ----------
    phasors : (columns, zones) complex128
    coarse : (columns, 4, zones) complex128
    """
    of_edges, of_normals = float(_COARSE) ** 1.25, float(_COARSE) ** 1.65
    mean = coarse.mean(axis=1)
    variance = (np.abs(coarse - mean[:, None]) ** 2).mean(axis=(1, 2)) / (of_edges**2 - 1)
    bias = (np.abs(mean - phasors) ** 2).mean(axis=1) / (of_normals - 1) ** 2
    brightest = np.abs(phasors).max(axis=1)
    lit = brightest > 0
    return float(np.max(np.sqrt(variance + bias)[lit] / brightest[lit], initial=0.0))


def _signal(
    pieces: Pieces, amplitude: NDArray[np.float64], range_m: NDArray[np.float64], sensor: Sensor
) -> NDArray[np.float64]:
    """Return the expected signal counts of a direct sensor, (zones, bins)."""
    (tan_h, tan_v), (u0, v0) = sensor.tan_half_angles, sensor.centre_px
    width, height = 2 * tan_h / sensor.cols, 2 * tan_v / sensor.rows
    light = amplitude[pieces.pixel] * pieces.area * (width * height)
    kept = light > 0
    samples = SceneSamples(
        np.array([0, np.count_nonzero(kept)]),
        np.column_stack([(u0 - pieces.u[kept]) * width, (v0 - pieces.v[kept]) * height]),
        range_m[pieces.pixel[kept]],
        light[kept],
        pieces.area[kept] * (width * height),
        np.zeros(np.count_nonzero(kept), np.int32),
    )
    return np.asarray(signal_of_samples(samples, sensor)[0])


def _zones(seen: list[_Seen], sensor: Sensor) -> DepthZones:
    """Return the sums of depth images as images of the sensor."""
    shape, orders = (len(seen), sensor.rows, sensor.cols), sensor.harmonic_orders
    columns_hz = phasor_frequencies_hz(sensor.frequencies_hz, orders)
    phasors = np.stack([each.phasors for each in seen], axis=1).reshape(-1, *shape)
    images = PhasorImages(
        phasor=phasors[0],
        intensity=np.array([each.intensity for each in seen]).reshape(shape),
        coverage=np.minimum([each.coverage for each in seen], 1.0).reshape(shape),
        sensor=sensor,
        harmonics={order: phasors[k] for k, order in enumerate(orders, start=1)},
        by_hz={hz: phasors[k] for k, hz in enumerate(columns_hz) if k > len(orders)},
    )
    histograms = None
    if sensor.histogram is not None:
        signal = np.stack([each.signal for each in seen if each.signal is not None])
        expected = detected_counts(signal, sensor).reshape(*shape, -1)
        histograms = HistogramImages(expected, signal.sum(axis=-1).reshape(shape), sensor)
    return DepthZones(images, histograms, np.array([each.error for each in seen]))


def _depth_images(depth_m: ArrayLike) -> NDArray[np.float64]:
    """Return depth images as (n, H, W), or refuse what is none."""
    depth = np.asarray(depth_m)
    if depth.dtype.kind in "iub":
        raise UsageError(
            f"'depth_m' must be metres in floating point, got {depth.dtype}: multiply it by the scale of its camera,"
            " 0.001 where it counts millimetres"
        )
    if depth.dtype.kind != "f":
        raise UsageError(f"'depth_m' must be an array of floating-point numbers, got {depth.dtype}")
    if depth.ndim not in (2, 3) or min(depth.shape[-2:]) < _FEWEST or not depth.size:
        raise UsageError(
            f"'depth_m' must have shape (H, W) or (n, H, W), at least {_FEWEST} pixels a side, got {depth.shape}"
        )
    images = depth.reshape(-1, *depth.shape[-2:]).astype(np.float64)
    returns = images[np.isfinite(images) & (images > 0)]
    farthest_m = 100.0  # most of an image farther away is beyond every sensor of zones
    if returns.size and (middle := float(np.median(returns))) > farthest_m:
        raise UsageError(f"'depth_m' must be metres, and its median is {middle:.4g}: divide millimetres by 1000")
    return np.where((images >= _NEAREST_M) & (images <= _FARTHEST_M), images, np.nan)


def _camera_numbers(intrinsics: ArrayLike) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy."""
    numbers = _numbers("intrinsics", intrinsics)
    if numbers.shape == (3, 3):
        pattern = np.array([[True, False, True], [False, True, True], [False, False, False]])
        if np.array_equal(numbers[~pattern], [0, 0, 0, 0, 1]):
            numbers = numbers[[0, 1, 0, 1], [0, 1, 2, 2]]
    if numbers.shape != (4,):
        shown = " ".join(str(intrinsics).split())
        raise UsageError(f"'intrinsics' must be (fx, fy, cx, cy) or [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {shown}")
    fx, fy, cx, cy = map(float, numbers)
    if not (fx > 0 and fy > 0):
        raise UsageError(f"'intrinsics' must have focal lengths above 0 pixels, got fx = {fx:g} and fy = {fy:g}")
    if min(fx, fy) < 1:
        raise UsageError(
            f"'intrinsics' must be in pixels, got fx = {fx:g} and fy = {fy:g}: multiply by the image's width and height"
        )
    return fx, fy, cx, cy


def _rotation(depth2camera: ArrayLike | None) -> tuple[float, ...]:
    """Return the nine numbers of a rotation, row by row."""
    matrix = np.eye(3) if depth2camera is None else _numbers("depth2camera", depth2camera)
    rounding = 1e-6
    proper = matrix.shape == (3, 3) and np.allclose(matrix @ matrix.T, np.eye(3), rtol=0, atol=rounding)
    if not proper or np.linalg.det(matrix) < 0:
        shown = " ".join(str(depth2camera).split())
        raise UsageError(f"'depth2camera' must be a rotation matrix, (3, 3), got {shown}")
    return tuple(matrix.ravel().tolist())


def _albedos(albedo: ArrayLike | None, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return albedos as (n, H, W)."""
    values = _numbers("albedo", _ALBEDO if albedo is None else albedo)
    if values.shape not in ((), shape[1:], shape):
        raise UsageError(f"'albedo' must be a number or have shape {shape[1:]} or {shape}, got {values.shape}")
    wrong = values[(values < 0) | (values > 1)]
    if wrong.size:
        raise UsageError(f"'albedo' must be in [0, 1], got {wrong[0]:g}")
    return np.broadcast_to(values, shape)


def _normal_images(normals: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return normals as (n, H, W, 3)."""
    values = np.asarray(normals, dtype=np.float64)
    if values.shape not in ((*shape[1:], 3), (*shape, 3)):
        raise UsageError(f"'normals' must have shape {(*shape[1:], 3)} or {(*shape, 3)}, got {values.shape}")
    return np.broadcast_to(values, (*shape, 3))


def _cosine(normals: NDArray[np.float64], plan: _Plan, returns: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return cos θ of given normals; those of smooth shading may point a little away beside a silhouette."""
    length_off = np.abs(np.linalg.norm(normals, axis=-1) - 1)
    rounding, most_away = 1e-3, 0.1
    wrong = returns & ~(length_off < rounding)
    if wrong.any():
        row, col = np.argwhere(wrong)[0]
        raise UsageError(
            f"'normals' must be unit vectors to {rounding:g} wherever there is depth, got {normals[row, col].tolist()}"
            f" in row {row}, column {col}"
        )
    cosine = -(normals[..., 0] * plan.x + normals[..., 1] * plan.y[:, None] + normals[..., 2]) / plan.length
    away = returns & (cosine < -most_away)
    if away.any():
        row, col = np.argwhere(away)[0]
        raise UsageError(
            f"'normals' must face the camera in its optical frame (x right, y down, z forward), and"
            f" {np.count_nonzero(away)} of {np.count_nonzero(returns)} point away from it, the first in row {row},"
            f" column {col}: {normals[row, col].tolist()}"
        )
    return np.where(returns, np.maximum(cosine, 0.0), 0.0)


def _check_covered(shape: tuple[int, int], camera: tuple[float, ...], turn: tuple[float, ...], sensor: Sensor) -> None:
    """Refuse a depth image that sees less than the zones do."""
    fill = np.array(sensor.fill_factor)
    low, high = 0.5 * (1 - fill), np.array([sensor.cols, sensor.rows]) - 0.5 * (1 - fill)
    if sensor.histogram is not None:
        extent = np.reshape(footprints_of(sensor).extent, (2, 2))
        ends = np.stack(sensor.image_points(*extent))
        low, high = np.minimum(low, ends.min(axis=1)), np.maximum(high, ends.max(axis=1))
    share = np.linspace(0.0, 1.0, 65)
    u = np.concatenate([low[0] + share * (high - low)[0]] * 2 + [np.full(65, low[0]), np.full(65, high[0])])
    v = np.concatenate([np.full(65, low[1]), np.full(65, high[1])] + [low[1] + share * (high - low)[1]] * 2)
    left, up = sensor.tangents(u, v)
    right, down, ahead = np.reshape(turn, (3, 3)).T @ np.stack([-left, -up, np.ones(len(u))])
    if (ahead <= 0).any():
        raise UsageError("the depth image must cover the zones, and looks away from some of them by more than 90°")
    sides = []
    for names, at, (_, borders) in zip(
        (("left", "right"), ("top", "bottom")), (right / ahead, down / ahead), _axes(shape, camera), strict=True
    ):
        needed, there = np.array([at.min(), at.max()]), borders[[0, -1]]
        rounding = 1e-9
        short = np.array([-1, 1]) * (needed - _widened(borders)[[0, -1]]) > rounding
        ends = np.degrees(np.arctan([needed, there]))
        sides += [(abs(ends[0, k] - ends[1, k]), names[k], *ends[:, k]) for k in (0, 1) if short[k]]
    if sides:
        missing, side, needed_deg, there_deg = max(sides)
        raise UsageError(
            f"the depth image must cover the zones, and {missing:.3g}° are missing at its {side}: it ends at"
            f" {there_deg:.4g}° and they at {needed_deg:.4g}°; allow_uncovered=True lets nothing return from there"
        )


def _numbers(name: str, value: ArrayLike) -> NDArray[np.float64]:
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"'{name}' must be numbers, got {value!r}") from None
    if not np.isfinite(numbers).all():
        raise UsageError(f"'{name}' must be finite")
    return numbers
