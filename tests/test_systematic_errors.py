"""Errors that all frames of a camera share are in the covariance of a view."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from phasemark import UsageError
from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, cramer_rao, kalman_filter
from phasemark.matcher.filters.filtered_frames import noise_free
from phasemark.matcher.likelihood.systematic import RECORDING_FIELDS, calibrated_slopes, rates_of_views
from phasemark.matcher.statistics import within_ellipsoid
from phasemark.render import Background, Frames, Renderer, Views, capture

VIEW = ("distance_m", "delta_rad")
FIELDS = ("pitch_deg", "half_angle_h_deg", "half_angle_v_deg", "bearing_offset_deg", "range_offset_m")
STD = np.array([0.02, 0.01, 0.01, 0.05, 2e-3])
"""Small enough that a frame read with another camera fits: poor fits are searched again, which takes long."""
N_CAMERAS = 24


def calibrated(sensor, **more):
    covariance = tuple(tuple(row) for row in np.diag(STD**2).tolist())
    return sensor.with_(calibration_fields=FIELDS, calibration_covariance=covariance, **more)


@pytest.fixture(scope="module", params=["pmd-16x16", "vl53l5cx-8x8"])
def bank(request):
    plan = BankPlan(
        classes=("cone",), sensor=request.param, layout="full",
        distance_m="0.93:1.07:0.01", delta_deg="0:90:1",
    )  # fmt: skip
    return build_bank(plan, workers=1)


@pytest.mark.parametrize("wall_m", [None, 3.0])
def test_slopes_by_calibrated_fields_are_those_of_frames_made_with_other_fields(bank, wall_m):
    # the oracle measures twice: with the camera as it is, and read with a camera that is a little different
    sensor, background = calibrated(bank.sensor), None if wall_m is None else Background(wall_m=wall_m)
    renderer = Renderer(bank.mesh("cone"), sensor, albedo=0.8)
    views = Views.broadcast(1.013, 0.7, 0.0, 0.0)
    image = renderer.render_views(views, background=background)
    slopes = calibrated_slopes(renderer, sensor, views, image, background, sensor.calibration_fields)
    inside = (image.coverage[0] > 0.999) | (image.coverage[0] < 1e-4)  # no edge, whose slope is another over each step
    for k, (name, step) in enumerate(zip(FIELDS, (1e-3, 1e-3, 1e-3, 1e-3, 1e-5), strict=True)):
        other = sensor.with_(**{name: getattr(sensor, name) + step})
        there = Renderer(bank.mesh("cone"), other, albedo=0.8).render_views(views, background=background)
        model = there.range_m[0] - image.range_m[0]
        measured = np.zeros(model.shape)
        if sensor.quantity == "z":
            measured = image.range_m[0] * (sensor.axis_cosine() / other.axis_cosine() - 1)
        expected = (model - measured) / step
        lit = inside & (image.phasor[0] != 0)
        found = sensor.metres_per_radian * (slopes[0, k][lit] / image.phasor[0][lit]).imag
        if name == "range_offset_m":
            np.testing.assert_allclose(found, 1.0, rtol=1e-9)  # m per m
            continue
        flat = np.abs(expected[lit]) < 0.05  # m per degree; not where an edge lies within the wider of the two steps
        assert flat.sum() >= 2
        np.testing.assert_allclose(found[flat], expected[lit][flat], atol=2e-3)


def test_views_measured_by_many_cameras_scatter_as_the_covariance_says(bank):
    # every camera differs from the calibrated one by a draw from the calibration's covariance; N = 24, 99.9 %
    rng, sensor = np.random.default_rng(11), bank.sensor
    matcher = Matcher(bank, "refine", free=VIEW)
    renderer = Renderer(bank.mesh("cone"), sensor, albedo=0.8)
    views = np.column_stack([rng.uniform(0.95, 1.05, N_CAMERAS), rng.uniform(0.2, 1.3, N_CAMERAS)])
    taken = []
    for view in views:
        off = dict(zip(FIELDS, (STD * rng.standard_normal(len(FIELDS))).tolist(), strict=True))
        true = sensor.with_(**{name: getattr(sensor, name) + value for name, value in off.items()})
        frames = capture(renderer.seen_by(true).render(*view), true, rng=rng, n_frames=10)
        if sensor.quantity == "z":  # a file holds z, and is read with the calibrated camera's angles
            frames.range_m *= true.axis_cosine() / sensor.axis_cosine()
        taken.append(frames)

    def joined(name):
        arrays = [getattr(frames, name) for frames in taken]
        return None if arrays[0] is None else np.concatenate(arrays)

    frames = Frames(
        joined("range_m"), joined("amplitude_e"), joined("intensity_e"), flags=joined("flags"),
        sensor=calibrated(sensor),
    )  # fmt: skip
    matches = list(matcher.match(kalman_filter(frames)))
    known = [k for k, match in enumerate(matches) if set(match.systematic) == {"calibration"}]
    assert len(known) > 0.9 * N_CAMERAS
    error = [
        [matches[k].distance_m - views[k, 0], math.remainder(matches[k].delta_rad - views[k, 1], math.pi)]
        for k in known
    ]
    total = [matches[k].covariance for k in known]
    noise = [matches[k].covariance - matches[k].systematic["calibration"] for k in known]
    n = len(known)
    assert stats.binom.ppf(5e-4, n, 0.95) <= within_ellipsoid(error, total).sum()
    # noise alone does not explain the errors
    assert within_ellipsoid(error, noise).sum() < stats.binom.ppf(5e-4, n, 0.95)


def test_each_term_can_be_left_out_and_is_listed(bank):
    sensor = calibrated(bank.sensor, systematic_delta_deg=0.5)
    frames = noise_free(Renderer(bank.mesh("cone"), sensor, albedo=0.8).render(1.0, 0.7), 50)
    by_terms = {
        terms: Matcher(bank, "refine", free=VIEW, systematic=terms).match(frames)[0]
        for terms in ((), ("calibration",), ("declared",), ("calibration", "declared"))
    }
    noise = by_terms[()].covariance
    for terms, match in by_terms.items():
        assert set(match.systematic) == set(terms)
        total = noise + sum(match.systematic.values(), np.zeros((2, 2)))
        np.testing.assert_allclose(match.covariance, total, rtol=1e-12)
        assert set(match.as_dict()["systematic"]) == set(terms)
    declared = by_terms["declared",].systematic["declared"]
    np.testing.assert_allclose(declared, np.diag([0.0, math.radians(0.5) ** 2]), rtol=1e-12)


def test_another_recording_differs_as_a_calibration_of_that_covariance_would(bank):
    stds = {"range_offset_m": 5e-3, "pitch_deg": 0.8, "roll_deg": 0.7, "bearing_offset_deg": 0.6}
    own = dict(zip(RECORDING_FIELDS.values(), stds.values(), strict=True))
    as_calibrated = bank.sensor.with_(
        calibration_fields=tuple(stds), calibration_covariance=tuple(map(tuple, np.diag(np.square([*stds.values()]))))
    )
    views, sensor = Views.broadcast(1.0, 0.7), bank.sensor.with_(**own)
    parts = [
        Matcher(bank, "refine", free=VIEW, tolerance_m=0.5, tolerance_rad=1.0)
        .match(noise_free(Renderer(bank.mesh("cone"), one, albedo=0.8).render(1.0, 0.7), 50))[0]
        .systematic
        for one in (sensor, as_calibrated)
    ]
    assert [set(part) for part in parts] == [{"recording"}, {"calibration"}]
    np.testing.assert_allclose(parts[0]["recording"], parts[1]["calibration"], rtol=1e-9)
    renderer = Renderer(bank.mesh("cone"), sensor, albedo=0.8)
    alone = Renderer(bank.mesh("cone"), bank.sensor.with_(recording_range_m=5e-3), albedo=0.8)
    plain, both = cramer_rao(renderer, views), cramer_rao(renderer, views, systematic=("recording",))
    np.testing.assert_allclose(both.covariance - plain.covariance, parts[0]["recording"][None], rtol=0.05)
    # a range offset moves the distance along the ray: by more than itself seen from above, by less for a slanted face
    grown = (cramer_rao(alone, views, systematic=("recording",)).covariance - plain.covariance)[0, 0, 0]
    assert 0.8 < math.sqrt(grown) / 5e-3 < 1.2


def test_a_stamp_that_jitters_adds_the_motion_of_its_time(bank):
    # a camera that turns by 40°/s and approaches by 0.3 m/s: the covariance grows by the square of 20 ms of that
    rate, jitter_s = np.array([-0.3, math.radians(40.0)]), 0.02
    sensor = bank.sensor.with_(systematic_time_s=jitter_s)
    time_s = 0.06 * np.arange(6.0)
    view = np.array([1.05, 0.4]) + rate * time_s[:, None]
    images = Renderer(bank.mesh("cone"), sensor, albedo=0.8).render_views(Views.broadcast(*view.T, 0.0, 0.0))
    frames = replace(noise_free(images, 50), time_s=time_s)
    matches = Matcher(bank, "refine", free=VIEW).match(frames)
    for match in matches:
        np.testing.assert_allclose(match.systematic["motion"], np.outer(rate, rate) * jitter_s**2, rtol=0.05)
    still = Matcher(bank, "refine", free=VIEW, systematic=("declared",)).match(frames)
    np.testing.assert_allclose(
        matches.covariance - still.covariance, [match.systematic["motion"] for match in matches], atol=1e-15
    )
    assert not Matcher(bank, "refine", free=VIEW).match(replace(frames, time_s=None))[0].systematic
    assert not Matcher(bank, "refine", free=VIEW).match(frames[:1])[0].systematic  # one frame tells no rate


def test_rates_take_the_short_way_round_and_only_estimates_nearby():
    time_s = np.array([0.0, 0.1, 0.2, 5.0, 5.1])
    angle = np.radians([178.0, 179.5, 1.0, 90.0, 91.0])  # repeats after 180°
    view, std = np.column_stack([np.ones(5), angle]), np.full((5, 2), 0.01)
    rate = rates_of_views(time_s, view, std, np.full(5, math.pi), 1)
    np.testing.assert_allclose(rate[:3], [[0.0, math.radians(15.0)]] * 3, atol=1e-12)
    assert not rate[3:].any()
    view[1] = np.nan
    assert not rates_of_views(time_s, view, std, np.full(5, math.pi), 1).any()  # two estimates are too few


def test_the_bound_carries_the_same_terms(bank):
    sensor = calibrated(bank.sensor, systematic_distance_m=3e-3)
    renderer = Renderer(build_mesh(catalog()["cone"]), sensor, albedo=0.8)
    views = Views.broadcast(1.0, 0.7)
    plain = cramer_rao(renderer, views)
    declared = cramer_rao(renderer, views, systematic=("declared",))
    np.testing.assert_allclose(declared.covariance - plain.covariance, [np.diag([9e-6, 0.0])], atol=1e-18)
    both = cramer_rao(renderer, views, systematic=("calibration", "declared"))
    assert (np.linalg.eigvalsh(both.covariance - declared.covariance) > -1e-12).all()
    # a range offset moves the distance by its own value: at least its variance is in the bound
    assert both.covariance[0, 0, 0] > declared.covariance[0, 0, 0] + 0.5 * STD[-1] ** 2


def test_unknown_terms_are_named(bank):
    with pytest.raises(
        UsageError, match="'systematic' must be among calibration, recording, declared, multipath, motion, got 'noise'"
    ):
        Matcher(bank, "refine", systematic=("noise",))
