"""Filters, bounds and matching of cameras with several modulation frequencies (PHYSICS section 10)."""

import math
from typing import Any

import numpy as np
import pytest
from builders import cut_alike, wrapped
from scipy import stats
from test_calibrate import MESH, filtered, some_mounting, some_poses
from test_calibrate import nees as mounting_nees

from phasemark import UsageError
from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.landmarks.spec import Box
from phasemark.matcher import Matcher, PixelKalman, calibrate, diagnose, kalman_filter, phasor_mean
from phasemark.matcher.accuracy.appearance import class_distances_squared
from phasemark.matcher.accuracy.cramer_rao import cramer_rao
from phasemark.matcher.accuracy.grid_spacing import grid_loss
from phasemark.matcher.design import DesignPlan, turn_distance
from phasemark.matcher.filters.filtered_frames import PixelState, noise_free
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.statistics import nees, view_errors
from phasemark.render import (
    Background,
    Frames,
    Renderer,
    Views,
    capture,
    characterise,
    predicted_range_std,
    preset,
)
from phasemark.render.bench.fit.fit_sensor import fit_sensor
from phasemark.render.unwrapped_frames import unwrap_frames

PMD = preset("pmd-16x16")
TWO = PMD.with_(modulation_hz=[20e6, 60e6])
CYLINDER = build_mesh(catalog()["cylinder"])


def take(image, sensor, n_frames, seed=1):
    return capture(image, sensor, rng=np.random.default_rng(seed), n_frames=n_frames)


# Filters


@pytest.fixture(scope="module")
def wall():
    return Renderer(None, TWO).render(np.ones(20), background=Background(wall_m=5.8))


@pytest.mark.parametrize("filter_frames", [kalman_filter, phasor_mean])
def test_filtered_ranges_are_unwrapped_with_the_variance_of_the_filter(wall, filter_frames):
    filtered = filter_frames(take(wall, TWO.with_(max_phase_std_rad=None), 40))
    assert (filtered.state == PixelState.RETURN).mean() > 0.999
    law = 40 * np.sum(
        [predicted_range_std(p.amplitude, p.intensity, p.sensor) ** -2.0 for p in wall.by_frequency], axis=0
    )
    error = (filtered.range_m - wall.range_m)[filtered.state == PixelState.RETURN]
    np.testing.assert_allclose(np.nanmedian(filtered.std_m**2 * law), 1.0, rtol=0.02)
    whitened = error * np.sqrt(law[filtered.state == PixelState.RETURN])
    low, high = stats.chi2.interval(0.999, error.size)
    # σ_φ is 0.05 rad here, and the law is 0.1 % low
    assert low <= np.sum(whitened**2) / 1.004 <= high


def test_the_recursive_filter_gives_what_the_batch_gives(wall):
    frames = take(wall, TWO, 5)
    one = PixelKalman(TWO)
    for k in range(5):
        one.update(frames.some_frames(k, k + 1))
    batch = kalman_filter(frames)
    np.testing.assert_allclose(one.result().range_m, batch.range_m, rtol=1e-12)
    np.testing.assert_array_equal(one.result().state, batch.state)


def test_mixed_pixels_are_missing_and_each_frequency_keeps_them():
    image = Renderer(CYLINDER, TWO).render(1.0, 0.3, background=Background(wall_m=3.0))
    filtered = kalman_filter(take(image, TWO, 50))
    mixed = (image.coverage[0] > 0.1) & (image.coverage[0] < 0.9)
    assert (filtered.state[0][mixed] == PixelState.MISSING).mean() > 0.9
    assert all((part.state[0][mixed] == PixelState.RETURN).mean() > 0.9 for part in filtered.by_frequency)
    assert [part.range_m.shape for part in filtered[:1].by_frequency] == [(1, 16, 16)] * 2


def test_unwrapped_ranges_alone_are_filtered_by_their_scatter(wall):
    frames = take(wall, TWO, 30)
    alone = Frames(frames.range_m, frames.amplitude_e, frames.intensity_e, flags=frames.flags, sensor=TWO)
    filtered = kalman_filter(alone)
    assert filtered.std_from_scatter
    np.testing.assert_allclose(np.nanmedian(filtered.std_m / kalman_filter(frames).std_m), 1.0, rtol=0.1)
    with pytest.raises(UsageError, match="unwrapped ranges alone"):
        phasor_mean(alone)


