"""Views of a tilted camera: conversions, images and slopes against the mount's own tilt and closed forms."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from test_slopes import PMD, TAN, WAVE, W, X, by_complex_step

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Renderer, Sensor, Views

RNG = np.random.default_rng(11)
TILTS_DEG = [(3.0, 0.0), (0.0, -11.0), (-4.0, 6.5), (7.5, 40.0)]
TILTS = [(math.radians(pitch), math.radians(roll)) for pitch, roll in TILTS_DEG]
SEEN: dict[str, Any] = dict(distance_m=1.1, delta_rad=0.7, bearing_rad=0.03, height_m=-0.02)
BACKGROUNDS = [None, Background(wall_m=4.0), Background(floor_m=0.6), Background(wall_m=2.5, floor_m=0.5)]


def turn(axis, angle):
    c, s = math.cos(angle), math.sin(angle)
    if axis == "y":
        return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def transforms(views):
    rotation, translation = views.landmark2cam()
    out = np.tile(np.eye(4), (len(views), 1, 1))
    out[:, :3, :3], out[:, :3, 3] = rotation, translation
    return out


def test_a_transform_is_the_product_of_the_rotations_of_the_equations():
    views = Views.broadcast(1.2, 0.4, 0.1, 0.05, 0.2, -0.3)
    c, s = math.cos(0.4), math.sin(0.4)
    level = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    c, s = math.cos(0.1), math.sin(0.1)
    bearing = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    tilt = turn("y", 0.2) @ turn("x", -0.3)
    rotation, translation = views.landmark2cam()
    np.testing.assert_allclose(rotation[0], tilt.T @ bearing @ level, atol=1e-15)
    np.testing.assert_allclose(translation[0], tilt.T @ (bearing @ [1.2, 0, 0] + [0, 0, 0.05]), atol=1e-15)


def test_six_numbers_and_transforms_convert_into_each_other():
    n = 2000
    views = Views.broadcast(
        RNG.uniform(0.1, 9, n), RNG.uniform(0, 2 * math.pi, n), RNG.uniform(-3.1, 3.1, n), RNG.normal(0, 1, n),
        RNG.uniform(-1.57, 1.57, n), RNG.uniform(-3.1, 3.1, n),
    )  # fmt: skip
    back = Views.from_landmark2cam(transforms(views))
    for name in ("distance_m", "bearing_rad", "height_m", "pitch_rad", "roll_rad"):
        # at a pitch of 1.57 the axis is 8e-4 from the vertical, and rounding counts a thousand times
        np.testing.assert_allclose(getattr(back, name), getattr(views, name), atol=1e-11, err_msg=name)
    np.testing.assert_allclose(np.exp(1j * back.delta_rad), np.exp(1j * views.delta_rad), atol=1e-11)
    np.testing.assert_allclose(transforms(back), transforms(views), atol=1e-11)


def test_transforms_without_one_set_of_six_numbers_are_refused():
    for pitch, roll in ((math.pi / 2, 0.4), (-math.pi / 2, 0.0)):
        with pytest.raises(UsageError, match="straight up or down"):
            Views.from_landmark2cam(transforms(Views.broadcast(1.0, 0.3, 0.1, 0.0, pitch, roll)))
    pose = np.eye(4)
    pose[2, 3] = 0.3
    with pytest.raises(UsageError, match=r"on the landmark's axis.*matrix 0"):
        Views.from_landmark2cam(pose)
    with pytest.raises(UsageError, match="must be a rotation"):
        Views.from_landmark2cam(np.diag([1.0, 2.0, 1.0, 1.0]))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [("pitch_rad", 1.6, "within ± 1.5708"), ("roll_rad", -3.2, "within ± 3.1416"), ("pitch_rad", math.nan, "finite")],
)
def test_tilts_out_of_range_are_refused(name, value, words):
    with pytest.raises(UsageError, match=f"'{name}' must be {words}"):
        Views.broadcast(1.0, **{name: value})


@pytest.mark.parametrize("tilt_deg", TILTS_DEG, ids=str)
@pytest.mark.parametrize("background", BACKGROUNDS, ids=str)
def test_a_tilted_view_shows_what_a_tilted_mount_shows(tilt_deg, background):
    mesh = build_mesh(catalog()["cone"])
    mounted = PMD.with_(pitch_deg=tilt_deg[0], roll_deg=tilt_deg[1])
    pitch, roll = np.radians(tilt_deg)
    images = [
        Renderer(mesh, PMD).render(**SEEN, pitch_rad=pitch, roll_rad=roll, background=background),
        Renderer(mesh, mounted).render(**SEEN, background=background),
    ]
    assert images[0].coverage.sum() > 0.5
    for name in ("phasor", "intensity", "coverage"):
        # both rotations are the same products of the same sines
        np.testing.assert_allclose(getattr(images[0], name), getattr(images[1], name), rtol=0, atol=1e-15)


def test_the_tilt_of_a_view_is_outside_that_of_the_mount():
    mesh = build_mesh(catalog()["cylinder"])
    pitch, roll, own_pitch, own_roll = 0.06, -0.1, -0.04, 0.15
    whole = turn("y", pitch) @ turn("x", roll) @ turn("y", own_pitch) @ turn("x", own_roll)
    # the view whose one tilt is both: its six numbers by way of the transform; the yaw left over goes into the bearing
    pose = np.eye(4)
    level = Views.broadcast(**SEEN)
    rotation, translation = level.landmark2cam()
    pose[:3, :3], pose[:3, 3] = whole.T @ rotation[0], whole.T @ translation[0]
    both = Views.from_landmark2cam(pose)
    assert abs(both.bearing_rad[0] - SEEN["bearing_rad"]) > 1e-3
    mounted = PMD.with_(pitch_deg=math.degrees(own_pitch), roll_deg=math.degrees(own_roll))
    one = Renderer(mesh, PMD).render_views(both)
    other = Renderer(mesh, mounted).render(**SEEN, pitch_rad=pitch, roll_rad=roll)
    np.testing.assert_allclose(one.phasor, other.phasor, rtol=0, atol=1e-12)


def test_a_batch_of_different_tilts_holds_the_images_of_each_alone():
    renderer, behind = Renderer(build_mesh(catalog()["post"]), PMD), Background(wall_m=3.0, floor_m=0.5)
    tilts = np.array([(0.0, 0.0), *TILTS])
    batch = renderer.render(**SEEN, pitch_rad=tilts[:, 0], roll_rad=tilts[:, 1], background=behind)
    for k, (pitch, roll) in enumerate(tilts):
        alone = renderer.render(**SEEN, pitch_rad=pitch, roll_rad=roll, background=behind)
        np.testing.assert_array_equal(batch.phasor[k], alone.phasor[0])
    np.testing.assert_array_equal(batch.phasor[0], renderer.render(**SEEN, background=behind).phasor[0])


def background_pixels(background, bearing, pitch, roll, n=48):
    """Return S of a wall and floor under a tilt, by a fine grid of Gauss points over every pixel; n even.

    Pitch and roll may be complex: sums are real analytic in them between the horizon's crossings.
    """
    x, w = np.polynomial.legendre.leggauss(n)
    x, w = (x + 1) / 2, w / 2
    u = (np.arange(16)[:, None] + x).ravel()
    y, z = TAN * (1 - u / 8)[None, :], TAN * (1 - u / 8)[:, None]
    d = [1 + 0 * y + 0 * z, y + 0 * z, z + 0 * y]
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    d = [d[0], cr * d[1] - sr * d[2], sr * d[1] + cr * d[2]]
    d = [cp * d[0] + sp * d[2], d[1], -sp * d[0] + cp * d[2]]
    length = np.sqrt(1 + y**2 + z**2)
    ahead = d[0] * math.cos(bearing) + d[1] * math.sin(bearing)
    with np.errstate(divide="ignore", invalid="ignore"):
        wall = np.where(ahead.real > 0, (background.wall_m or np.inf) / ahead, np.inf)
        floor = np.where(d[2].real < 0, -(background.floor_m or np.inf) / d[2], np.inf)
    nearer = floor.real < wall.real
    t, facing = np.where(nearer, floor, wall), np.where(nearer, -d[2], ahead)
    seen = np.isfinite(t.real)
    t = np.where(seen, t, 1.0)
    r = t * length
    light = np.where(seen, 0.5 * facing / length / r**2, 0)
    weight = np.tile(w, 16)
    parts = [light * f(WAVE * r) * weight[:, None] * weight for f in (np.cos, np.sin)]
    return tuple(part.reshape(16, n, 16, n).sum(axis=(1, 3)) for part in parts)


@pytest.mark.parametrize("tilt", [(0.03, 0.0), (0.0, 0.4), (-0.02, -0.3)], ids=str)
@pytest.mark.parametrize("background", BACKGROUNDS[1:], ids=str)
def test_wall_and_floor_stay_level_behind_a_tilted_camera(tilt, background):
    image = Renderer(None, PMD).render(1.0, bearing_rad=0.1, pitch_rad=tilt[0], roll_rad=tilt[1], background=background)
    re, im = background_pixels(background, 0.1, *tilt)
    # the oracle's points do not follow the line where wall and floor meet: 48 a pixel and side leave 1 % of a pixel
    # there, and nothing elsewhere
    mixed = background.floor_m is not None
    np.testing.assert_allclose(image.phasor[0], re + 1j * im, rtol=0, atol=(1e-2 if mixed else 1e-7) * abs(re).max())
    if mixed:
        assert np.median(np.abs(image.phasor[0] - re - 1j * im)) < 1e-6 * abs(re).max()


@pytest.mark.parametrize("name", ["pitch_rad", "roll_rad"])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.02, -0.3)], ids=str)
def test_a_wall_has_the_slopes_of_the_closed_form(name, tilt):
    background, at = Background(wall_m=3.0), dict(zip(("pitch_rad", "roll_rad"), tilt, strict=True))
    renderer = Renderer(None, PMD)
    exact = by_complex_step(
        lambda value: background_pixels(background, 0.1, **{k[:-4]: v for k, v in {**at, name: value}.items()}, n=6),
        at[name],
    )
    views = Views.broadcast(1.0, bearing_rad=0.1, **at)
    slope = renderer.render_with_slopes(views, (name,), background=background)[1][0, 0]
    jacobian = renderer.jacobian(1.0, bearing_rad=0.1, **at, parameters=(name,), background=background)[0, 0]
    for found, rounding in ((slope, 3e-7), (jacobian, 1e-9)):
        # three Gauss points a pixel and axis leave 1e-7 of S
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-6 * np.abs(exact).max() + rounding)


def tilted_plane(distance, delta, bearing, pitch, roll):
    """Return S of the plane x' = 0, albedo 0.8, where it fills the image; pitch and roll may be complex."""
    turned = bearing - delta
    nx, ny = np.cos(turned), np.sin(turned)
    u = (np.arange(16)[:, None] + (X + 1) / 2).ravel()
    y, z = TAN * (1 - u / 8)[None, :], TAN * (1 - u / 8)[:, None]
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    facing = nx * (cp + sp * (sr * y + cr * z)) + ny * (cr * y - sr * z)
    length = np.sqrt(1 + y**2 + z**2)
    r = distance * np.cos(delta) / facing * length
    light, weight = 0.8 * facing / length / r**2, np.tile(W / 2, 16)
    parts = [light * f(WAVE * r) * weight[:, None] * weight for f in (np.cos, np.sin)]
    return tuple(part.reshape(16, len(X), 16, len(X)).sum(axis=(1, 3)) for part in parts)


