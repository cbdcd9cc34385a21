"""The catalogue, specifications, and what tessellation costs."""

import math

import numpy as np
import pytest
from oracles.outline_coverage import coverage_of_hull, coverage_of_mesh, project

from phasemark import UsageError
from phasemark.landmarks import LandmarkSpec, build_mesh, catalog
from phasemark.landmarks.mesh import LOWER, UPPER
from phasemark.landmarks.spec import Box, Cone, Cylinder, Revolution, Sphere

BOX = Box(length_m=0.24, width_m=0.16, height_m=0.15)


def random_lenses(n, seed):
    """Return lenses 0.75 to 2 m from the axis, up to 5 cm off the interface's height, and headings up to 3° off."""
    rng = np.random.default_rng(seed)
    distance, side = rng.uniform(0.75, 2.0, n), rng.uniform(0, 2 * math.pi, n)
    lens = np.c_[-distance * np.cos(side), -distance * np.sin(side), rng.uniform(-0.05, 0.05, n)]
    return zip(lens, side + np.radians(rng.uniform(-3, 3, n)), strict=True)


def true_outline(name, lens):
    """Return points whose projections' convex hull is the outline of the true solid, dense enough for 1e-6 of a pixel.

    A sphere's outline is the circle where the tangent cone from the lens touches it; a cylinder's and a cone's are the
    hulls of their rims and tip, since central projection maps the convex hull to the convex hull.
    """
    turn = np.linspace(0, 2 * math.pi, 5_000, endpoint=False)
    circle = np.c_[np.cos(turn), np.sin(turn), np.zeros_like(turn)]
    if name == "sphere":
        centre, r = np.array([0, 0, 0.075]), 0.075
        axis = lens - centre
        d = np.linalg.norm(axis)
        axis /= d
        a = np.cross(axis, [0, 0, 1.0])
        a /= np.linalg.norm(a)
        b = np.cross(axis, a)
        radius = r * math.sqrt(1 - (r / d) ** 2)
        return centre + r**2 / d * axis + radius * (np.cos(turn)[:, None] * a + np.sin(turn)[:, None] * b)
    radius = {"cylinder": 0.06, "post": 0.035, "cone": 0.075}[name]
    top = [[0, 0, 0.15]] if name == "cone" else radius * circle + [0, 0, 0.15]
    return np.vstack([radius * circle, top])


@pytest.mark.parametrize(("n_views", "seed"), [(12, 3), pytest.param(25, 17, marks=pytest.mark.soak)])
@pytest.mark.parametrize("name", ["cylinder", "cone", "sphere", "post"])
def test_tessellation_costs_at_most_1e_4_of_a_pixel_and_leaves_the_mean_silhouette(name, n_views, seed):
    # inscribed sections would be too small from every side; the mean over views of the signed error tells
    mesh = build_mesh(catalog()[name], part="upper")
    true_radius = {"cylinder": 0.06, "cone": 0.075, "sphere": 0.075, "post": 0.035}[name]
    inscribed = mesh.copy()
    inscribed.vertices[:, :2] *= true_radius / np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]).max()
    errors = []
    for lens, heading in random_lenses(n_views, seed):
        true = coverage_of_hull(project(true_outline(name, lens), lens, heading))
        errors.append([coverage_of_mesh(each, lens, heading) - true for each in (mesh, inscribed)])
        assert np.abs(errors[-1][0]).max() <= 1e-4
    ours, theirs = np.mean([[error.sum() for error in pair] for pair in errors], axis=0)
    assert theirs < 0
    assert abs(ours) < 0.5 * abs(theirs)


@pytest.mark.parametrize("name", list(catalog()))
def test_catalogue_meshes_are_closed_outward_and_in_the_landmark_frame(name):
    mesh = build_mesh(catalog()[name])
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    np.testing.assert_allclose(mesh.bounds[:, :2], [[-0.12, -0.08], [0.12, 0.08]], atol=1e-12)
    np.testing.assert_allclose(mesh.bounds[:, 2], [-0.15, 0.15], atol=1e-5)  # the sphere is scaled by 1e-5
    part = mesh.face_attributes["part"]
    centre = mesh.triangles_center[:, 2]
    assert (centre[part == LOWER] <= 1e-12).all()
    assert (centre[part == UPPER] >= -1e-5).all()
    assert mesh.metadata == {"name": name, "symmetry": 2, "albedo": 0.8}


@pytest.mark.parametrize(
    ("upper", "volume"),
    [
        (Cylinder(radius_m=0.06, height_m=0.15), math.pi * 0.06**2 * 0.15),
        (Cone(radius_m=0.075, height_m=0.15), math.pi * 0.075**2 * 0.15 / 3),
        (Sphere(radius_m=0.075), 4 / 3 * math.pi * 0.075**3),
        (Revolution(profile_m=((0.06, 0), (0.03, 0.1))), math.pi * 0.1 / 3 * (0.06**2 + 0.06 * 0.03 + 0.03**2)),
        (None, 0.0),
    ],
)
def test_volumes_are_those_of_the_true_solids(upper, volume):
    mesh = build_mesh(LandmarkSpec(name="x", box=BOX, upper=upper))
    # the mean silhouette radius makes a polygon's area larger by π²/3N² · … < 1e-4
    assert mesh.volume == pytest.approx(0.24 * 0.16 * 0.15 + volume, rel=1e-4)


def test_parts_alone_are_closed_too_and_add_up_to_the_whole():
    spec = catalog()["cone"]
    lower, upper, both = (build_mesh(spec, part=part) for part in ("lower", "upper", "both"))
    assert lower.is_watertight
    assert upper.is_watertight
    assert lower.volume + upper.volume == pytest.approx(both.volume, rel=1e-9)


def test_a_finer_tolerance_takes_more_faces():
    spec = catalog()["cylinder"]
    counts = [len(build_mesh(spec, tolerance_m=tolerance).faces) for tolerance in (1e-4, 1e-5, 1e-6)]
    # N grows with the root of 1/tolerance; solids thinner than a pixel of that tolerance need half of it
    assert 2 < counts[1] / counts[0] < 5
    assert 2 < counts[2] / counts[1] < 5


def test_symmetry_follows_from_the_box():
    assert catalog()["cone"].symmetry == 2
    assert LandmarkSpec(name="square", box=Box(length_m=0.2, width_m=0.2, height_m=0.1), upper=None).symmetry == 4


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"box": {"length_m": -1, "width_m": 0.1, "height_m": 0.1}}, "length_m"),
        ({"albedo": 1.4}, "albedo"),
        ({"colour": "red"}, "colour"),
        ({"upper": {"kind": "pyramid"}}, "upper"),
        ({"upper": {"kind": "revolution", "profile_m": [[0.1, 0.0]]}}, "profile_m"),
    ],
)
def test_wrong_specifications_are_refused_in_one_line(fields, message):
    good = {"name": "x", "box": BOX.model_dump(), "upper": {"kind": "sphere", "radius_m": 0.05}}
    with pytest.raises(UsageError, match=message) as caught:
        LandmarkSpec(**{**good, **fields})
    assert "\n" not in str(caught.value)


def test_too_fine_a_tolerance_is_refused():
    with pytest.raises(UsageError, match="faces"):
        build_mesh(catalog()["sphere"], tolerance_m=1e-12)
