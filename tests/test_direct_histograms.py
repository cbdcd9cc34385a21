"""Histograms of direct sensors against quadrature by other code, and closed forms of pile-up (PHYSICS section 11)."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from oracles import transients as oracle

from phasemark import UsageError
from phasemark.render import Sensor
from phasemark.render.direct.bin_counts import expected_counts, piled_up, response_share, without_pile_up
from phasemark.render.direct.footprints import footprint_grid
from phasemark.render.direct.transients import range_axis, zone_transients
from phasemark.render.integral.scene_samples import SceneMesh, SceneSamples, plane_samples
from phasemark.render.sensor import Histogram

IRF_STD_M = 0.02
HISTOGRAM = {
    "bins": 128,
    "bin_width_m": 0.0137,
    "cycles": 1e6,
    "photons": 0.01,
    "irf_std_m": IRF_STD_M,
    "pile_up": False,
}


def direct_sensor(rows: int = 3, cols: int = 3, **changes: object) -> Sensor:
    return Sensor(
        kind="direct", rows=rows, cols=cols, half_angle_h_deg=16, half_angle_v_deg=16, modulation_hz=1e3,
        histogram={**HISTOGRAM, **changes},
    )  # fmt: skip


def zone_borders(sensor: Sensor) -> list[tuple[float, float, float, float]]:
    tan_h, tan_v = sensor.tan_half_angles
    width, height = 2 * tan_h / sensor.cols, 2 * tan_v / sensor.rows
    scale = sensor.histogram.zone_scale
    borders = []
    for r in range(sensor.rows):
        for c in range(sensor.cols):
            y, z = tan_h - (c + 0.5) * width, tan_v - (r + 0.5) * height
            half_y, half_z = 0.5 * width * scale[0], 0.5 * height * scale[1]
            borders.append((y - half_y, y + half_y, z - half_z, z + half_z))
    return borders


def counts_of(samples: SceneSamples, sensor: Sensor) -> np.ndarray:
    axis = range_axis(sensor)
    return np.asarray(expected_counts(zone_transients(samples, sensor, axis), sensor, axis)[0])


def oracle_counts(scene: oracle.Hit, sensor: Sensor, points: int = 600) -> np.ndarray:
    h = sensor.histogram
    edges = np.asarray(h.start_m + h.bin_width_m * np.arange(h.bins + 1), dtype=np.float64)
    scale = h.cycles * h.photons
    return scale * np.stack(
        [oracle.histogram(scene, zone, edges, h.irf_std_m, points) for zone in zone_borders(sensor)]
    )


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> trimesh.Trimesh:
    low, high = np.array([x[0], y[0], z[0]]), np.array([x[1], y[1], z[1]])
    made = trimesh.creation.box(high - low, trimesh.transformations.translation_matrix((low + high) / 2))
    assert isinstance(made, trimesh.Trimesh)
    return made


@pytest.mark.parametrize("scale", [(1.0, 1.0), (1.25, 1.5)])
def test_histogram_of_two_planes_is_that_of_dense_quadrature(scale: tuple[float, float]) -> None:
    sensor = direct_sensor(zone_scale=scale)
    edge = 0.0123  # crosses the middle column between cell borders
    near, far = 0.6, 0.9
    # the near plate ends where its front's edge is seen at the tangent `edge`
    scene = trimesh.util.concatenate(
        [box((near, near + 1e-3), (-3, near * edge), (-3, 3)), box((far, far + 1e-3), (-3, 3), (-3, 3))]
    )
    assert isinstance(scene, trimesh.Trimesh)
    got = counts_of(SceneMesh(scene).samples(np.eye(4), footprint_grid(sensor)), sensor)
    want = oracle_counts(oracle.half_plane_before(near, far, edge), sensor, points=1200)
    assert np.abs(got - want).max() < 1e-3 * want.max()  # the bar


@pytest.mark.parametrize(
    ("rows", "scale", "tilt", "points"),
    [
        (3, 1.0, (0.0, 0.0), 600),
        (3, 1.0, (0.7, -0.4), 600),
        (4, 1.0, (0.5, 0.3), 200),
        (8, 1.0, (0.5, 0.3), 200),
        (8, 1.3, (0.5, 0.3), 200),
        (16, 1.0, (0.5, 0.3), 200),
    ],
)
def test_histogram_of_a_tilted_plane_is_that_of_dense_quadrature(
    rows: int, scale: float, tilt: tuple[float, float], points: int
) -> None:
    sensor = direct_sensor(rows, rows, zone_scale=(scale, scale))
    want = oracle_counts(oracle.plane(0.5, tilt), sensor, points)
    got = counts_of(plane_samples(0.5, footprint_grid(sensor), tilt), sensor)
    assert np.abs(got - want).max() < 1e-3 * want.max()


def test_histogram_of_a_sphere_is_that_of_dense_quadrature() -> None:
    sensor = direct_sensor()
    centre, radius = (0.5, 0.02, -0.01), 0.12
    ball = trimesh.creation.icosphere(subdivisions=6, radius=radius)
    place = np.eye(4)
    place[:3, 3] = centre
    got = counts_of(SceneMesh(ball).samples(place, footprint_grid(sensor)), sensor)
    want = oracle_counts(oracle.sphere(centre, radius), sensor, points=1500)
    assert np.abs(got - want).max() < 1e-3 * want.max()


def test_response_of_samples_tends_to_the_gaussian_that_they_sample() -> None:
    step = 0.002
    x = np.arange(-60, 61) * step
    sampled = Histogram(
        **{k: v for k, v in HISTOGRAM.items() if k != "irf_std_m"},
        irf=(tuple(np.exp(-0.5 * (x / IRF_STD_M) ** 2)),), irf_start_m=x[0], irf_step_m=step,
    )  # fmt: skip
    delay = np.linspace(-0.1, 0.1, 77)
    # piecewise linear: h²/12 of a step of a tenth of the standard deviation broadens by 4e-4
    assert np.abs(response_share(delay, sampled) - response_share(delay, Histogram(**HISTOGRAM))).max() < 4e-4


def test_pile_up_is_the_law_of_the_first_photon() -> None:
    rates = np.array([0.02, 0.0, 0.5, 0.3, 1.2, 0.05])
    cycles = 1e6
    n = 400_000  # simulated cycles
    rng = np.random.default_rng(20)
    hit = rng.poisson(rates, (n, len(rates))) > 0
    first = np.where(hit.any(axis=1), hit.argmax(axis=1), len(rates))
    seen = np.bincount(first, minlength=len(rates) + 1)[:-1] / n
    law = piled_up(rates * cycles, cycles) / cycles
    recursive = np.zeros(len(rates))
    for j, rate in enumerate(rates):
        recursive[j] = (1 - recursive.sum()) * (1 - np.exp(-rate))
    np.testing.assert_allclose(law, recursive, rtol=1e-12)  # the two forms of PHYSICS 11 are one
    sigma = np.sqrt(law * (1 - law) / n)
    assert (np.abs(seen - law) <= 3 * sigma + 1e-12).all()


def test_pile_up_can_be_undone_until_the_histogram_is_saturated() -> None:
    rng = np.random.default_rng(4)
    counts = rng.uniform(0, 2e4, (3, 128))
    np.testing.assert_allclose(without_pile_up(piled_up(counts, 1e6), 1e6), counts, rtol=1e-9)
    with pytest.raises(UsageError, match="it is saturated"):
        without_pile_up(np.full(128, 1e4), 1e6)


def test_pile_up_moves_the_centroid_by_a_quarter_of_the_mean_difference() -> None:
    # to first order in the photons a cycle x, the centroid moves by −x/2 times half Gini's mean difference, σ/√π
    edges = np.arange(201) * 0.002
    sensor = Histogram(**{**HISTOGRAM, "bins": 200, "bin_width_m": 0.002})
    share = np.diff(response_share(edges - 0.2, sensor))
    middle = 0.5 * (edges[1:] + edges[:-1])
    x = 0.01
    piled = piled_up(share * x * 1e6, 1e6)
    shift = (piled @ middle) / piled.sum() - share @ middle
    assert shift == pytest.approx(-x * IRF_STD_M / (2 * np.sqrt(np.pi)), rel=0.02)  # higher orders: x/2
