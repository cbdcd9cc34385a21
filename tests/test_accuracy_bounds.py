"""Bounds against PHYSICS section 7, closed forms and each other; figures of merit on errors of known law."""

import math
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy import stats

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher.accuracy.cramer_rao import confusion_probability, cramer_rao
from phasemark.matcher.information import eliminated
from phasemark.matcher.statistics import binomial_interval, nees, rms_interval, within_ellipsoid
from phasemark.render import Background, Renderer, Views, predicted_range_std, preset

SENSOR = preset("pmd-16x16")


@pytest.fixture(scope="module")
def cylinder():
    return Renderer(build_mesh(catalog()["cylinder"]), SENSOR, albedo=0.8)


@pytest.mark.parametrize(
    ("distance_m", "std_mm", "std_deg"), [(1.0, (0.31, 0.36), (0.05, 0.43)), (2.0, (1.3, 1.7), (0.5, 2.4))]
)
def test_lower_pixels_without_background_know_what_the_physics_page_says(cylinder, distance_m, std_mm, std_deg):
    bound = cramer_rao(cylinder, Views.broadcast(distance_m, np.radians(np.arange(2.5, 180, 5))), pixels="lower")
    mm, deg = 1e3 * bound.std("distance_m"), np.degrees(bound.std("delta_rad"))
    # the page's intervals are rounded and of other angles: nine tenths of the views lie in them, a digit to spare
    assert np.mean((mm > std_mm[0] - 0.02) & (mm < std_mm[1] + 0.03)) > 0.9
    assert np.mean((deg > std_deg[0] * 0.9) & (deg < std_deg[1] * 1.1)) > 0.9
    if distance_m == 1.0:
        assert np.median(deg) == pytest.approx(0.26, abs=0.02)


def test_before_a_wall_edges_inform(cylinder):
    views = Views.broadcast(1.0, np.radians(np.arange(2.3, 180, 9.1)))
    bound = cramer_rao(cylinder, views, background=Background(wall_m=4.0), pixels="lower")
    assert 1e3 * np.median(bound.std("distance_m")) == pytest.approx(0.07, abs=0.02)
    assert np.degrees(np.median(bound.std("delta_rad"))) == pytest.approx(0.03, abs=0.012)


def test_a_plate_across_the_view_has_the_closed_form():
    plate = Renderer(trimesh.creation.box((0.002, 4.0, 4.0)), SENSOR, albedo=0.8)
    views = Views.broadcast(1.001)
    image = plate.render_views(views)
    bound = cramer_rao(plate, views, free=("distance_m",), n_frames=50)
    std = predicted_range_std(image.amplitude, image.intensity, SENSOR) / math.sqrt(50)
    # every range grows with D by 1 / cos of its ray, which is range over distance
    expected = 1 / math.sqrt(np.sum((image.range_m / 1.0 / std) ** 2))
    assert bound.std("distance_m")[0] == pytest.approx(expected, rel=1e-3)  # differences and footprints


def test_what_is_unknown_beside_the_view_never_helps(cylinder):
    views, wall = Views.broadcast([1.0, 1.3], [0.3, 1.2]), Background(wall_m=4.0)
    for on in ("ranges", "phasors"):
        known, unknown = (
            cramer_rao(cylinder, views, on=on, background=wall, nuisances=names).information
            for names in ((), ("albedo", "wall_m", "wall_albedo"))
        )
        # the difference is positive semidefinite, rounding aside
        assert np.linalg.eigvalsh(known - unknown).min() > -1e-9 * np.abs(known).max()
        assert np.trace(known - unknown, axis1=1, axis2=2).min() > 0


def test_phasors_know_more_than_ranges_and_four_times_the_frames_halve_the_bound(cylinder):
    views = Views.broadcast(1.0, np.radians([10.0, 33.0, 80.0]))
    ranges, phasors = (cramer_rao(cylinder, views, on=on, n_frames=25).std("delta_rad") for on in ("ranges", "phasors"))
    more = cramer_rao(cylinder, views, n_frames=100).std("delta_rad")
    assert (phasors < ranges).all()
    np.testing.assert_allclose(ranges, 2 * more, rtol=1e-12)


def test_eliminating_parameters_leaves_the_corner_of_the_inverse():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 5, 8))
    information = root @ root.transpose(0, 2, 1)
    corner = np.linalg.inv(np.linalg.inv(information)[:, :2, :2])
    np.testing.assert_allclose(eliminated(information, 2), corner, rtol=1e-9)


def test_confusion_is_the_sum_of_pairwise_error_probabilities():
    # two classes at d = 2 and 4 whitened units: Q(1) + Q(2)
    assert confusion_probability([[4.0, 16.0]])[0] == pytest.approx(stats.norm.sf(1) + stats.norm.sf(2))


def test_figures_of_merit_are_right_on_gaussian_errors():
    # N = 20 000, 99.9 % intervals
    rng = np.random.default_rng(1)
    covariance = np.array([[4.0, 1.2], [1.2, 1.0]])
    error = rng.multivariate_normal([0, 0], covariance, 20_000)
    stacked = np.broadcast_to(covariance, (20_000, 2, 2))
    assert abs(rms_interval(error[:, 0] / 2.0, law="normal").value - 1) < 3.3 / math.sqrt(40_000)
    assert abs(nees(error, stacked).mean() - 2) < 3.3 * 2 / math.sqrt(20_000)
    assert abs(within_ellipsoid(error, stacked).mean() - 0.95) < 3.3 * math.sqrt(0.95 * 0.05 / 20_000)
    interval = binomial_interval(0, 500)
    assert interval.high == pytest.approx(1 - 0.025 ** (1 / 500))  # Clopper–Pearson of no success


def test_wrong_names_are_refused(cylinder):
    wrong: tuple[tuple[dict[str, Any], str], ...] = (
        ({"free": ("yaw",)}, "'free' must name"), ({"nuisances": ("floor",)}, "'nuisances' must be among"),
        ({"nuisances": ("wall_m",)}, "give 'background' a wall"), ({"pixels": "upper"}, "'pixels' must be all, lower"),
    )  # fmt: skip
    for arguments, message in wrong:
        with pytest.raises(UsageError, match=message):
            cramer_rao(cylinder, Views.broadcast(1.0), **arguments)