def test_the_offset_is_taken_off_every_frequency(wall):
    late = TWO.with_(range_offset_m=1.9)
    filtered = kalman_filter(take(wall, late, 5)).without_offset()
    for part, image in zip(filtered.by_frequency, wall.by_frequency, strict=True):
        assert np.nanmax(np.abs(wrapped(part.range_m - image.range_m, part.sensor))) < 6 * np.nanmax(part.std_m)
    assert np.nanmax(np.abs(filtered.range_m - wall.range_m)) < 6 * np.nanmax(filtered.std_m)


def test_frames_without_noise_have_the_exact_range(wall):
    filtered = noise_free(wall, 50)
    np.testing.assert_allclose(filtered.range_m, wall.range_m, atol=1e-9)


# Matching


N = 10
CLASSES = ("cylinder", "cone", "post")


@pytest.fixture(scope="module")
def bank():
    plan = BankPlan(
        classes=list(CLASSES),
        distance_m="0.9:1.25:0.01",
        delta_deg="0:178:2",
        sensor_overrides={"modulation_hz": [20e6, 60e6]},
    )
    with build_bank(plan, workers=1) as built:
        yield built


def scene(bank, background, bearing_std_deg=1.0, seed=5):
    rng = np.random.default_rng(seed)
    views = Views.broadcast(
        rng.uniform(0.95, 1.2, N), rng.uniform(0.1, 3.0, N), rng.normal(0, math.radians(bearing_std_deg), N)
    )
    renderer = Renderer(bank.mesh("cylinder"), bank.sensor)
    return renderer, renderer.render_views(views, background=background)


WALL = Background(wall_m=3.0)
# evidence, background, share that is accepted, numbers compared with the bound, slack of the mean NEES
BOUNDS: dict[str, tuple[Any, ...]] = {
    "phasors": ("phasors", None, 0.8, VIEW[:3], 1.0),
    # the start is a grid of 2°, and these ranges are good to half a millimetre
    "unwrapped ranges": ("ranges", None, 0.6, VIEW[:1], 1.0),
    # each frequency's wrapped range counts by itself: mixed pixels have no range that the frequencies agree on
    "ranges before a wall": ("ranges", WALL, 0.8, VIEW[:3], 1.3),
    "phasors before a wall": ("phasors", WALL, 0.8, VIEW[:3], 1.0),
}


@pytest.mark.parametrize("case", [*list(BOUNDS)[:3], pytest.param("phasors before a wall", marks=pytest.mark.soak)])
def test_matching_reaches_the_bound_and_its_covariance_is_honest(bank, case):
    on, background, share, names, slack = BOUNDS[case]
    renderer, image = scene(bank, background)
    if on == "phasors":
        frames = phasor_mean(take(image, TWO.with_(max_phase_std_rad=None), 50))
    else:
        frames = kalman_filter(take(image, TWO, 50))
    matches = Matcher(bank, "refine", on=on, background=background).match(frames)
    accepted = matches.accepted
    assert accepted.mean() > share
    assert (matches.class_name[accepted] == "cylinder").all()
    error = view_errors(matches, image.views, VIEW[:3], np.pi)[accepted]
    bound = cramer_rao(renderer, image.views, free=VIEW[:3], on=on, background=background)
    low, high = stats.chi2.interval(1 - 0.001 / 8, len(error))  # 99.9 %, eight cells
    for k, name in enumerate(names):
        ratio = error[:, k] / bound.std(name)[accepted]
        assert low < np.sum(ratio**2) < 1.3 * high  # the bound is local: slopes jump where edges cross pixel borders
    low, high = stats.chi2.interval(1 - 0.001 / 8, 3 * len(error))
    assert low < nees(error, matches.covariance[accepted]).sum() < slack * high


