"""Histograms of landmarks at views: against the exact integral of images, quadrature by other code, and pile-up."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.special import ndtr

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Flag, Renderer, Sensor, Views, capture, preset
from phasemark.render.direct import HistogramFrames, HistogramRenderer, piled_up

ZONES = preset("vl53l5cx-8x8")
CYLINDER = build_mesh(catalog()["cylinder"])
BEHIND = Background(wall_m=1.6, floor_m=0.35, wall_albedo=0.6, floor_albedo=0.3)
VIEWS = Views.broadcast([0.7, 0.9, 1.2], [0.1, 0.9, 2.0], [0.0, 0.1, -0.2], [-0.05, 0.0, 0.02], 0.0, [0.0, 0.1, 0.0])


def with_histogram(sensor: Sensor, **changes: object) -> Sensor:
    """Return a sensor whose histogram reaches far and counts nothing but signal, with some fields changed."""
    plain = {"ambient": 0.0, "dark": 0.0, "pile_up": False, "bins": 512}
    return sensor.with_(histogram={**sensor.histogram.model_dump(), **plain, **changes})


@pytest.mark.parametrize("background", [None, BEHIND])
def test_a_zones_counts_have_the_light_and_the_mean_range_of_the_exact_integral(background: Background | None) -> None:
    sensor = with_histogram(ZONES)
    histogram = sensor.histogram
    images = HistogramRenderer(CYLINDER, sensor, albedo=0.7).render_views(VIEWS, background=background)
    exact = Renderer(CYLINDER, sensor, albedo=0.7).render_views(VIEWS, background=background)
    scale = histogram.cycles * histogram.photons
    counted = images.expected.sum(axis=-1) / scale
    # 1e-3 is the bar of histograms; where the floor runs to the horizon some light lies beyond the last bin
    np.testing.assert_allclose(counted, exact.intensity, rtol=2e-3, atol=1e-3 * exact.intensity.max())
    np.testing.assert_allclose(images.signal / scale, counted, rtol=1e-9)
    if background is not None:
        middle = histogram.start_m + histogram.bin_width_m * (np.arange(histogram.bins) + 0.5)
        mean_m = images.expected @ middle / images.expected.sum(axis=-1)
        # the argument of a phasor at 1 kHz is the mean range; 1e-3 of a metre-long spread
        assert np.abs(mean_m - exact.range_m).max() < 2e-3


def test_histogram_of_a_floor_is_that_of_dense_quadrature() -> None:
    sensor = with_histogram(ZONES, bins=128)
    histogram = sensor.histogram
    down_m = 0.2
    floor = Background(floor_m=down_m, floor_albedo=1.0)
    got = HistogramRenderer(None, sensor).render(1.0, background=floor).expected[0]
    tan_h, tan_v = sensor.tan_half_angles
    edges = histogram.start_m + histogram.bin_width_m * np.arange(histogram.bins + 1)
    points = 1200
    for row in (5, 7):  # below the horizon, near and steep
        mid = (np.arange(points) + 0.5) / points
        y = tan_h - (3 + mid) * 2 * tan_h / 8
        z = tan_v - (row + mid) * 2 * tan_v / 8
        y, z = np.meshgrid(y, z)
        length = np.sqrt(1 + y**2 + z**2)
        r = down_m / -z * length
        light = (down_m / r) / r**2
        cell = np.minimum((r / 0.002).astype(int), 3999)
        weight = np.bincount(cell.ravel(), light.ravel(), minlength=4000)
        centre = np.bincount(cell.ravel(), (light * r).ravel(), minlength=4000) / np.maximum(weight, 1e-300)
        share = ndtr((edges[:, None] - centre) / histogram.irf_std_m)
        want = np.diff(share, axis=0) @ weight / points**2 * histogram.cycles * histogram.photons
        assert np.abs(got[row, 3] - want).max() < 1e-3 * want.max()


def test_ambient_light_and_pile_up_follow_their_closed_forms() -> None:
    plain = with_histogram(ZONES, bins=128)
    full = with_histogram(ZONES, bins=128, ambient=3e-3, dark=1e-4, pile_up=True, cycles=1e5, photons=0.2)
    bare = HistogramRenderer(CYLINDER, plain).render_views(VIEWS, background=BEHIND).expected
    counted = HistogramRenderer(CYLINDER, full).render_views(VIEWS, background=BEHIND).expected
    per_photon = bare / (plain.histogram.cycles * plain.histogram.photons)
    np.testing.assert_allclose(counted, piled_up(1e5 * (0.2 * per_photon + 3e-3 + 1e-4), 1e5), rtol=1e-9)
    assert (counted.sum(axis=-1) < 1e5).all()


def test_albedos_of_landmark_and_background_scale_their_signals() -> None:
    sensor = with_histogram(ZONES, bins=128, stray=0.1)
    renderer = HistogramRenderer(CYLINDER, sensor, albedo=0.4)
    landmark_light, behind = np.moveaxis(renderer.signal(VIEWS, background=BEHIND), 1, 0)
    np.testing.assert_allclose(renderer.expected(VIEWS, background=BEHIND), 0.4 * landmark_light + behind, rtol=1e-12)
    dim = Background(wall_m=1.6, floor_m=0.35, wall_albedo=0.3, floor_albedo=0.15)
    np.testing.assert_allclose(renderer.signal(VIEWS, background=dim)[:, 1], behind / 2, rtol=1e-9)


def test_views_of_a_batch_and_threads_leave_no_trace() -> None:
    renderer = HistogramRenderer(CYLINDER, ZONES)
    whole = renderer.render_views(VIEWS, background=BEHIND, workers=2).expected
    for k in range(3):
        np.testing.assert_array_equal(renderer.render_views(VIEWS[k : k + 1], background=BEHIND).expected[0], whole[k])


def test_a_mount_that_is_turned_and_raised_is_one_with_a_view_that_is() -> None:
    turned = ZONES.with_(bearing_offset_deg=3.0, height_offset_m=0.02)
    seen = Views.broadcast(0.9, 0.3, np.deg2rad(3.0), 0.02)
    np.testing.assert_allclose(
        HistogramRenderer(CYLINDER, turned).render(0.9, 0.3).expected,
        HistogramRenderer(CYLINDER, ZONES).render_views(seen).expected,
        rtol=1e-12,
    )


def test_capture_of_histograms_has_targets_and_the_same_noise_in_pieces() -> None:
    images = HistogramRenderer(CYLINDER, ZONES).render_views(VIEWS, background=BEHIND)
    whole = capture(images, ZONES, rng=np.random.default_rng(3), n_frames=4)
    assert isinstance(whole, HistogramFrames)
    assert whole.counts.shape == (3, 4, 8, 8, 128)
    assert whole.targets.distance_m.shape == (3, 4, 8, 8, ZONES.histogram.max_targets)
    part = capture(
        HistogramRenderer(CYLINDER, ZONES).render_views(VIEWS[1:2], background=BEHIND),
        ZONES, rng=np.random.default_rng(3), n_frames=2, first_view=1, first_frame=2, workers=2,
    )  # fmt: skip
    np.testing.assert_array_equal(part.counts[0], whole.counts[1, 2:])


def test_ranges_of_histograms_are_those_of_the_nearest_target_along_the_ray() -> None:
    sensor = ZONES.with_(dead_pixels=((2, 3),))
    assert sensor.histogram.reports == "z"
    images = HistogramRenderer(None, sensor).render(1.0, background=Background(wall_m=1.2, wall_albedo=0.9))
    frames = capture(images, sensor, rng=np.random.default_rng(1), n_frames=5)
    nearest = frames.ranges
    assert (nearest.flags[:, :, 2, 3] == int(Flag.DEAD | Flag.MISSING)).all()
    assert (frames.counts[:, :, 2, 3] == 0).all()
    alive = nearest.valid
    np.testing.assert_allclose(nearest.z_m[alive], frames.targets.distance_m[..., 0][alive], rtol=1e-12)
    assert np.abs(nearest.z_m[alive] - 1.2).max() < 0.03  # half a bin is 19 mm


def test_what_cannot_be_rendered_or_captured_is_refused_in_one_line() -> None:
    rng, phase = np.random.default_rng(0), preset("pmd-16x16")
    cylinder, nothing = HistogramRenderer(CYLINDER, ZONES), HistogramRenderer(None, ZONES)
    images = nothing.render(1.0, background=Background(wall_m=1.2))
    fields = ZONES.histogram.model_dump()
    brighter, one = (ZONES.with_(histogram={**fields, **change}) for change in ({"photons": 0.5}, {"max_targets": 1}))
    calls: list[tuple[Callable[[], object], str]] = [
        (lambda: HistogramRenderer(None, phase), r"has no \[histogram\] table"),
        (lambda: HistogramRenderer(None, ZONES, albedo=1.5), "'albedo' must be in"),
        (lambda: cylinder.render(0.01), "inside the landmark's bounding box"),
        (lambda: cylinder.render(1.0, background=Background(wall_m=0.9)), "before the landmark's farthest point"),
        (lambda: nothing.render(1.0, workers=0), "'workers' must be at least 1"),
        (lambda: capture(images, brighter, rng=rng), r"rendered for another sensor: 'histogram.photons' differs"),
        (lambda: capture(images, ZONES, rng=rng, keep_taps=True), "'keep_taps' must be left out for a direct sensor"),
        (lambda: capture(images, phase, rng=rng), r"has no \[histogram\] table"),
    ]
    for call, message in calls:
        with pytest.raises(UsageError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)
    # the number of targets is the chip's, and no part of the light
    assert capture(images, one, rng=rng).targets.distance_m.shape[-1] == 1


def test_vignetting_dims_a_zone_by_the_fourth_power_of_the_cosine() -> None:
    plain, dimmed = (
        HistogramRenderer(None, ZONES.with_(vignetting=on)).render(1.0, background=Background(wall_m=1.2)).signal[0]
        for on in (False, True)
    )
    cosine = ZONES.axis_cosine()
    np.testing.assert_allclose(dimmed / plain, cosine**4, rtol=5e-3)  # the mean over a zone of 5.6 degrees


def test_histograms_draw_themselves() -> None:
    images = HistogramRenderer(CYLINDER, ZONES).render(0.8)
    frames = capture(images, ZONES, rng=np.random.default_rng(0))
    for figure in (images.plot(), frames.plot()):
        assert len(figure.axes) >= 2
    with pytest.raises(UsageError, match="there is no view 1: they count from 0 to 0"):
        images.plot(1)
    with pytest.raises(UsageError, match="there is no frame 3"):
        frames.plot(0, 3)