@pytest.mark.parametrize("name", ["pitch_rad", "roll_rad"])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.04, -0.5)], ids=str)
def test_a_plane_without_edges_has_the_slopes_of_the_closed_form(name, tilt):
    plate = trimesh.creation.box((0.01, 9, 9)).apply_translation((0.005, 0, 0))
    renderer, at = Renderer(plate, PMD), dict(zip(("pitch_rad", "roll_rad"), tilt, strict=True))
    exact = by_complex_step(
        lambda value: tilted_plane(1.4, 0.5, 0.02, **{k[:-4]: v for k, v in {**at, name: value}.items()}), at[name]
    )
    slope = renderer.render_with_slopes(Views.broadcast(1.4, 0.5, 0.02, 0.03, **at), (name,))[1][0, 0]
    jacobian = renderer.jacobian(1.4, 0.5, 0.02, 0.03, **at, parameters=(name,))[0, 0]
    for found, rounding in ((slope, 1e-7), (jacobian, 1e-9)):
        # two Gauss points a pixel and axis leave 1e-6 of S
        np.testing.assert_allclose(found, exact, rtol=0, atol=3e-6 * np.abs(exact).max() + rounding)


@pytest.mark.parametrize("height", [0.013, 0.004])
def test_a_level_edge_moves_with_the_pitch_as_the_closed_form_says(height):
    # a plate whose foot at z' = 0 alone is in the image: under a pitch p the foot at elevation e is seen at e + p
    sheet = trimesh.creation.box((1e-6, 2.0, 1.0)).apply_translation((0, 0, 0.5))
    renderer, distance = Renderer(sheet, PMD), 1.03

    def moved(pitch):
        elevation = np.arctan(height / distance) + pitch  # of the foot above the tilted axis
        edge = 8 * (1 - np.tan(elevation) / TAN)
        re, im = np.zeros((16, 16), complex), np.zeros((16, 16), complex)
        u = (X + 1) / 2
        for row in range(16):
            high = min(max(edge.real, row), row + 1) if not row < edge.real < row + 1 else edge
            v, wv = row + (high - row) * u, (high - row) * W / 2
            for col in range(16):
                y, z = TAN * (1 - (col + u) / 8)[None, :], TAN * (1 - v / 8)[:, None]
                facing, length = np.cos(pitch) + np.sin(pitch) * z, np.sqrt(1 + y**2 + z**2)
                r = distance / facing * length
                light = 0.8 * facing / length / r**2 * wv[:, None] * W / 2
                re[row, col], im[row, col] = (light * np.cos(WAVE * r)).sum(), (light * np.sin(WAVE * r)).sum()
        return re, im

    for pitch in (0.0, 0.02, -0.031):
        exact = by_complex_step(moved, pitch)
        assert np.abs(exact).max() > 2
        slope = renderer.render_with_slopes(Views.broadcast(distance, height_m=height, pitch_rad=pitch), ("pitch_rad",))
        np.testing.assert_allclose(slope[1][0, 0], exact, rtol=0, atol=1e-5 * np.abs(exact).max())


