"""Few and wide pixels, or fast phases: a plane before the camera, against an integral over directions."""

import math

import numpy as np
import pytest
import trimesh
from scipy.special import ndtr

from phasemark.render import Background, Body, Renderer, Scene, SceneRenderer, preset

SPEED = 299_792_458.0
WALL_M = 2.0
CAMERAS = {  # half angle (°), pixels a side, modulation (Hz), distance of the plane
    "22.5, 1": (22.5, 1, 10e6, 2.0),
    "30, 1": (30.0, 1, 10e6, 2.0),
    "45, 2": (45.0, 2, 10e6, 2.0),
    "45, 4": (45.0, 4, 10e6, 2.0),
    "75, 6": (75.0, 6, 10e6, 2.0),
    "45, 4, fast": (45.0, 4, 100e6, 6.0),
    "25, 3, far": (25.0, 3, 60e6, 8.0),
}


def camera(half_deg, pixels, hz):
    angles = {"half_angle_h_deg": half_deg, "half_angle_v_deg": half_deg}
    return preset("pmd-16x16").with_(rows=pixels, cols=pixels, modulation_hz=hz, **angles)


def plate(distance_m):
    """A plate whose front is a plane that fills every image here."""
    box = trimesh.creation.box((0.1, 200.0, 200.0))
    return Body(
        box, albedo=0.5, smooth=False, pose=trimesh.transformations.translation_matrix((distance_m + 0.05, 0, 0))
    )


def directions(sensor, n):
    """Return tangents y and z and weights of n² points in each pixel, (rows, cols, n, n)."""
    x, w = np.polynomial.legendre.leggauss(n)
    tan_h, tan_v = sensor.tan_half_angles
    row, col = (grid[..., None, None] + 0.5 for grid in np.mgrid[: sensor.rows, : sensor.cols])
    y = tan_h * (1 - 2 * (col + x / 2) / sensor.cols)
    z = tan_v * (1 - 2 * (row + x[:, None] / 2) / sensor.rows)
    return y, z, w * w[:, None] / 4


def phasors_of_plane(sensor, distance_m, n=200):
    """Integrate ρ cos θ / r² · exp(iφ) over the directions of each pixel, vignetting left out (PHYSICS, section 3)."""
    y, z, weight = directions(sensor, n)
    length = np.sqrt(1 + y**2 + z**2)
    range_m = distance_m * length
    light = 0.5 / length / range_m**2
    return (light * np.exp(4j * np.pi * sensor.frequencies_hz[0] * range_m / SPEED) * weight).sum(axis=(-1, -2))


@pytest.mark.parametrize("case", CAMERAS)
def test_a_plane_is_integrated_over_wide_pixels_and_fast_phases(case):
    half_deg, pixels, hz, distance_m = CAMERAS[case]
    sensor = camera(half_deg, pixels, hz)
    expected = phasors_of_plane(sensor, distance_m)
    body = SceneRenderer(Scene([plate(distance_m)]), sensor).phasors(np.eye(4)).phasor[0]
    assert abs(body - expected).max() <= 1e-4 * abs(expected).max()


@pytest.mark.parametrize("case", ["22.5, 1", "45, 2", "75, 6"])
def test_a_wall_and_a_landmark_fill_wide_pixels_as_exactly(case):
    half_deg, pixels, hz, distance_m = CAMERAS[case]
    sensor = camera(half_deg, pixels, hz)
    expected = phasors_of_plane(sensor, distance_m)
    beside = trimesh.transformations.translation_matrix((0, 0, 1e-4))
    speck = trimesh.creation.box((1e-4, 1e-4, 1e-4), transform=beside)  # nearly nothing stands before the wall
    wall = Background(wall_m=distance_m, wall_albedo=0.5)
    behind = Renderer(speck, sensor, albedo=0.5).render(0.5, background=wall).phasor[0]
    front = trimesh.creation.box((0.02, 100.0, 100.0))
    face = Renderer(front, sensor, albedo=0.5).render(distance_m + 0.01).phasor[0]
    for found in (behind, face):
        assert abs(found - expected).max() <= 1e-4 * abs(expected).max()


@pytest.mark.parametrize(("half_deg", "zones"), [(22.5, 1), (30.0, 1), (45.0, 2)])
def test_histograms_of_wide_zones_resolve_the_ranges_of_a_plane(half_deg, zones):
    base = preset("vl53l5cx-8x8")
    dark = {"ambient": 0.0, "dark": 0.0, "crosstalk": 0.0, "pile_up": False, "zone_scale": (1.0, 1.0), "zone_blur": 0.0}
    table = {**base.histogram.model_dump(), **dark, "light_width": None, "stray": 0.0, "bins": 200, "irf_std_m": 0.04}
    angles = {"half_angle_h_deg": half_deg, "half_angle_v_deg": half_deg}
    sensor = base.with_(rows=zones, cols=zones, histogram=table, **angles)
    found = SceneRenderer(Scene([plate(WALL_M)]), sensor).histograms(np.eye(4)).expected[0]
    y, z, weight = (part[0, 0] if part.ndim == 4 else part for part in directions(sensor, 400))
    length = np.sqrt(1 + y**2 + z**2)
    light = 0.5 / length / (WALL_M * length) ** 2 * weight
    binned = np.histogram(WALL_M * length, bins=4000, range=(1.5, 9.0), weights=light)
    middle = 0.5 * (binned[1][1:] + binned[1][:-1])
    edges = sensor.histogram.start_m + sensor.histogram.bin_width_m * np.arange(201)
    share = np.diff(ndtr((edges[:, None] - middle) / 0.04), axis=0)
    expected = share @ binned[0] * sensor.histogram.cycles * sensor.histogram.photons
    assert math.isclose(found[0, 0].sum(), expected.sum(), rel_tol=1e-4)
    assert abs(found[0, 0] - expected).max() <= 1e-3 * expected.max()