@pytest.mark.parametrize("background", [None, WALL], ids=["alone", "wall"])
def test_four_ranges_without_amplitudes_of_two_frequencies_have_an_honest_covariance(bank, background):
    """Each frequency's noise is pooled before the ranges are unwrapped with it; NEES was 5.8 times too large."""
    _, image = scene(bank, background)
    frames = take(image, TWO, 4)
    alone = unwrap_frames([Frames(one.range_m, flags=one.flags, sensor=one.sensor) for one in frames.by_frequency], TWO)
    matches = Matcher(bank, "refine", free=VIEW[:3], background=background).match(kalman_filter(alone))
    accepted = matches.accepted
    assert accepted.mean() > 0.6
    error = view_errors(matches, image.views, VIEW[:3], np.pi)[accepted]
    assert nees(error, matches.covariance[accepted]).sum() < 1.3 * stats.chi2.ppf(0.999, 3 * len(error))


@pytest.mark.parametrize("background", [None, pytest.param(WALL, marks=pytest.mark.soak)], ids=["alone", "wall"])
def test_all_six_numbers_are_found_on_phasors_of_two_frequencies(bank, background):
    rng, n = np.random.default_rng(12), 8
    tilts = [rng.normal(0, width, n) for width in (0.03, 0.03, 0.04, 0.06)]
    views = Views.broadcast(rng.uniform(0.95, 1.2, n), rng.uniform(0, math.pi, n), *tilts)
    renderer = Renderer(bank.mesh("cone"), TWO.with_(max_phase_std_rad=None))
    frames = phasor_mean(take(renderer.render_views(views, background=background), renderer.sensor, 50))
    matcher = Matcher(
        bank, "refine", free=VIEW, on="phasors", background=background, height_std_m=0.05, pitch_std_rad=0.06,
        roll_std_rad=0.1,
    )  # fmt: skip
    matches = matcher.match(frames)
    found = matches.accepted
    assert found.sum() >= n - 1  # a frame may end in another minimum, and is refused
    assert (matches.class_name[found] == "cone").all()
    squares = nees(view_errors(matches, views, VIEW, np.pi)[found], matches.covariance[found])
    # covariances are local beside edges before a wall: no error may be far beyond them; 99.9 % of the median of 8
    assert np.median(squares) < 2.3 * stats.chi2.median(6)
    assert squares.max() < 60


@pytest.mark.parametrize("background", [None, WALL])
def test_the_nearest_image_is_found_by_phases_of_every_frequency(bank, background):
    _, image = scene(bank, background, bearing_std_deg=0.0)
    matches = Matcher(bank, background=background).match(kalman_filter(take(image, TWO, 5)))
    accepted = matches.accepted
    assert accepted.mean() > 0.5
    assert np.abs(matches.distance_m - image.views.distance_m)[accepted].max() < 0.03
    assert (matches.class_name[accepted] == "cylinder").all()


@pytest.mark.parametrize(
    ("method", "on"),
    [("nearest", "ranges"), ("refine", "ranges"), pytest.param("refine", "phasors", marks=pytest.mark.soak)],
)
def test_a_landmark_beyond_the_range_of_one_frequency_is_found_right_or_refused(method, on):
    sensor = TWO.with_(signal_e=4e5, half_angle_h_deg=5, half_angle_v_deg=5)
    plan = BankPlan(
        classes=["cylinder"], distance_m="2.3:3.0:0.02", delta_deg="0:176:4",
        sensor_overrides={
            "modulation_hz": [20e6, 60e6], "signal_e": 4e5, "half_angle_h_deg": 5.0, "half_angle_v_deg": 5.0,
        },
    )  # fmt: skip
    rng = np.random.default_rng(8)
    with build_bank(plan, workers=1) as far:
        # 60 MHz wraps at 2.498 m: some are before it, some beyond
        views = Views.broadcast(rng.uniform(2.4, 2.9, 8), rng.uniform(0.2, 2.9, 8))
        image = Renderer(far.mesh("cylinder"), sensor).render_views(views)
        seen = kalman_filter(take(image, sensor, 50))
        options = {"on": on, "free": ("distance_m", "delta_rad")} if method == "refine" else {}
        matches = Matcher(far, method, **options).match(seen)
        assert matches.accepted.any()
        assert np.abs(matches.distance_m - views.distance_m)[matches.accepted].max() < 0.03
        # these are half a turn of 60 MHz nearer than the bank begins: found where they are, or refused
        near = Renderer(far.mesh("cylinder"), sensor).render_views(
            Views.broadcast(views.distance_m[:4] - 1.249, views.delta_rad[:4])
        )
        found = Matcher(far, method, **options).match(kalman_filter(take(near, sensor, 50)))
        assert (np.abs(found.distance_m - near.views.distance_m) < 0.03)[found.accepted].all()