@pytest.mark.parametrize("background", BACKGROUNDS, ids=str)
@pytest.mark.parametrize("name", ["cylinder", "cone"])
def test_slopes_of_tilted_views_are_those_of_differences_of_images(name, background):
    rng, parameters = np.random.default_rng(7), ("distance_m", "delta_rad", "bearing_rad", "pitch_rad", "roll_rad")
    view = [rng.uniform(0.8, 1.6, 12), rng.uniform(0, 6, 12), *rng.normal(0, 0.04, (4, 12))]
    renderer = Renderer(build_mesh(catalog()[name]), PMD)
    images, slope = renderer.render_with_slopes(Views.broadcast(*view), parameters, background=background)
    np.testing.assert_array_equal(images.phasor, renderer.render(*view, background=background).phasor)
    differences = renderer.jacobian(*view, background=background, parameters=parameters)
    error = np.abs(slope - differences) / np.abs(differences).max(axis=(0, 2, 3))[:, None, None]
    # differences jump where an edge passes a corner of a pixel within their width; limbs as in tests/test_slopes.py
    assert np.quantile(error, 0.99) < 0.01
    assert error.max() < 0.08


@pytest.mark.parametrize("frame", range(9))
def test_tilted_cameras_with_lenses_see_what_an_integration_of_the_true_solids_does(frame):
    with np.load(Path(__file__).parent / "golden" / "lenses.npz") as file:
        case, lenses = json.loads(str(file["cases"]))[frame], json.loads(str(file["lenses"]))
        phasor, coverage, hz = file[f"phasor_{frame}"][0], file[f"coverage_{frame}"], float(file["frequencies_hz"][0])
    lens = lenses[case.pop("lens_name")]
    matrix = [[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1]]
    sensor = Sensor.from_opencv(
        matrix, lens["distortion"], size=(lens["cols"], lens["rows"]), model=lens["model"], modulation_hz=hz
    )
    planes = {name: case.pop(name, None) for name in ("wall_m", "floor_m")}
    background = Background(**planes) if any(planes.values()) else None
    image = Renderer(build_mesh(catalog()[case.pop("cls")]), sensor).render(**case, background=background)
    # a cylinder of 128 sections costs 3e-4 of the brightest pixel, and 1e-3 in coverage (PHYSICS section 3)
    np.testing.assert_allclose(image.phasor[0], phasor, rtol=0, atol=3e-4 * np.abs(phasor).max())
    np.testing.assert_allclose(image.coverage[0], coverage, rtol=0, atol=2e-3)


def test_four_slopes_are_given_unless_others_are_asked_for():
    renderer = Renderer(build_mesh(catalog()["cylinder"]), PMD)
    assert renderer.jacobian(1.0, pitch_rad=0.03).shape == (1, 4, 16, 16)
    assert renderer.render_with_slopes(Views.broadcast(1.0, pitch_rad=0.03))[1].shape == (1, 4, 16, 16)
