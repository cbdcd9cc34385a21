"""Light that bounces, against closed forms, other integrals and a foreign path tracer (PHYSICS section 12)."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Body, Scene, SceneRenderer, preset
from phasemark.render.bounces import bounced_light
from phasemark.render.bounces.form_factors import triangle_form_factors
from phasemark.render.bounces.patches import Patches, make_patches
from phasemark.render.bounces.transport import Transport, transport_between
from phasemark.render.scene import scene_renderer
from phasemark.render.scene.assembly import Assembly
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.sensor_quantities import SPEED_OF_LIGHT_M_S

GOLDEN = Path(__file__).parent / "golden" / "multipath.npz"
PMD = preset("pmd-16x16")
ROOM_CAMERA = PMD.with_(rows=4, cols=4, half_angle_h_deg=20, half_angle_v_deg=20, lamp_half_angle_deg=45)


def _pose(at: tuple[float, float, float], normal: tuple[float, float, float] = (0, 0, 1)) -> NDArray[np.float64]:
    """Return a pose at a point, z along a normal."""
    pose = np.asarray(trimesh.geometry.align_vectors([0, 0, 1], normal), np.float64)
    pose[:3, 3] = at
    return pose


def _exchanged(bodies: list[Body], size_m: float) -> tuple[Patches, Transport]:
    topology = Assembly(bodies, "auto", solids=False).topology
    sizes = lambda points, normals: np.full(len(points), size_m)  # noqa: E731
    patches = make_patches(topology, sizes)
    return patches, transport_between(patches)


def _form_factor(patches: Patches, transport: Transport, receiver: int, sender: int) -> float:
    """Return the form factor of one body from another, a mean over the receiver."""
    from_sender = transport.operator(0.0) @ (patches.body == sender)
    own = patches.body == receiver
    return float((patches.area * from_sender)[own].sum() / patches.area[own].sum())


def test_a_triangles_form_factor_is_the_integral_of_the_cosines_over_the_square_of_the_distance() -> None:
    rng = np.random.default_rng(5)
    n, fine = 20, 300
    triangles = rng.uniform(-1, 1, (n, 3, 3)) + np.array([0, 0, 0.8])  # some reach below the horizon z = 0
    points, normals = np.zeros((n, 3)), np.tile([0.0, 0.0, 1.0], (n, 1))
    u, v = np.meshgrid(*[(np.arange(fine) + 0.5) / fine] * 2)
    s, t = 1 - np.sqrt(u), v * np.sqrt(u)  # even over a triangle
    for triangle, point, normal, found in zip(
        triangles, points, normals, triangle_form_factors(points, normals, triangles), strict=True
    ):
        a, b, c = triangle
        across = np.cross(b - a, c - a)
        to = a + s[..., None] * (b - a) + t[..., None] * (c - a) - point
        d2 = (to**2).sum(axis=-1)
        value = np.maximum(to @ normal, 0) * np.maximum(-to @ across, 0) / (math.pi * d2**2)
        assert found == pytest.approx(0.5 * value.mean(), abs=2e-4)  # the sum's own error where the triangle is near


@pytest.mark.parametrize("gap", [0.5, 1.0])
def test_parallel_squares_exchange_their_known_form_factor(gap: float) -> None:
    x = 1 / gap
    y = math.sqrt(1 + x * x)
    logarithm = math.log(y * y / math.sqrt(1 + 2 * x * x))
    known = 2 / (math.pi * x * x) * (logarithm + 2 * x * y * math.atan(x / y) - 2 * x * math.atan(x))
    patches, transport = _exchanged([Body.plane((1, 1)), Body.plane((1, 1), pose=_pose((0, 0, gap)))], 0.1)
    assert _form_factor(patches, transport, 0, 1) == pytest.approx(known, abs=1e-4)
    assert _form_factor(patches, transport, 1, 0) == pytest.approx(known, abs=1e-4)


def test_perpendicular_squares_that_touch_exchange_their_known_form_factor() -> None:
    wall = Body.plane((1, 1), pose=_pose((0.5, 0, 0.5), (-1, 0, 0)))
    patches, transport = _exchanged([Body.plane((1, 1)), wall], 0.08)
    known = 0.2000438
    assert _form_factor(patches, transport, 0, 1) == pytest.approx(known, abs=1e-4)
    assert _form_factor(patches, transport, 1, 0) == pytest.approx(known, abs=1e-4)


def _hollow_sphere(radius_m: float, albedo: float, subdivisions: int) -> Body:
    """Return an icosphere seen from inside, with the area of the sphere."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    ball.vertices *= radius_m * math.sqrt(4 * math.pi / ball.area)
    return Body(trimesh.Trimesh(ball.vertices, ball.faces[:, ::-1], process=False), albedo, "sphere", smooth=False)