def test_information_is_the_sum_of_that_of_the_frequencies(monkeypatch):
    cut_alike(monkeypatch, TWO)
    views = Views.broadcast([1.0, 1.3], [0.3, 1.2])
    together = cramer_rao(Renderer(CYLINDER, TWO), views, pixels="lower")
    alone = [cramer_rao(Renderer(CYLINDER, camera), views, pixels="lower") for camera in TWO.by_frequency]
    np.testing.assert_allclose(together.information, sum(one.information for one in alone), rtol=1e-6)
    assert together.pixels.shape == (2, 16, 16)


def test_another_class_is_farther_away_in_two_frequencies_than_in_one():
    views = Views.broadcast([1.2], [0.5])

    def distance_squared(sensor):
        return class_distances_squared(
            Renderer(CYLINDER, sensor), views, {"cone": Renderer(build_mesh(catalog()["cone"]), sensor)}
        )[0, 0]

    alone = [distance_squared(camera) for camera in TWO.by_frequency]
    # at one view distances add up; each frequency alone may choose its own
    assert distance_squared(TWO) > 0.95 * sum(alone)


def test_what_is_not_understood_of_several_frequencies_is_refused_in_one_line(bank):
    _, image = scene(bank, None)
    frames = take(image, TWO, 2)
    alone = kalman_filter(Frames(frames.range_m, flags=frames.flags, sensor=TWO))
    other, rng = kalman_filter(take(Renderer(CYLINDER, PMD).render(1.0), PMD, 2)), np.random.default_rng(1)
    for call, message in (
        (lambda: Matcher(bank).match(alone), "unwrapped ranges alone, and phases are compared at every modulation"),
        (lambda: Matcher(bank, "refine", background=WALL).match(alone), 'alone, .* on="ranges" and no background'),
        (lambda: Matcher(bank, "refine", on="phasors", background="auto"), 'background="auto" takes on="ranges"'),
        (lambda: characterise(TWO, rng=rng), "a data sheet takes a sensor of one modulation frequency, got"),
        (lambda: fit_sensor([frames[:1]], [1.0], base=TWO), "a fit takes a sensor of one modulation frequency"),
        (lambda: Matcher(bank).match(other), "another sensor than the bank's: 'modulation_hz' is"),
    ):
        with pytest.raises(UsageError, match=message):
            call()


def test_frames_before_another_wall_are_refused_where_none_is_accepted(bank):
    """No answer is left that may be mirrored, with the bearing free."""
    _, image = scene(bank, WALL)
    frames = kalman_filter(take(image, TWO, 10))[:2]
    assert not Matcher(bank, "refine", background=Background(wall_m=2.5)).match(frames).accepted.any()


# Each frequency by itself


def test_the_noise_law_of_several_frequencies_is_the_combined_one():
    each = [predicted_range_std(0.5, 0.6, camera) for camera in TWO.by_frequency]
    assert predicted_range_std(0.5, 0.6, TWO) == pytest.approx(sum(std**-2.0 for std in each) ** -0.5, rel=1e-12)


def test_a_camera_is_characterised_and_fitted_at_each_frequency():
    camera = TWO.with_(range_offset_m=0.05, phase_offset_std_rad=0.01)
    distances = [0.8, 1.0, 1.3, 1.7]
    boards = [
        capture(
            Renderer(None, camera).render(1.0, background=Background(wall_m=d, wall_albedo=0.8)),
            camera, rng=np.random.default_rng(k), n_frames=40,
        )
        for k, d in enumerate(distances)
    ]  # fmt: skip
    for j, single in enumerate(TWO.by_frequency):
        fit = fit_sensor([one.by_frequency[j] for one in boards], distances, base=single, albedo=[0.8])
        found = fit.estimates["range_offset_m"]
        # the mean of 256 fixed offsets of 0.01 rad moves it too
        tolerance = 4 * math.hypot(found.std_error, 0.01 * single.metres_per_radian / 16)
        assert abs(fit.sensor.range_offset_m - 0.05) < tolerance
        assert fit.sensor.phase_offset_std_rad == pytest.approx(0.01, rel=0.15)
        assert fit.sensor.signal_e * fit.sensor.contrast == pytest.approx(TWO.signal_e * 0.5, rel=0.02)
    sheet = characterise(TWO.by_frequency[1], rng=np.random.default_rng(1), n_frames=20)
    assert sheet.sensor.modulation_hz == 60e6


