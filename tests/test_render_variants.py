"""What stands beside the area integral: centre rays, part labels, backgrounds composed later, finer cameras."""

import math
from typing import Any

import numpy as np
import pytest
from oracles.smoothness import random_views
from oracles.solids import first_hit

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, PhasorImages, Renderer, Views, preset

PMD = preset("pmd-16x16")
MESHES = {name: build_mesh(spec) for name, spec in catalog().items()}


def centre_rays(name, views, sensor):
    """Return what the centre rays meet, in closed form: range, cos θ and part, each (n, rows, cols)."""
    rotation, _ = views.landmark2cam()
    d = sensor.pixel_directions().reshape(-1, 3)
    hits = [first_hit(name, lens, d @ turn) for lens, turn in zip(views.lens_in_landmark(), rotation, strict=True)]
    shape = (len(views), sensor.rows, sensor.cols)
    return [np.stack(part).reshape(shape) for part in zip(*hits, strict=True)]


# --- centre rays ---


@pytest.mark.parametrize("name", list(catalog()))
@pytest.mark.parametrize("changes", [{}, {"pitch_deg": 2, "roll_deg": -7}], ids=str)
def test_hard_images_are_what_centre_rays_meet_in_closed_form(name, changes):
    sensor = PMD.with_(rows=48, cols=40, **changes)
    views = random_views(np.random.default_rng(5), 12)
    image = Renderer(MESHES[name], sensor, albedo=0.7).render_views(views, variant="hard")
    range_m, cos, part = centre_rays(name, views, sensor)
    hit = np.isfinite(range_m)
    assert set(np.unique(image.coverage)) == {0.0, 1.0}
    # of 23 000 rays some pass within the facets' sagitta (1e-5 m) of an edge of the solid
    differ = (image.part_labels != np.where(hit, part, 0)).sum()
    assert differ <= 10
    both = hit & (image.coverage == 1) & (image.part_labels == part) & (cos > 0.1)
    assert both.sum() > 2000
    exact = np.where(both, 0.7 * cos / np.where(hit, range_m, 1) ** 2, 0)
    np.testing.assert_allclose(image.range_m[both], range_m[both], atol=2e-4)  # sagitta of the facets over cos θ
    np.testing.assert_allclose(image.intensity[both], exact[both], rtol=2e-2)  # interpolated normals, at cos θ > 0.1
    assert np.median(np.abs(image.intensity[both] / exact[both] - 1)) < 2e-4
    np.testing.assert_allclose(image.amplitude, image.intensity, rtol=1e-12)  # one ray mixes nothing


def test_hard_images_see_the_background_where_the_centre_ray_misses():
    background = Background(wall_m=3.0, floor_m=0.25, floor_albedo=0.3)
    view: dict[str, Any] = {"distance_m": [0.9, 1.6], "delta_rad": 0.4, "bearing_rad": 0.02, "background": background}
    sensor = PMD.with_(vignetting=True)
    image = Renderer(MESHES["cone"], sensor, harmonics=(3,)).render(**view, variant="hard")
    d = sensor.pixel_directions()
    forward = d @ [math.cos(0.02), math.sin(0.02), 0]
    wall, floor = 3 / forward, np.where(d[..., 2] < 0, -0.25 / np.where(d[..., 2] < 0, d[..., 2], -1), np.inf)
    r = np.minimum(wall, floor)
    light = np.where(wall < floor, 0.5 * forward, -0.3 * d[..., 2]) / r**2 * d[..., 0] ** 4
    for k in range(2):
        free = image.coverage[k] == 0
        assert 100 < free.sum() < 250
        np.testing.assert_allclose(image.range_m[k][free], r[free], rtol=1e-12)
        np.testing.assert_allclose(image.intensity[k][free], light[free], rtol=1e-12)
        phase = np.exp(3j * r / sensor.metres_per_radian)
        np.testing.assert_allclose(image.harmonic(3)[k][free], (light * phase)[free], rtol=1e-11)


def test_a_hard_image_is_the_exact_one_of_pixels_that_shrink_to_their_centres():
    views = random_views(np.random.default_rng(6), 10)
    points = Renderer(MESHES["sphere"], PMD.with_(fill_factor=(1e-6, 1e-6))).render_views(views)
    hard = Renderer(MESHES["sphere"], PMD).render_views(views, variant="hard")
    np.testing.assert_allclose(hard.phasor, points.phasor, rtol=1e-4)  # facets change within a millionth of a pixel
    np.testing.assert_allclose(hard.upper_coverage, points.upper_coverage, atol=1e-9)