def test_a_floor_has_small_patches_beside_a_box_that_stands_on_it() -> None:
    box = Body.box((0.31, 0.23, 0.2), pose=_pose((0.1, 0, 0.1)))
    topology = Assembly([Body.plane((2, 2)), box], "auto", solids=False).topology
    half = np.array([0.155, 0.115])

    def sizes(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
        away = np.linalg.norm(np.maximum(np.abs(points[:, :2] - [0.1, 0]) - half, 0), axis=1)
        return np.where(away > 0, np.clip(0.5 * away, 0.03, 0.3), 0.3)  # large below the box

    patches = make_patches(topology, sizes)
    beside = patches.body == 0
    assert patches.area[beside].sum() == pytest.approx(4 - 0.31 * 0.23, rel=1e-6)
    assert (patches.size[beside] <= 1.5 * sizes(patches.centre[beside], patches.normal[beside])).all()


def test_slopes_of_a_cone_extrapolate_little_over_its_patches() -> None:
    """About the apex the neighbours of a long patch lie in a row across it."""
    cone = build_mesh(catalog()["cone"])
    patches, transport = _exchanged([Body(cone, 0.8, "cone")], 0.28)
    own = np.repeat(np.arange(len(patches)), np.diff(patches.first))
    offset = patches.facets.corners[patches.members] - patches.centre[own, None]
    slopes = np.stack([axis.toarray() for axis in transport.slopes])[:, own]
    at_corners = np.abs(np.einsum("anp,nca->ncp", slopes, offset)).sum(axis=2)
    assert at_corners.max() < 10  # for values of ± 1 at the neighbours; 110 with slopes across the row


@pytest.mark.parametrize(
    ("turn", "albedo", "change", "subdivisions", "tolerance"),
    [
        (0.5, 0.3, 3e-4, 4, 3e-4),
        pytest.param(0.5, 0.3, 3e-4, 5, 1e-4, marks=pytest.mark.soak),
        pytest.param(3.0, 0.8, 5e-4, 5, 5e-4, marks=pytest.mark.soak),
    ],
)
def test_a_sphere_around_lamp_and_lens_returns_its_closed_form(
    turn: float, albedo: float, change: float, subdivisions: int, tolerance: float
) -> None:
    radius = 0.7
    hz = turn / radius * SPEED_OF_LIGHT_M_S / (2 * math.pi)
    sensor = ROOM_CAMERA.with_(modulation_hz=hz, lamp_half_angle_deg=180)
    scene = Scene([_hollow_sphere(radius, albedo, subdivisions)])
    images = SceneRenderer(scene, sensor, bounces="all", bounce_tolerance=change).phasors(np.eye(4))
    for found, k in ((images.phasor[0], turn), (images.intensity[0], 0.0)):
        # mean of exp(i k d / R) over all chords, d / (2 R²) each
        d = (np.arange(20000) + 0.5) / 10000
        chord = (d / 2 * np.exp(1j * k * d)).sum() / 10000
        known = albedo / radius**2 * np.exp(2j * k) / (1 - albedo * chord)
        assert np.abs(found / known - 1).max() < tolerance


def test_one_bounce_of_a_floor_onto_a_wall_is_the_integral_over_the_floor() -> None:
    low, ahead, hz = 0.3, 1.2, 20e6
    sensor = PMD.with_(
        rows=2,
        cols=3,
        half_angle_h_deg=8,
        half_angle_v_deg=6,
        lamp_half_angle_deg=40,
        lamp_profile=2.0,
        modulation_hz=hz,
    )
    floor = Body.plane((1.6, 3), albedo=0.5, pose=_pose((0.4, 0, -low)), name="floor")
    wall = Body.plane((3, 3), albedo=0.7, pose=_pose((ahead, 0, 1.5 - low), (-1, 0, 0)), name="wall")
    scene, kappa = Scene([floor, wall]), 2 * math.pi * hz / SPEED_OF_LIGHT_M_S
    one, none = (
        SceneRenderer(scene, sensor, bounces=k, bounce_tolerance=1e-3).phasors(np.eye(4)).phasor[0] for k in (1, 0)
    )
    x, y = np.meshgrid(-0.4 + 1.6 * (np.arange(600) + 0.5) / 600, 3 * ((np.arange(800) + 0.5) / 800 - 0.5))
    r = np.sqrt(x * x + y * y + low * low)
    lit = 0.5 * (x / r) ** 2 * (low / r) / r**2 * (x / r > math.cos(math.radians(40))) * np.exp(1j * kappa * r)
    known = np.zeros((2, 3), np.complex128)
    nodes, weights = np.polynomial.legendre.leggauss(2)
    for row, col in np.ndindex(2, 3):
        for (i, wi), (j, wj) in product(zip(nodes, weights, strict=True), repeat=2):
            left, up = sensor.tangents(col + 0.5 + i / 2, row + 0.5 + j / 2)
            point = ahead * np.array([1.0, float(left), float(up)])
            dx, dy, dz = ahead - x, point[1] - y, point[2] + low
            d2 = dx * dx + dy * dy + dz * dz
            arrives = (lit * dz * dx / d2**2 * np.exp(1j * kappa * np.sqrt(d2))).mean() * 1.6 * 3 / math.pi
            known[row, col] += wi * wj / 4 * 0.7 * arrives * np.exp(1j * kappa * np.linalg.norm(point))
    error = np.abs(one - none - known).max() / np.abs(none).max()
    assert error < 1e-3


def _corner() -> tuple[list[Body], Sensor]:
    """Return floor, wall and side of a corner, and a box before them."""
    bodies = [
        Body.plane((2, 2), albedo=0.4, pose=_pose((0.5, 0, -0.4)), name="floor"),
        Body.plane((2, 2), albedo=0.6, pose=_pose((1.5, 0, 0.6), (-1, 0, 0)), name="wall"),
        Body.box((0.2, 0.3, 0.4), albedo=0.8, pose=_pose((1.0, 0.1, -0.2)), name="box"),
    ]
    return bodies, ROOM_CAMERA.with_(modulation_hz=20e6)


def test_the_polynomial_in_an_albedo_is_the_frame_at_every_albedo() -> None:
    bodies, sensor = _corner()
    powers = SceneRenderer(Scene(bodies), sensor, bounces="all").albedo_powers("floor", np.eye(4))
    for albedo in (0.0, 0.9):
        own = [Body.plane((2, 2), albedo=albedo, pose=bodies[0].pose, name="floor"), *bodies[1:]]
        # patches follow the light, which another albedo changes: the tolerance's error of both
        frame = SceneRenderer(Scene(own), sensor, bounces="all").phasors(np.eye(4))
        total = sum(albedo**k * image.phasor for k, image in enumerate(powers))
        assert np.abs(total - frame.phasor).max() < 4e-3 * np.abs(frame.phasor).max()
    assert len(powers) > 3


def test_light_between_two_patches_is_the_same_both_ways() -> None:
    patches, transport = _exchanged(_corner()[0], 0.3)
    one, other = (transport.form_factor * patches.area[np.column_stack([transport.one, transport.other])]).T
    # closed forms of close pairs are means over four points of the receiver
    assert np.abs(one - other).sum() < 0.02 * (one + other).sum()


def test_half_as_large_patches_change_what_the_tolerance_says() -> None:
    bodies, sensor = _corner()
    coarse, fine = (
        SceneRenderer(Scene(bodies), sensor, bounces="all", bounce_tolerance=tolerance).phasors(np.eye(4)).phasor
        for tolerance in (4e-3, 1e-3)
    )
    change = np.sqrt(np.mean(np.abs(coarse - fine) ** 2)) / np.abs(fine).max()
    assert change < 4e-3


def test_a_closed_room_returns_no_more_than_all_light() -> None:
    room = trimesh.creation.box((2, 3, 1.5))
    walls = Body(trimesh.Trimesh(room.vertices, room.faces[:, ::-1], process=False), 0.5, "room")
    patches, transport = _exchanged([walls, Body.box((0.4, 0.3, 0.2), pose=_pose((0.3, 0.2, -0.65)))], 0.3)
    received = transport.operator(0.0) @ np.ones(len(patches))
    assert received.max() <= 1 + 1e-12
    inside = received > 0
    shares = (patches.area * received)[inside].sum() / patches.area[inside].sum()
    assert shares == pytest.approx(1, abs=5e-3)  # visibility by few rays where the box stands


@pytest.mark.parametrize("name", ["floor_wall", *(pytest.param(n, marks=pytest.mark.soak) for n in ("corner", "box"))])
def test_extra_light_is_that_of_a_foreign_path_tracer(name: str) -> None:
    scene, sensor, known = _reference(name)
    direct = SceneRenderer(scene, sensor).phasors(np.eye(4)).phasors[0]
    for bounces, key in ((1, "bounces_1"), (2, "bounces_2"), ("all", "all")):
        images = SceneRenderer(scene, sensor, bounces=bounces, bounce_tolerance=1.5e-3).phasors(np.eye(4))  # type: ignore[arg-type]
        brightest = np.abs(known["direct_quadrature_S"]).max(axis=(1, 2), keepdims=True)
        error = np.abs(images.phasors[0] - direct - known[f"{key}_minus_direct_S"])
        beyond = np.maximum(error - 4 * known[f"{key}_minus_direct_S_se"], 0) / brightest
        assert np.quantile(beyond, 0.9) < 1.5e-3
        assert beyond.max() < (8e-3 if name == "box" else 2.5e-3)  # pixels at the foot of the box


def _reference(name: str) -> tuple[Scene, Sensor, dict[str, Any]]:
    """Return a scene of the reference, its camera, and its arrays."""
    with np.load(GOLDEN) as file:
        arrays = {key.removeprefix(f"{name}/"): file[key] for key in file.files if key.startswith(f"{name}/")}
    about = json.loads(str(arrays["description"]))
    bodies = []
    for k, body in enumerate(about["bodies"]):
        mesh = trimesh.Trimesh(arrays[f"vertices_{k}"], arrays[f"faces_{k}"], process=False)
        bodies.append(Body(mesh, body["albedo"], body["name"], smooth=False))
    sensor = PMD.with_(
        **about["camera"], modulation_hz=tuple(about["hz"]), lamp_half_angle_deg=about["lamp_half_angle_deg"]
    )
    return Scene(bodies), sensor, arrays


def test_light_bounces_only_to_faces_that_something_lies_before() -> None:
    sensor = preset("pmd-16x16").with_(lamp_half_angle_deg=40)
    wall = Body.plane((6, 6), albedo=0.5, pose=_pose((1, 0.2, 0), (-0.98, -0.2, 0)), name="wall")
    box = Body(trimesh.creation.box((0.2, 0.2, 0.3)), 0.8, "box")
    camera = trimesh.transformations.rotation_matrix(math.atan2(0.2, 0.98), [0, 0, 1])
    camera[:3, 3] = -0.98, -0.2, 0
    for bodies in ([box, wall], [box], [wall]):
        scene = Scene(bodies)
        image, direct = (SceneRenderer(scene, sensor, bounces=k).phasors(camera) for k in (1, 0))
        extra = np.abs(image.phasor - direct.phasor)[0] / np.abs(direct.phasor).max()
        # the front of the box looks away from the wall, its side and the wall see one another
        assert extra[6:10, 4:10].max() == 0
        assert (extra.max() > 1e-3) == (len(bodies) == 2)


def test_a_lamp_that_fades_dims_direct_light_and_even_light_is_that_of_no_lamp() -> None:
    bodies, sensor = _corner()
    plain, even, fading, sampled = (
        SceneRenderer(Scene(bodies), sensor.with_(lamp_half_angle_deg=angle, lamp_profile=profile)).phasors(np.eye(4))
        for angle, profile in (
            (None, 0.0), (45, 0.0), (45, 3.0), (45, tuple((a, math.cos(math.radians(a)) ** 3) for a in range(0, 46)))
        )
    )  # fmt: skip
    assert plain.phasor.tobytes() == even.phasor.tobytes()
    assert plain.intensity.tobytes() == even.intensity.tobytes()
    cosine = sensor.axis_cosine()
    assert np.allclose(fading.intensity / plain.intensity, cosine**3, rtol=0.06)  # varies over a pixel of 10°
    assert np.allclose(sampled.intensity, fading.intensity, rtol=3e-4)  # linear between degrees


def test_light_of_a_pose_does_not_depend_on_others_that_look_away_and_black_bodies_return_none() -> None:
    bodies, sensor = _corner()
    away = np.diag([-1.0, -1.0, 1.0, 1.0])
    alone = SceneRenderer(Scene(bodies), sensor, bounces=1, bounce_tolerance=1e-2).phasors(np.eye(4)).phasor[0]
    both = SceneRenderer(Scene(bodies), sensor, bounces=1, bounce_tolerance=1e-2).phasors([away, np.eye(4)]).phasor
    assert not both[0].any()
    assert np.abs(both[1] - alone).max() < 1e-2 * np.abs(alone).max()
    black = Scene([replace(body, albedo=0.0) for body in bodies])
    assert not SceneRenderer(black, sensor, bounces=1, bounce_tolerance=1e-2).phasors(np.eye(4)).phasor.any()


def test_a_floor_beyond_the_lamp_s_light_changes_nothing_of_one_bounce() -> None:
    camera, found = PMD.with_(lamp_half_angle_deg=20), []
    for width_m in (4, 2000):
        bodies = [
            Body.plane((width_m, width_m), pose=_pose((1, 0, -0.15)), albedo=0.5),
            Body.plane((2, 2), pose=_pose((2, 0, 0.85), (-1, 0, 0)), albedo=0.5),
            Body.box((0.16, 0.24, 0.25), pose=_pose((1, 0, -0.025)), albedo=0.8),
        ]
        found += [SceneRenderer(Scene(bodies), camera, bounces=k).phasors(np.eye(4)).phasor[0] for k in (0, 1)]
    change = found[3] - found[2] - (found[1] - found[0])
    assert np.sqrt(np.mean(np.abs(change) ** 2)) < 3e-4 * np.abs(found[0]).max()


def test_bounces_that_cannot_be_computed_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    bodies, sensor = _corner()
    scene = Scene(bodies)
    with pytest.raises(UsageError, match=r"'bounces' must be 0, 1, 2, … or 'all', got -1"):
        SceneRenderer(scene, sensor, bounces=-1)
    with pytest.raises(UsageError, match="needs the sensor's 'lamp_half_angle_deg'"):
        SceneRenderer(scene, sensor.with_(lamp_half_angle_deg=None), bounces=1)
    with pytest.raises(UsageError, match="'bounces' must be 0 for this sensor"):
        SceneRenderer(scene, preset("vl53l5cx-8x8"), bounces=1)
    with pytest.raises(UsageError, match=r"must be at least 27\.24, the angle of the image's farthest corner"):
        sensor.with_(lamp_half_angle_deg=25)
    monkeypatch.setattr(bounced_light, "_LAST", 0.19)
    with pytest.raises(UsageError, match=r"between \d+ patches and half as many: 'bounce_tolerance' must be at least"):
        SceneRenderer(Scene(bodies[:2]), sensor, bounces=1, bounce_tolerance=1e-12).phasors(np.eye(4))
    with pytest.raises(UsageError, match=r"takes up to .* GiB"):
        _exchanged([Body.plane((1, 1)), Body.plane((1, 1), pose=_pose((0, 0, 1)))], 0.012)
    with pytest.raises(UsageError, match="in a closed scene albedos must be below 1"):
        SceneRenderer(Scene([_hollow_sphere(1.0, 1.0, 2)]), sensor, bounces="all", bounce_tolerance=0.1).render(
            np.eye(4)
        )


def test_light_bounces_off_shells_of_one_mesh_that_touch_as_off_bodies_apart() -> None:
    bodies, sensor = _corner()
    apart = SceneRenderer(Scene(bodies), sensor, bounces=2).phasors(np.eye(4))
    corners = [trimesh.transform_points(body.mesh.vertices, body.pose) for body in bodies]
    meshes = [trimesh.Trimesh(v, body.mesh.faces, process=False) for v, body in zip(corners, bodies, strict=True)]
    albedo = np.concatenate([np.full(len(body.mesh.faces), body.albedo) for body in bodies])
    concatenated: Any = trimesh.util.concatenate(meshes)
    for one in (Body.joined(bodies), Body(concatenated, albedo)):
        whole = SceneRenderer(Scene([replace(one, name="one")]), sensor, bounces=2)
        found = whole.phasors(np.eye(4))
        brightest = np.abs(apart.phasor).max()
        np.testing.assert_allclose(found.phasor, apart.phasor, atol=6e-4 * brightest)  # twice the tolerance
        powers = np.sum([image.phasor for image in whole.albedo_powers("one", np.eye(4))[1:]])
        assert abs(powers) > 0  # the albedo of all its shells is free


def test_a_plate_on_the_middle_of_a_floor_parts_the_light_on_it() -> None:
    """A floor with a seam below the plate is cut there in any case."""
    sensor = _corner()[1]
    plate = Body.plane((0.3, 0.3), albedo=0.9, pose=_pose((1.2, 0.0, -0.25), (-1, 0, 0)), name="plate")
    whole = [Body.plane((2, 2), albedo=0.4, pose=_pose((1.0, 0, -0.4)), name="floor")]
    seam = [
        Body.plane((length, 2), albedo=0.4, pose=_pose((x, 0, -0.4)), name=f"floor {x}")
        for x, length in ((0.6, 1.2), (1.6, 0.8))
    ]
    one, two = (SceneRenderer(Scene([*floor, plate]), sensor, bounces=2).phasors(np.eye(4)) for floor in (whole, seam))
    np.testing.assert_allclose(one.phasor, two.phasor, atol=3e-3 * np.abs(two.phasor).max())


def test_light_bounces_off_the_union_of_joined_bodies(monkeypatch: pytest.MonkeyPatch) -> None:
    turned = trimesh.transformations.rotation_matrix(0.4, [0, 0, 1])
    turned[:3, 3] = 0.02, 0.05, 0.03
    parts = [Body.box((0.3, 0.2, 0.2), albedo=0.7), Body.box((0.15, 0.4, 0.15), albedo=0.7, pose=turned)]
    pose = trimesh.transformations.translation_matrix([1.2, 0, 0])
    joined = replace(Body.joined(parts), pose=pose)
    mesh = Body(trimesh.Trimesh(joined.mesh.vertices, joined.mesh.faces, process=False), 0.7, pose=pose)
    seen = []

    def record(topology: Any, *_: Any) -> None:
        seen.append(topology)
        raise UsageError("enough")

    monkeypatch.setattr(scene_renderer, "refined", record)
    for body in (joined, mesh):
        with pytest.raises(UsageError, match="enough"):
            SceneRenderer(Scene([body]), ROOM_CAMERA, bounces=1).phasors(np.eye(4))
    found, expected = seen
    np.testing.assert_array_equal(found.vertices[found.faces], expected.vertices[expected.faces])
    assert len(found.faces) > 24  # cut where the boxes meet
