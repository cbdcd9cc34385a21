"""Fit a direct sensor to histograms of known scenes: geometry, response, bin widths, pile-up, stray light, crosstalk.

A plane at known distances tells bin widths, delays, response and pile-up, and of the geometry only how far zones look
off the axis. Known objects from known poses tell where each zone looks, in which order zones are logged, how large
they are and how much light strays. Both are fitted together: geometry by robust least squares with the responses
fixed, then the responses from the plane with the geometry fixed, and the crosstalk of the sensor's window from what
comes before the plane's light, until nothing moves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares, minimize_scalar

from phasemark import UsageError
from phasemark.render.direct.bin_counts import expected_counts
from phasemark.render.direct.fit_crosstalk import NO_CROSSTALK, Crosstalk, fit_crosstalk, peak_shapes
from phasemark.render.direct.fit_model import (
    AMBIENT_BINS,
    FitModel,
    Parameters,
    Prediction,
    Responses,
    about_peak,
    cycles_of,
    peak_centroids,
    start_parameters,
    undo_pile_up,
)
from phasemark.render.direct.fit_response import delays_of, fit_responses
from phasemark.render.direct.footprints import footprint_grid, histogram_of
from phasemark.render.direct.recordings import ObjectRecording, PlaneRecording, world2cam
from phasemark.render.direct.transients import range_axis, zone_transients
from phasemark.render.integral.scene_samples import SceneMesh
from phasemark.render.sensor.sensor import Sensor

_STEP = 0.05
"""Step of differences, in scales of the parameters."""
_ROUNDS = 3
_IRF_STEP_BINS = 1 / 6
_RANGE_WINDOW = (5, 12)


@dataclass(frozen=True)
class DirectFit:
    """A fitted direct sensor, and how well it explains what it was fitted to.

    Parameters
    ----------
    sensor : Sensor
        The camera.
    parameters : dict of str to float
        Fitted numbers.
    responses : Responses
        Response of each zone.
    crosstalk : Crosstalk
        Of the sensor's window.
    std : dict of str to float
        Standard deviation of every parameter, scaled by the residuals.
    reduced_chi2 : (zones,) float64
        χ²/ν of each zone's plane histograms with Poisson noise alone.
    model : FitModel
        Model of the histograms.
    """

    sensor: Sensor
    parameters: Parameters
    responses: Responses
    crosstalk: Crosstalk
    std: dict[str, float]
    reduced_chi2: NDArray[np.float64]
    model: FitModel

    def predict(self, recording: PlaneRecording | ObjectRecording) -> Prediction:
        """Return expected and measured histograms of a recording."""
        return self.model.predict(self.parameters, self.responses, recording)

    def optical_poses(self, sensor2world: ArrayLike) -> NDArray[np.float64]:
        """Return stated poses moved forward to where the zones' common origin was found, (n, 4, 4)."""
        poses = np.array(sensor2world, dtype=np.float64)
        poses[:, :3, 3] += self.parameters["forward"] * poses[:, :3, 2]
        return poses

    def plane_range_m(self, plane: PlaneRecording) -> NDArray[np.float64]:
        """Return the distance of a plane that each zone's histogram alone tells best, (n, zones).

        By weighted least squares about the peak.
        """
        model, p, responses = self.model, self.parameters, self.responses
        unit = PlaneRecording(plane.frames[np.array([0])], np.array([0.5]))
        light = model.transients(p, unit)[0].sum(axis=0)
        measured = plane.frames.zone_counts
        drift = p["reference_gain"] * plane.frames.reference_shift_bins
        cycles, widths, delays = cycles_of(p), model.bin_widths_m(p), responses.delays

        def best(i: int, zone: int) -> float:
            lit = light[zone] != 0
            weight, cumulative = light[zone][lit], responses.cumulative[zone]
            path_bins = model.axis.nodes_m[lit] / 0.5 / widths[zone]  # for each metre of distance
            counts = undo_pile_up(measured[i, zone], cycles) - responses.crosstalk[zone]
            top = int(measured[i, zone].argmax())
            window = slice(max(top - _RANGE_WINDOW[0], 0), min(top + _RANGE_WINDOW[1], len(counts)))
            left = np.exp(-np.cumsum(counts + responses.crosstalk[zone]) / cycles)
            std = np.sqrt(np.maximum(measured[i, zone], 1.0) / left**2 + (0.01 * counts) ** 2)[window]
            target = (counts - counts[AMBIENT_BINS].mean())[window] / std
            edges = np.arange(window.start, window.stop + 1)[:, None]

            def misfit(distance: float) -> float:
                delay = edges - distance * path_bins - drift[i]
                share = np.interp(delay, delays, cumulative, left=0.0, right=1.0)
                shape = np.diff(share @ weight, axis=0) / std
                brightness = float(shape @ target) / max(float(shape @ shape), 1e-300)
                rest = brightness * shape - target
                return float(rest @ rest)

            middle = plane.distance_m[i]
            return float(minimize_scalar(misfit, bracket=(middle - 0.003, middle + 0.003), tol=1e-7).x)

        return np.array([[best(i, zone) for zone in range(len(widths))] for i in range(len(plane.frames))])

    def centroid_error_m(self, recording: PlaneRecording | ObjectRecording) -> NDArray[np.float64]:
        """Return measured less predicted centroid of the highest peak, metres of range, (n, zones)."""
        got = self.predict(recording)
        bins = peak_centroids(got.measured) - peak_centroids(got.expected)
        return np.asarray(bins * histogram_of(self.sensor).bin_width_m)

    def as_dict(self) -> dict[str, object]:
        """Return the fitted values as plain numbers, for JSON."""
        values = self.parameters.items()
        return {
            "parameters": {name: {"value": value, "std": self.std.get(name)} for name, value in values},
            "crosstalk": self.crosstalk._asdict(),
            "reduced_chi2": self.reduced_chi2.tolist(),
            "sensor": self.sensor.as_dict(),
        }


