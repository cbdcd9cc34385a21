"""Meshes of any kind against quadtrees of rays that know no projected edges."""

import numpy as np
import pytest
from builders import ODD, lump
from oracles.images import adaptive_images
from oracles.smoothness import random_views

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Renderer, Views, preset

PMD = preset("pmd-16x16")

# Boxes a side that pixels are cut into, and the largest error of the phasor and of the coverage. The reference is good
# to 1e-5 or 2e-5 of both. On flat faces and on smooth surfaces the budget of 1e-4 holds, for bumps finer than a pixel
# with more boxes. Where a curved surface is coarsely or noisily faceted the shading is not smooth inside a pixel (the
# coarse bowl's facets are a quarter of a pixel wide, the scan's every normal has noise), and few rays feel that. Where
# noise frays the scan's outline a pixel can have more edges than can be split, and its coverage is sampled.
BUDGET = {
    "star prism": (1, 5e-5, 5e-5),
    "L bracket": (1, 5e-5, 5e-5),
    "hidden box": (1, 5e-5, 5e-5),
    "bowl": (1, 1e-4, 5e-5),
    "lump": (3, 1e-4, 5e-5),
    "blob": (1, 2e-4, 1e-4),
    "coarse bowl": (1, 5e-4, 1e-4),
    "scan": (4, 1e-3, 1e-4),
}


def errors(mesh, view, splits=1, **options):
    image = Renderer(mesh, PMD, splits=splits).render_views(view)
    phasor, intensity, coverage = adaptive_images(Renderer(mesh, PMD), view, **options)
    epsilon = np.abs(image.phasor[0] - phasor).max() / np.abs(phasor).max()
    return max(epsilon, np.abs(image.intensity[0] - intensity).max() / intensity.max()), np.abs(
        image.coverage[0] - coverage
    ).max()


def test_flat_faces_that_hide_each_other_agree_with_a_quadtree():
    epsilon, coverage = errors(ODD["hidden box"](), random_views(np.random.default_rng(3), 1), last=9)
    assert epsilon < 1e-4
    assert coverage < 1e-4


def test_bumps_finer_than_a_pixel_take_more_splits():
    mesh, view = lump(subdivisions=5), Views.broadcast(1.929, 0.254, 0.0316, 0.0044)
    phasor, _, _ = adaptive_images(Renderer(mesh, PMD), view, tolerance=3e-5, last=8)

    def epsilon(splits):
        return np.abs(Renderer(mesh, PMD, splits=splits).render_views(view).phasor[0] - phasor).max()

    assert epsilon(1) > 1e-3 * np.abs(phasor).max()  # its outline all but folds over in one pixel
    assert epsilon(2) < 2.5e-4 * np.abs(phasor).max()  # its 20 000 facets cost 1e-4 of that


def test_splits_leave_flat_faces_as_they_are_and_are_limited():
    mesh, view = ODD["hidden box"](), random_views(np.random.default_rng(5), 3)
    one, four = (Renderer(mesh, PMD.with_(fill_factor=(0.8, 0.6)), splits=n).render_views(view) for n in (1, 3))
    assert np.abs(one.phasor - four.phasor).max() < 1e-4 * np.abs(one.phasor).max()
    assert np.abs(one.coverage - four.coverage).max() < 1e-9  # exact, whatever the pieces
    for splits in (0, 5, 1.5):
        with pytest.raises(UsageError, match="whole number from 1 to 4"):
            Renderer(mesh, PMD, splits=splits)  # type: ignore[arg-type]


@pytest.mark.soak
@pytest.mark.parametrize("name", BUDGET)
def test_odd_shapes_agree_with_a_quadtree(name):
    mesh, (splits, most_epsilon, most_coverage) = ODD[name](), BUDGET[name]
    views = random_views(np.random.default_rng(4), 4)
    for i in range(len(views)):
        epsilon, coverage = errors(mesh, views[i : i + 1], splits)
        assert epsilon <= most_epsilon
        assert coverage <= most_coverage


@pytest.mark.soak
@pytest.mark.parametrize("name", list(catalog()))
def test_the_catalogue_agrees_with_a_quadtree(name):
    views = random_views(np.random.default_rng(4), 3)
    for i in range(len(views)):
        epsilon, coverage = errors(build_mesh(catalog()[name]), views[i : i + 1])
        assert epsilon <= 1e-4  # the budget
        assert coverage <= 1e-4
