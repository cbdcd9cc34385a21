"""The renderer against frames integrated from the true solids by other code (tests/golden/README.md)."""

import json
from pathlib import Path

import numpy as np
import pytest

from phasemark.landmarks import build_mesh, catalog
from phasemark.landmarks.spec import Cone
from phasemark.render import Background, Renderer, Views, preset

WRONG_IN_THE_REFERENCE = (5, 4, 6)  # frame, row, column: see the closed form below

with np.load(Path(__file__).parent / "golden" / "reference.npz") as _file:
    CASES = json.loads(str(_file["cases"]))
    PHASOR, INTENSITY, COVERAGE = _file["phasor"], _file["intensity"], _file["coverage"]

SENSOR = preset("pmd-16x16")


@pytest.fixture(scope="module")
def renderers():
    return {name: Renderer(build_mesh(spec), SENSOR) for name, spec in catalog().items()}


def view_of(case):
    return {key: case.get(key, 0.0) for key in ("distance_m", "delta_rad", "bearing_rad", "height_m")}


def render(renderers, case):
    background = Background(wall_m=case.get("wall_m"), floor_m=case.get("floor_m"))
    return renderers[case["cls"]].render(**view_of(case), background=background)


@pytest.mark.parametrize("frame", range(len(CASES)))
def test_frame_agrees_with_the_true_solid(renderers, frame):
    image = render(renderers, CASES[frame])
    compared = np.ones((16, 16), bool)
    if frame == WRONG_IN_THE_REFERENCE[0]:
        compared[WRONG_IN_THE_REFERENCE[1:]] = False
    # 1e-4 of the brightest pixel, 2e-4 of coverage: the budget of integration and tessellation together
    brightest = np.abs(PHASOR[frame]).max()
    assert np.abs(image.phasor[0] - PHASOR[frame])[compared].max() / brightest <= 1e-4
    assert np.abs(image.intensity[0] - INTENSITY[frame])[compared].max() / INTENSITY[frame].max() <= 1e-4
    assert np.abs(image.coverage[0] - COVERAGE[frame])[compared].max() <= 2e-4


def clip(polygon, axis, bound, sign):
    """Keep the part of a convex polygon where sign · (p[axis] − bound) ≥ 0."""
    kept = []
    for p, q in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        dp, dq = sign * (p[axis] - bound), sign * (q[axis] - bound)
        if dp >= 0:
            kept.append(p)
        if dp * dq < 0:
            kept.append(p + (q - p) * dp / (dp - dq))
    return np.array(kept)


def area(polygon):
    x, y = polygon.T
    return abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2


def cone_coverage_above_its_rim(case, row, col):
    """Coverage of a pixel that the cone meets well above its rim, in closed form.

    The outline of a cone is two generatrices: those whose tangent plane holds the lens. With the outward normal
    (h cos a, h sin a, r) at azimuth a and the apex at (0, 0, h), the lens (ρ, azimuth l, z) lies in the plane where
    cos(a − l) = r (h − z) / (h ρ). A straight line in space is a straight line in the image.
    """
    cone = catalog()["cone"].upper
    assert isinstance(cone, Cone)
    view = Views.broadcast(**view_of(case))
    lens = view.lens_in_landmark()[0]
    rotation, translation = (array[0] for array in view.landmark2cam())
    half = np.arccos(cone.radius_m * (cone.height_m - lens[2]) / (cone.height_m * np.hypot(*lens[:2])))
    azimuth = np.arctan2(lens[1], lens[0]) + np.array([-half, half])
    feet = np.c_[cone.radius_m * np.cos(azimuth), cone.radius_m * np.sin(azimuth), np.zeros(2)]
    x, y, z = (np.vstack([[[0, 0, cone.height_m]], feet]) @ rotation.T + translation).T
    tangent = np.tan(np.radians(11))
    outline = np.c_[8 * (1 - y / x / tangent), 8 * (1 - z / x / tangent)]
    assert outline[1:, 1].min() > row + 1  # the rim is below the pixel, so the triangle is all there is
    for axis, low in ((0, col), (1, row)):
        outline = clip(clip(outline, axis, low, 1), axis, low + 1, -1)
    return area(outline)


def test_the_pixel_left_out_is_wrong_in_the_reference_and_right_here(renderers):
    frame, row, col = WRONG_IN_THE_REFERENCE
    exact = cone_coverage_above_its_rim(CASES[frame], row, col)
    assert exact == pytest.approx(0.21645, abs=5e-6)  # the digits quoted in tests/golden/README.md
    assert abs(COVERAGE[frame, row, col] - exact) > 2e-3
    assert render(renderers, CASES[frame]).coverage[0, row, col] == pytest.approx(exact, abs=2e-4)  # tessellation


@pytest.mark.parametrize("frame", [i for i, case in enumerate(CASES) if case["cls"] == "cone"])
def test_the_reference_agrees_with_the_closed_form_in_every_other_pixel_of_the_cones_flanks(frame):
    checked = 0
    for row in range(2, 6):
        for col in range(16):
            if 0 < COVERAGE[frame, row, col] < 1 and (frame, row, col) != WRONG_IN_THE_REFERENCE:
                exact = cone_coverage_above_its_rim(CASES[frame], row, col)
                assert COVERAGE[frame, row, col] == pytest.approx(exact, abs=5e-5)  # the reference's convergence
                checked += 1
    assert checked >= 3