def test_rows_and_workers_do_not_change_hard_images():
    renderer, views = Renderer(MESHES["post"], PMD), random_views(np.random.default_rng(7), 150)
    whole = renderer.render_views(views, variant="hard")
    part = renderer.render_views(views, variant="hard", rows=(5, 11), workers=2)
    np.testing.assert_array_equal(part.phasor, whole.phasor[:, 5:11])
    np.testing.assert_array_equal(part.part_labels, whole.part_labels[:, 5:11])


def test_an_unknown_variant_is_refused():
    with pytest.raises(UsageError, match="'variant' must be exact or hard, got 'soft'"):
        Renderer(MESHES["post"], PMD).render(1.0, variant="soft")  # type: ignore[arg-type]


# --- parts ---


def test_labels_of_an_exact_image_name_the_largest_share():
    shares = np.array([[[0.4, 0.2, 0.6, 1.0, 0.5, 0.0]]])
    upper = np.array([[[0.1, 0.2, 0.45, 0.3, 0.5, 0.0]]])
    image = PhasorImages(shares + 0j, shares, shares, PMD, Views.broadcast(1.0), upper)
    assert image.part_labels.tolist() == [[[0, 0, 2, 1, 0, 0]]]
    with pytest.raises(UsageError, match="do not tell the landmark's parts apart"):
        _ = PhasorImages(shares + 0j, shares, shares, PMD, Views.broadcast(1.0)).part_labels


# --- a background composed later ---


@pytest.mark.parametrize(
    ("background", "typical", "largest"),
    [
        # the physics page, section 3: about 4e-4 of the brightest pixel for a wall, 2e-3 for a floor, which is seen at
        # a slant; most where the line in which wall and floor meet runs through a pixel
        (Background(wall_m=2.5), 2e-4, 4e-4),
        (Background(wall_m=4.0), 1e-4, 4e-4),
        (Background(floor_m=0.25), 3e-3, 6e-3),
        (Background(wall_m=4.0, floor_m=0.25), 3e-3, 5e-2),
    ],
    ids=["wall at 2.5 m", "wall at 4 m", "floor", "wall and floor"],
)
def test_a_composed_background_agrees_with_a_rendered_one(background, typical, largest):
    views = random_views(np.random.default_rng(8), 40)
    behind = Renderer(None, PMD).render_views(views, background=background)
    errors = []
    for mesh in MESHES.values():
        renderer = Renderer(mesh, PMD)
        composed = renderer.render_views(views).composed_with(behind)
        full = renderer.render_views(views, background=background)
        errors.append(np.abs(composed.phasor - full.phasor).max(axis=(1, 2)) / np.abs(full.phasor).max(axis=(1, 2)))
        assert (np.abs(composed.intensity - full.intensity) <= largest * full.intensity.max()).all()
        np.testing.assert_allclose(composed.coverage, full.coverage, atol=1e-14)  # the floor's line splits pixels
    assert np.median(errors) <= typical
    assert np.max(errors) <= largest


def test_composition_takes_one_background_for_each_view_and_harmonics():
    renderer, empty = Renderer(MESHES["cone"], PMD, harmonics=(3,)), Renderer(None, PMD, harmonics=(3, 5))
    view: dict[str, Any] = {"distance_m": [0.9, 1.4], "bearing_rad": [0.0, 0.05], "background": Background(wall_m=4.0)}
    composed = renderer.render(view["distance_m"], 0.0, view["bearing_rad"]).composed_with(empty.render(**view))
    full = renderer.render(**view)
    assert list(composed.harmonics) == [3]
    for order in (1, 3):
        largest = np.abs(full.harmonic(order)).max()
        np.testing.assert_allclose(composed.harmonic(order), full.harmonic(order), atol=order * 4e-4 * largest)


def test_backgrounds_of_another_camera_or_number_are_refused():
    image = Renderer(MESHES["cone"], PMD).render([0.9, 1.0, 1.1])
    with pytest.raises(UsageError, match=r"another camera: 'modulation_hz' is"):
        image.composed_with(Renderer(None, PMD.with_(modulation_hz=2e7)).render(1.0, background=Background(wall_m=2)))
    with pytest.raises(UsageError, match="'behind' must hold 1 or 3 images of the same rows, got 2"):
        image.composed_with(Renderer(None, PMD).render([1.0, 2.0]))


# --- fallbacks, and finer cameras ---


def test_next_to_no_pixel_of_the_catalogue_needs_a_fallback():
    views = random_views(np.random.default_rng(9), 100)
    for mesh in MESHES.values():
        renderer = Renderer(mesh, PMD)
        image = renderer.render_views(views, background=Background(wall_m=4.0, floor_m=0.21))
        assert renderer.untrusted_pixels <= 1e-3 * image.phasor.size