# What is made from matching and bounds


def test_a_camera_of_two_frequencies_is_calibrated_on_unwrapped_ranges():
    rng = np.random.default_rng([7, 0])
    truth, poses = some_mounting(rng, 0.8), some_poses(rng, 8)
    there = truth.on(TWO)
    views = Views.broadcast(poses.distance_m, poses.delta_rad, poses.bearing_rad, poses.height_m)
    seen = capture(Renderer(MESH, there, albedo=0.8).render_views(views), there, rng=rng, n_frames=50)
    frames = Frames(
        seen.range_m, seen.amplitude_e, seen.intensity_e, flags=seen.flags, sensor=TWO, by_frequency=seen.by_frequency
    )
    found = calibrate(MESH, filtered(frames), poses)
    assert found.sensor.modulation_hz == found.base.modulation_hz == (20e6, 60e6)
    assert found.sensor.pitch_deg == pytest.approx(math.degrees(truth.pitch_rad), abs=0.05)
    assert not found.doubts
    # the NEES of 7 numbers is χ²(7), 99.9 %
    assert stats.chi2.ppf(5e-4, 7) < mounting_nees(found, truth) < stats.chi2.ppf(1 - 5e-4, 7)
    with pytest.raises(UsageError, match="a calibration with several modulation frequencies takes 'on' = ranges"):
        calibrate(MESH, filtered(frames), poses, on="phasors")


def test_the_spacing_that_costs_as_much_as_the_noise_follows_from_information_that_adds_up():
    """Fisher information of the frequencies adds up, so that reciprocal squares of the steps do too."""
    steps, mismatch = {}, {}
    for hz in (20e6, 60e6, [20e6, 60e6]):
        plan = BankPlan(
            classes=["cone"], distance_m="0.9:1.1:0.02", delta_deg="0:176:4", sensor_overrides={"modulation_hz": hz}
        )
        with build_bank(plan, workers=1) as bank:
            loss = grid_loss(bank, 60, workers=1)
        key = hz if isinstance(hz, float) else "both"
        steps[key] = np.array([loss.suggested_distance_m, loss.suggested_delta_deg]) ** -2
        mismatch[key] = loss.mismatch_median
        assert loss.refined.class_errors == 0
    # medians over 60 views, of a sum and of its parts
    np.testing.assert_allclose(steps["both"], steps[20e6] + steps[60e6], rtol=0.05)
    low, high = sorted((mismatch[20e6], mismatch[60e6]))
    assert 0.95 * low < mismatch["both"] < 1.05 * high  # a weighted mean in each view; these are medians over views


def test_boxes_turned_are_farther_apart_in_two_frequencies():
    """One view has to imitate a box at both: the least of a sum is no less than the sum of the least."""
    box = Box(length_m=0.3, width_m=0.2, height_m=0.3)
    alone = [turn_distance(box, PMD.with_(modulation_hz=hz), DesignPlan()) for hz in (20e6, 60e6)]
    both = turn_distance(box, TWO, DesignPlan())
    assert both**2 > 0.99 * sum(one**2 for one in alone)


@pytest.mark.parametrize("on", ["ranges", pytest.param("phasors", marks=pytest.mark.soak)])
def test_a_refused_frame_of_two_frequencies_is_diagnosed(bank, on):
    image = Renderer(bank.mesh("cone"), TWO).render(1.1, 0.6, math.radians(6))
    matcher = Matcher(bank, "refine", free=VIEW[:2], on=on)
    found = diagnose(matcher, kalman_filter(take(image, TWO, 50)), seconds=30)
    assert [change.parameter for change in found.changes] == ["free"]
    assert math.degrees(found.match.bearing_rad) == pytest.approx(6.0, abs=0.2)
    assert found.match.class_name == "cone"