def fit_direct_sensor(
    plane: PlaneRecording,
    objects: Sequence[ObjectRecording] = (),
    *,
    base: Sensor,
    converters: Sequence[int] | None = None,
    rounds: int = _ROUNDS,
) -> DirectFit:
    """Fit a sensor to histograms of a plane at known distances and of known objects.

    Parameters
    ----------
    plane : PlaneRecording
        At least 8 distances.
    objects : sequence of ObjectRecording
        Without one, the directions of the zones stay those of `base`: a plane does not tell them.
    base : Sensor
        The sensor as far as it is known; the fit starts there.
    converters : sequence of int, optional
        Time converter of each zone in image order; zones of one converter share a bin width. None: as `base` has it.
    rounds : int
        How often geometry and responses are fitted in turn.

    Returns
    -------
    DirectFit

    Raises
    ------
    UsageError
        Too few distances, or a recording of another sensor.
    """
    if len(plane.frames) < 8:
        raise UsageError(f"a fit needs a plane at 8 distances or more, got {len(plane.frames)}")
    n = base.rows * base.cols
    groups = tuple(converters) if converters is not None else converters_of(base)
    if len(groups) != n:
        raise UsageError(f"'converters' must name the converter of each of {n} zones, got {len(groups)}")
    model = FitModel(base, groups, zone_brightness(plane, histogram_of(base).cycles))
    p, scales = start_parameters(base, objects, groups)
    crosstalk, counts = NO_CROSSTALK, np.zeros((n, model.histogram.bins))
    responses = fit_responses(model, p, plane, counts)
    free = _free_parameters(p, objects)
    shifts = [one.frames.reference_shift_bins for one in objects] + [plane.frames.reference_shift_bins]
    if not any(shift.any() for shift in shifts):
        free.remove("reference_gain")
    most_planes = 40
    some = plane[np.arange(0, len(plane.frames), max(1, len(plane.frames) // most_planes))]
    recordings: list[PlaneRecording | ObjectRecording] = [some, *objects]
    jacobian = np.zeros((0, 0))
    cost = 1.0
    for _ in range(rounds):
        p, jacobian, cost = _fit_parameters(model, p, responses, recordings, {name: scales[name] for name in free})
        p |= {f"delay_{k}": 0.0 for k in range(n)}  # the responses take them over
        responses = fit_responses(model, p, plane, counts)
        crosstalk, counts = _crosstalk(model, p, responses, plane)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(cost, 1.0)
    std = {name: math.sqrt(max(covariance[k, k], 0.0)) * scales[name] for k, name in enumerate(free)}
    responses = responses._replace(crosstalk=counts)
    sensor = _as_sensor(base, model, p, responses, crosstalk, plane)
    return DirectFit(sensor, p, responses, crosstalk, std, _reduced_chi2(model, p, responses, plane), model)


def converters_of(sensor: Sensor) -> tuple[int, ...]:
    """Return the time converter of each zone of a sensor, in image order."""
    histogram = histogram_of(sensor)
    n = sensor.rows * sensor.cols
    logged = np.array(histogram.time_converters or (0,) * n)
    out = np.empty(n, np.int64)
    out[np.array(histogram.zone_order or range(n))] = logged
    return tuple(int(k) for k in out)


def zone_brightness(plane: PlaneRecording, cycles: float) -> NDArray[np.float64]:
    """Return the relative brightness of the zones before a plane, (zones,): the median over the farther half."""
    far = plane.distance_m >= np.median(plane.distance_m)
    counts = undo_pile_up(plane.frames.zone_counts[far], cycles)
    signal = (counts - counts[..., AMBIENT_BINS].mean(axis=-1, keepdims=True)).sum(axis=-1)
    return np.asarray(np.median(signal / signal.mean(axis=1, keepdims=True), axis=0))


def zone_orders(rows: int, cols: int) -> dict[str, NDArray[np.int64]]:
    """Return the orders in which a chip may log its zones: each zone's place in the image, by name."""
    place = np.arange(rows * cols).reshape(rows, cols)
    orders = {}
    for transposed in (False, True) if rows == cols else (False,):
        turned = place.T if transposed else place
        for down in (False, True):
            for across in (False, True):
                lines = "columns" if transposed else "rows"
                orders[f"{lines}{', up' if down else ''}{', right to left' if across else ''}"] = turned[
                    :: -1 if down else 1, :: -1 if across else 1
                ].ravel()
    return orders


def score_zone_orders(logged: ObjectRecording, base: Sensor) -> dict[str, float]:
    """Return how badly each order of the zones explains a recording, metres: smaller is better.

    The score is the median, over zones and poses, of how far the centroid of the highest peak lies from that of the
    sensor as it is described, each zone's own delay taken out.

    Parameters
    ----------
    logged : ObjectRecording
        Its zones in the order of the log.
    base : Sensor
        The camera, whose order of zones is replaced.
    """
    axis = range_axis(base, longest_m=1.5)
    samples = SceneMesh(logged.mesh).samples(world2cam(logged.sensor2world), footprint_grid(base))
    seen = zone_transients(samples, base, axis)
    expected = expected_counts(seen, base, axis)
    scores = {}
    for name, place in zone_orders(base.rows, base.cols).items():
        error = peak_centroids(logged.frames.zone_counts) - peak_centroids(expected)[:, place]
        off = np.median(np.abs(error - np.median(error, axis=0)))
        scores[name] = float(off * histogram_of(base).bin_width_m)
    return scores


def _free_parameters(p: Parameters, objects: Sequence[ObjectRecording]) -> list[str]:
    """Return the parameters that the recordings tell."""
    converters = sorted(name for name in p if name.startswith("converter_"))
    free = ["inverse_cycles", "reference_gain", *converters[1:], *(name for name in p if name.startswith("delay_"))]
    if objects:
        free += [name for name in p if name not in free and not name.startswith("converter_")]
        free.append(converters[0])
    return free


def _fit_parameters(
    model: FitModel,
    p: Parameters,
    responses: Responses,
    recordings: Sequence[PlaneRecording | ObjectRecording],
    scales: dict[str, float],
) -> tuple[Parameters, NDArray[np.float64], float]:
    """Fit parameters, of which scales are given; returns also the Jacobian in scales, and χ²/ν. Responses are fixed."""
    scale = np.array(list(scales.values()))

    def moved(x: NDArray[np.float64]) -> Parameters:
        return {**p, **dict(zip(scales, (x * scale).tolist(), strict=True))}

    def at(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return model.residuals(moved(x), responses, recordings)

    def slope(x: NDArray[np.float64]) -> NDArray[np.float64]:
        here = at(x)
        columns = []
        for k in range(len(x)):
            step = np.zeros(len(x))
            step[k] = _STEP
            columns.append((at(x + step) - here) / _STEP)
        return np.stack(columns, axis=1)

    start = np.array([p[name] for name in scales]) / scale
    evaluations = 6
    found = least_squares(at, start, jac=slope, loss="soft_l1", max_nfev=evaluations)
    return moved(found.x), np.asarray(found.jac), float(2 * found.cost / max(len(found.fun) - len(scale), 1))


def _crosstalk(
    model: FitModel, p: Parameters, responses: Responses, plane: PlaneRecording
) -> tuple[Crosstalk, NDArray[np.float64]]:
    """Return the crosstalk of the sensor's window, and the counts that it adds, (zones, bins)."""
    widths = model.bin_widths_m(p)
    counts = undo_pile_up(plane.frames.zone_counts, cycles_of(p))
    found = fit_crosstalk(counts, responses.cumulative, responses.first, responses.step, widths)
    shapes = peak_shapes(
        responses.cumulative, responses.first, responses.step, found.range_m / widths, model.histogram.bins
    )
    return found, found.counts * shapes


def _reduced_chi2(model: FitModel, p: Parameters, responses: Responses, plane: PlaneRecording) -> NDArray[np.float64]:
    """Return χ²/ν of each zone before the plane, with Poisson noise alone."""
    got = model.predict(p, responses, plane)
    window = about_peak(got.measured, *_RANGE_WINDOW)
    chi2 = np.where(window, (got.measured - got.expected) ** 2 / np.maximum(got.expected, 1.0), 0).sum(axis=(0, 2))
    return np.asarray(chi2 / np.maximum(window.sum(axis=(0, 2)) - 2 * len(got.measured), 1))


def _as_sensor(
    base: Sensor,
    model: FitModel,
    p: Parameters,
    responses: Responses,
    crosstalk: Crosstalk,
    plane: PlaneRecording,
) -> Sensor:
    """Return the fitted sensor in the fields of a sensor file."""
    h = histogram_of(base)
    rows, cols = base.rows, base.cols
    delays = delays_of(responses)
    width_m = h.bin_width_m
    start_bins = float(delays.mean())
    scales, cycles = model.bin_scales(p), 1e6 / p["inverse_cycles"]
    grid = np.arange(-7.0, 32.0, _IRF_STEP_BINS)
    irf = []
    for zone in range(rows * cols):
        at = grid / scales[zone] + delays[zone]
        cumulative = np.interp(at, responses.delays, responses.cumulative[zone], left=0.0, right=1.0)
        density = np.maximum(np.gradient(cumulative, grid), 0.0)  # rounding alone makes it negative
        irf.append(tuple(float(f"{v:.4g}") for v in density / density.max()))
    measured = responses.counts_beside_crosstalk(plane.frames.zone_counts, cycles)
    ambient = measured[..., AMBIENT_BINS].mean(axis=-1)
    signal = (measured - ambient[..., None]).sum(axis=-1)
    intensity = model.transients(p, plane).sum(axis=(1, 3)) / model.gain
    plane_albedo = 0.8
    per_light = np.median(signal / (intensity * plane_albedo), axis=0)
    tan_h, tan_v = p["pitch_h"] * cols / 2, p["pitch_v"] * rows / 2
    offsets = (delays * scales - start_bins) * width_m
    return base.with_(
        half_angle_h_deg=math.degrees(math.atan(tan_h)),
        half_angle_v_deg=math.degrees(math.atan(tan_v)),
        principal_point_px=(cols / 2 + p["centre_left"] / p["pitch_h"], rows / 2 + p["centre_up"] / p["pitch_v"]),
        roll_deg=math.degrees(p["roll"]),
        zone_offset_m=[[float(v) for v in row] for row in offsets.reshape(rows, cols)],
        histogram={
            **h.model_dump(),
            "start_m": -start_bins * width_m,
            "cycles": cycles,
            "photons": float(per_light.mean() / cycles),
            "ambient": float(np.median(ambient) / cycles),
            "dark": 0.0,
            "crosstalk": crosstalk.counts,
            "crosstalk_range_m": crosstalk.range_m,
            "irf_std_m": None,
            "irf": irf,
            "irf_start_m": float(grid[0] * width_m),
            "irf_step_m": _IRF_STEP_BINS * width_m,
            "zone_scale": (abs(p["width"]) / p["pitch_h"], abs(p["height"]) / p["pitch_v"]),
            "zone_blur": max(abs(p["blur"]), 1e-3),
            "light_width": 1 / math.sqrt(p["light"]) if p["light"] > 0.01 else None,
            "light_centre": (p["light_left"], p["light_up"]),
            "reference_gain": p["reference_gain"],
            "stray": min(max(p["stray"], 0.0), 0.99),
            "zone_gain": [[float(v) for v in row] for row in (per_light / per_light.mean()).reshape(rows, cols)],
            "zone_bin_scale": [[float(v) for v in row] for row in scales.reshape(rows, cols)],
        },
    )
