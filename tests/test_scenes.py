"""Scenes of several bodies against dense rays by other code, closed forms, and the renderer of one landmark."""

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
import trimesh
from oracles.analytic_scenes import Array, Solid, light_of_ellipsoid, pixels
from PIL import Image
from scipy.spatial.transform import Rotation

from phasemark import InputFileError, UsageError
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Body, Renderer, Scene, SceneRenderer, capture, preset
from phasemark.render.direct import HistogramImages, HistogramRenderer

WIDE = preset("pmd-16x16").with_(rows=4, cols=4, half_angle_h_deg=22.5, half_angle_v_deg=22.5)


def placed(place: Any = (0, 0, 0), rotation: Any = None) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = place
    if rotation is not None:
        pose[:3, :3] = rotation
    return pose


def body_of(solid: Solid) -> Body:
    options: dict[str, Any] = {"albedo": solid.albedo, "pose": placed(solid.place, solid.rotation)}
    if solid.kind == "box":
        body = Body.box(2 * np.array(solid.size), **options)
    elif solid.kind == "sphere":
        body = Body.sphere(solid.size[0], **options)
    else:
        body = Body.capsule(solid.size[0], 2 * solid.size[1], **options)
    retroreflecting, specular, shininess = solid.gloss
    return body.with_gloss(retroreflecting=retroreflecting, specular=specular, shininess=shininess)


def random_solids(rng: np.random.Generator, n: int) -> list[Solid]:
    """Bodies on a table top and in the air, some of which stand in others, some touch the top."""
    solids = [Solid("box", (2.0, 2.0, 0.05), np.eye(3), np.array([2.0, 0.0, -0.05]), 0.4)]
    while len(solids) < n:
        size, kind = rng.uniform(0.05, 0.25), str(rng.choice(["box", "sphere", "capsule"]))
        place = np.array([rng.uniform(0.5, 2.5), rng.uniform(-0.8, 0.8), rng.uniform(0.0, 0.9)])
        rotation = Rotation.random(random_state=int(rng.integers(1 << 31))).as_matrix()
        box: tuple[float, ...] = tuple(rng.uniform(0.3, 1.2, 3) * size)
        sizes = {"box": box, "sphere": (0.7 * size,), "capsule": (0.4 * size, size)}[kind]
        if kind == "box" and rng.random() < 0.5:
            rotation, place[2] = np.eye(3), sizes[2]  # stands on the top
        if rng.random() < 0.3:
            place = solids[-1].place + rng.normal(0, 0.04, 3)
        solids.append(Solid(kind, sizes, rotation, place, rng.uniform(0.2, 0.9)))
    return solids


def errors(solids: list[Solid], camera: Array, sensor: Any, n: int) -> tuple[float, float]:
    """Largest error of phasors, in the brightest pixel, and of shares."""
    image = SceneRenderer(Scene(body_of(solid) for solid in solids), sensor).phasors(camera)
    half = math.radians(sensor.half_angle_h_deg)
    phasor, shares = pixels(solids, camera, (sensor.rows, sensor.cols), half, sensor.modulation_hz, n)
    assert image.shares is not None
    np.testing.assert_allclose(image.shares.sum(axis=-1), image.coverage, atol=1e-9)
    return float(np.abs(image.phasor[0] - phasor).max() / np.abs(phasor).max()), float(
        np.abs(image.shares[0] - shares).max()
    )


# n × n rays of a pixel put an edge wrong by some n^-3/2 of it; edges along rows by up to 1/2n
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_scenes_are_what_dense_rays_see(seed):
    rng = np.random.default_rng(seed)
    camera = placed((-0.4, 0.1, 0.5), Rotation.from_euler("zyx", [0.13, 0.17, 0.09]).as_matrix())
    phasor, shares = errors(random_solids(rng, 9), camera, WIDE, 320)
    assert phasor < 5e-4
    assert shares < 1e-3


def test_a_surface_ends_at_its_own_limb_where_another_body_hides_it():
    """A ball before a capsule, of a random scene; without the hidden limb, and whose it is, 9e-4."""
    rng = np.random.default_rng([7, 25])
    camera = placed((-0.4, 0.1, 0.5), Rotation.from_euler("zyx", rng.uniform(-0.2, 0.2, 3)).as_matrix())
    solids = random_solids(rng, int(rng.integers(2, 41)))
    phasor, _ = errors([solids[1], solids[6]], camera, WIDE.with_(rows=8, cols=8), 256)
    assert phasor < 3e-4


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(40))
def test_random_scenes_of_2_to_40_bodies_are_what_very_dense_rays_see(seed):
    rng = np.random.default_rng([7, seed])
    camera = placed((-0.4, 0.1, 0.5), Rotation.from_euler("zyx", rng.uniform(-0.2, 0.2, 3)).as_matrix())
    phasor, shares = errors(random_solids(rng, int(rng.integers(2, 41))), camera, WIDE.with_(rows=8, cols=8), 512)
    assert phasor < 3e-4
    assert shares < 5e-4


@pytest.mark.parametrize("name", ["pmd-16x16", "vl53l5cx-8x8"])
def test_rays_converge_to_the_exact_frame(name):
    solids = random_solids(np.random.default_rng(4), 20)
    sensor, camera = preset(name).with_(rows=8, cols=8), placed((-0.4, 0.1, 0.5))
    scene, behind = Scene(body_of(solid) for solid in solids), Background(wall_m=5.0)
    exact = SceneRenderer(scene, sensor).render(camera, None, behind)

    def errors_of(rays: int) -> tuple[float, float]:
        image = SceneRenderer(scene, sensor, rays=rays).render(camera, None, behind)
        light, expected = ((one.signal if isinstance(one, HistogramImages) else one.phasor) for one in (image, exact))
        off = np.abs(light - expected) / np.abs(expected).max()
        return float(np.sqrt((off**2).mean())), float(np.sqrt(((image.shares - exact.shares) ** 2).mean()))

    assert max(errors_of(10)) < 1.5e-2
    assert max(errors_of(60)) < 1.5e-3


def test_one_ray_a_pixel_is_the_centre_ray_and_many_are_cast_in_parts(monkeypatch):
    mesh, sensor = build_mesh(catalog()["cone"]), preset("pmd-16x16").with_(fill_factor=(0.8, 0.6))
    alone = Renderer(mesh, sensor, albedo=0.8)
    centres = alone.render(1.0, 0.4, variant="hard")
    camera = placed(centres.views.lens_in_landmark()[0], centres.views.landmark2cam()[0][0].T)
    scene = Scene([Body(mesh, 0.8)])
    image = SceneRenderer(scene, sensor, rays=1).phasors(camera)
    scale = np.abs(centres.phasor).max()
    np.testing.assert_allclose(image.phasor / scale, centres.phasor / scale, atol=1e-9)
    whole = SceneRenderer(scene, sensor, rays=5).phasors([camera, camera])
    monkeypatch.setattr("phasemark.render.integral.area_integral._RAYS_AT_ONCE", 1000)
    np.testing.assert_array_equal(SceneRenderer(scene, sensor, rays=5).phasors([camera, camera]).phasor, whole.phasor)
    for rays in (0, 2.5, 101, "10"):
        with pytest.raises(UsageError, match="'rays' must be a whole number from 1 to 100 a side of a pixel"):
            SceneRenderer(scene, sensor, rays=cast(Any, rays))


def test_scratch_of_a_large_scene_serves_a_small_one():
    """What a scene leaves in scratch that is kept between calls must not be read by the next."""
    small, sensor = [Solid("sphere", (0.2,), np.eye(3), np.array([1.5, 0.0, 0.0]), 0.5)], WIDE
    small += [Solid("box", (0.1, 0.1, 0.1), np.eye(3), np.array([1.0, 0.3, 0.0]), 0.5)]
    large = random_solids(np.random.default_rng(5), 30)
    alone = SceneRenderer(Scene(body_of(one) for one in small), sensor).phasors(placed()).phasor
    SceneRenderer(Scene(body_of(one) for one in large), sensor).phasors(placed((-0.4, 0.1, 0.5)))
    again = SceneRenderer(Scene(body_of(one) for one in small), sensor).phasors(placed()).phasor
    np.testing.assert_array_equal(again, alone)


@pytest.mark.parametrize("turned_deg", [0.0, 4.0])
def test_round_bodies_that_cross_in_a_pixel_are_swept_along_their_own_limbs(turned_deg):
    """A level rail before an upright pole: by one sweep for both, the light of one was 3.5e-2 too much."""
    level, turn = Rotation.from_euler("x", 90 + turned_deg, degrees=True).as_matrix(), Rotation.identity().as_matrix()
    solids = [
        Solid("box", (0.05, 5.0, 5.0), turn, np.array([3.05, 0.0, 0.0]), 0.3),
        Solid("capsule", (0.01, 1.0), level, np.array([0.8, 0.0, 0.03]), 0.8),
        Solid("capsule", (0.01, 1.0), turn, np.array([1.4, 0.04, 0.0]), 0.8),
    ]
    sensor = preset("pmd-16x16").with_(rows=2, cols=2, half_angle_h_deg=6, half_angle_v_deg=6, modulation_hz=20e6)
    phasor, shares = errors(solids, np.eye(4), sensor, 1000)
    assert phasor < 3e-4
    assert shares < 5e-4


def test_crossings_of_round_bodies_lie_on_both():
    place = np.array([0.15, 0.03, 0.02])
    bodies = Body.sphere(0.2), Body.capsule(0.1, 0.3, pose=placed(tuple(place)))
    ends = SceneRenderer(Scene(bodies), WIDE)._assembly.topology.vertices  # round bodies have no others
    axis = np.column_stack([np.zeros((len(ends), 2)), np.clip(ends[:, 2] - place[2], -0.15, 0.15)])
    assert len(ends) > 100
    np.testing.assert_allclose(np.linalg.norm(ends, axis=1), 0.2, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(ends - place - axis, axis=1), 0.1, atol=1e-9)


@pytest.mark.parametrize("name", sorted(catalog()))
def test_a_landmark_alone_is_rendered_as_by_its_renderer(name):
    mesh, sensor = build_mesh(catalog()[name]), preset("pmd-16x16")
    expected = Renderer(mesh, sensor, albedo=0.8).render(1.0, 0.4)
    # the lens stands at distance D on the side δ of the landmark and looks at its axis
    lens = Renderer(mesh, sensor).render(1.0, 0.4).views.lens_in_landmark()[0]
    rotation = expected.views.landmark2cam()[0][0].T
    image = SceneRenderer(Scene([Body(mesh, 0.8)]), sensor).phasors(placed(lens, rotation))
    scale = np.abs(expected.phasor).max()
    np.testing.assert_allclose(image.phasor / scale, expected.phasor / scale, atol=1e-9)
    np.testing.assert_allclose(image.coverage, expected.coverage, atol=1e-9)


@pytest.mark.parametrize("pitch", [0.0, 0.1])
def test_a_wall_and_a_floor_behind_a_scene_are_those_of_the_renderer(pitch):
    mesh, sensor = build_mesh(catalog()["cone"]), preset("pmd-16x16").with_(pitch_deg=2.0)
    behind = Background(wall_m=2.5, floor_m=0.4)
    expected = Renderer(mesh, sensor, albedo=0.8).render(1.0, 0.4, pitch_rad=pitch, background=behind)
    camera = placed(expected.views.lens_in_landmark()[0], expected.views.landmark2cam()[0][0].T)
    image = SceneRenderer(Scene([Body(mesh, 0.8)]), sensor).phasors(camera, None, behind)
    scale = np.abs(expected.phasor).max()
    np.testing.assert_allclose(image.phasor / scale, expected.phasor / scale, atol=1e-6)
    with pytest.raises(UsageError, match=r"through the floor at 0\.01 m"):
        SceneRenderer(Scene([Body(mesh, 0.8)]), sensor).phasors(camera, None, Background(floor_m=0.01))
    with pytest.raises(UsageError, match=r"through the wall at 0\.9 m"):
        SceneRenderer(Scene([Body(mesh, 0.8)]), sensor).phasors(camera, None, Background(wall_m=0.9))


def test_histograms_of_a_scene_are_those_of_the_landmark_and_sum_up():
    sensor, mesh = preset("vl53l5cx-8x8"), build_mesh(catalog()["cylinder"])
    expected = HistogramRenderer(mesh, sensor, albedo=0.8).render(1.0, 0.4)
    assert expected.views is not None
    camera = placed(expected.views.lens_in_landmark()[0], expected.views.landmark2cam()[0][0].T)
    image = SceneRenderer(Scene([Body(mesh, 0.8, "landmark")]), sensor).render(camera)
    assert isinstance(image, HistogramImages)
    np.testing.assert_allclose(image.expected, expected.expected, rtol=1e-3, atol=1e-3 * expected.expected.max())
    assert image.bodies == ("landmark",)
    assert image.shares is not None
    assert 0 < image.shares.max() <= 1
    frames = capture(image, sensor, rng=np.random.default_rng(1), n_frames=3)
    assert frames.counts.shape == (1, 3, 8, 8, sensor.histogram.bins)


def test_glossy_bodies_return_what_dense_rays_with_their_brdf_do():
    tilted = Rotation.from_euler("zyx", [0.2, 0.15, 0.1]).as_matrix()
    solids = [
        Solid("box", (0.05, 3.0, 3.0), tilted, np.array([1.55, 0.0, 0.0]), 0.4, (0.0, 0.1, 100.0)),
        Solid("sphere", (0.2,), np.eye(3), np.array([1.0, 0.12, 0.05]), 0.2, (0.0, 0.3, 40.0)),
        Solid("sphere", (0.04,), np.eye(3), np.array([0.9, -0.2, -0.17]), 0.2, (0.0, 0.3, 300.0)),
        Solid("capsule", (0.06, 0.15), tilted, np.array([1.0, -0.15, 0.12]), 0.4, (1.5, 0.0, 1.0)),
    ]
    phasor, _ = errors(solids, placed(), WIDE.with_(modulation_hz=60e6), 320)
    assert phasor < 5e-4  # of the rays, as above
    plain, _ = errors([solid._replace(gloss=(0.0, 0.0, 1.0)) for solid in solids], placed(), WIDE, 40)
    assert plain < 1e-2


@pytest.mark.parametrize("gloss", [{"retroreflecting": 3.0}, {"specular": 0.2, "shininess": 400.0}])
def test_a_glossy_wall_gives_a_direct_sensor_the_light_of_its_closed_form(gloss):
    sensor, wall = preset("vl53l5cx-8x8"), Body.box((0.1, 9.0, 9.0), albedo=0.4, pose=placed((1.05, 0, 0)))
    matte, glossy = (SceneRenderer(Scene([body]), sensor) for body in (wall, wall.with_gloss(**gloss)))
    m, tangent = gloss.get("shininess", 1.0), np.tan(np.radians(22.5)) * (np.arange(400) - 199.5) / 800
    lobe = gloss.get("specular", 0.0) * (m + 2) * (m + 4) / (8 * (m + 2 ** (-m / 2)))
    cosine = 1 / np.sqrt(1 + tangent**2 + tangent[:, None] ** 2)
    more = (cosine**2 * (0.4 * cosine + gloss.get("retroreflecting", 0.0) + lobe * cosine ** (m + 1))).sum()
    ratio = more / (cosine**2 * 0.4 * cosine).sum()  # over the four zones in the middle
    middle = 0, slice(3, 5), slice(3, 5)
    intensity = [renderer.phasors(np.eye(4)).intensity[middle].sum() for renderer in (matte, glossy)]
    np.testing.assert_allclose(intensity[1] / intensity[0], ratio, rtol=1e-3)
    signal = [renderer.histograms(np.eye(4)).signal[middle].sum() for renderer in (matte, glossy)]
    np.testing.assert_allclose(signal[1] / signal[0], ratio, rtol=2e-2)  # zones reach a little beyond their share


@pytest.mark.parametrize("height_m", [0.05, 0.3])
def test_a_body_seen_at_a_slant_is_resolved_in_range_as_a_floor_behind(height_m):
    sensor = preset("vl53l5cx-8x8")
    expected = HistogramRenderer(None, sensor).render(1.0, background=Background(floor_m=height_m, floor_albedo=0.5))
    floor = Body.plane((60, 60), albedo=0.5, pose=placed((0, 0, -height_m)))
    image = SceneRenderer(Scene([floor]), sensor).histograms(np.eye(4))
    near = expected.signal > 1e-3 * expected.signal.max()
    scale = expected.expected.max(axis=-1, keepdims=True)
    assert (np.abs(image.expected - expected.expected) / scale)[near].max() < 5e-3


def test_a_room_seen_from_inside_has_no_gap():
    room = trimesh.creation.box((4.0, 3.0, 2.5))
    room.invert()
    cameras = np.array([placed((0.3, 0.2, 0.1), Rotation.from_euler("z", k).as_matrix()) for k in range(6)])
    scene = Scene([Body(room, 0.5, "room"), Body.sphere(0.2, pose=placed((1, 0.5, 0)))])
    image = SceneRenderer(scene, WIDE).phasors(cameras)
    np.testing.assert_allclose(image.coverage, 1.0, atol=1e-9)
    solid = Body(trimesh.creation.box((4.0, 3.0, 2.5)), name="solid")
    with pytest.raises(UsageError, match="in frame 2 the lens is inside body 'solid'"):
        SceneRenderer(Scene([solid]), WIDE).phasors([placed((5, 0, 0)), placed((0, 5, 0)), placed()])


def test_bodies_joined_into_one_keep_their_albedos_and_round_surfaces():
    tilted = Rotation.from_euler("zyx", [0.2, 0.3, 0.5]).as_matrix()
    solids = [
        Solid("capsule", (0.1, 0.15), tilted, np.array([1.0, 0.1, 0.0]), 0.3),
        Solid("sphere", (0.17,), np.eye(3), np.array([1.05, -0.05, 0.06]), 0.7),
        Solid("box", (0.05, 0.25, 0.05), tilted @ tilted, np.array([1.0, 0.0, -0.1]), 0.7),
    ]
    robot = Body.joined((body_of(solid) for solid in solids), "robot")
    image = SceneRenderer(Scene([robot]), WIDE).phasors(placed())
    phasor, shares = pixels(solids, placed(), (4, 4), math.radians(22.5), WIDE.frequencies_hz[0], 320)
    np.testing.assert_allclose(image.phasor[0], phasor, atol=5e-4 * np.abs(phasor).max())
    np.testing.assert_allclose(image.coverage[0], shares.sum(axis=-1), atol=1e-3)


def test_joined_bodies_are_what_they_are_made_of_also_joined_again_moved_and_changed():
    rng = np.random.default_rng(4)
    parts = [
        Body.sphere(0.06, albedo=0.3), Body.sphere(0.05, albedo=0.3), Body.capsule(0.03, 0.1, albedo=0.3),
        Body.box((0.05, 0.12, 0.04), albedo=0.3), Body(trimesh.creation.icosahedron().apply_scale(0.06), 0.3),
    ]  # fmt: skip
    poses = [placed(rng.uniform(-0.06, 0.06, 3), Rotation.random(random_state=rng).as_matrix()) for _ in parts]
    parts = [replace(part, pose=pose) for part, pose in zip(parts, poses, strict=True)]
    moves = [placed((1.0, 0.05 * k, 0.0), Rotation.from_rotvec([0.3 * k, 0.5, 0.2]).as_matrix()) for k in range(3)]
    first = replace(Body.joined(parts[:3]), pose=placed((0.0, 0.0, 0.01)))
    whole = Body.joined([first, *parts[3:]], "robot").with_gloss(specular=0.2)
    lifted = [replace(part, pose=placed((0.0, 0.0, 0.01)) @ part.pose) for part in parts[:3]] + parts[3:]
    apart = [part.with_gloss(specular=0.2) for part in lifted]
    scene, many = Scene([whole, Body.plane((0.4, 0.4), name="table")]), Scene([*apart, Body.plane((0.4, 0.4))])
    table = placed((1.3, 0.0, -0.2))
    images = SceneRenderer(scene, WIDE).phasors([placed()] * 3, {"robot": moves, "table": table})
    where = np.array([[*(move @ part.pose for part in apart), table] for move in moves])
    expected = SceneRenderer(many, WIDE).phasors([placed()] * 3, where)
    np.testing.assert_allclose(images.phasor, expected.phasor, atol=1e-9 * np.abs(expected.phasor).max())
    np.testing.assert_allclose(images.shares[..., 0], expected.shares[..., :-1].sum(axis=-1), atol=1e-9)
    with pytest.raises(UsageError, match="frame 0 the lens is inside body 'robot'"):
        SceneRenderer(scene, WIDE).phasors(apart[0].pose)
    flat = SceneRenderer(Scene([replace(whole, smooth=False, pose=moves[0])]), WIDE).phasors(placed()).phasor
    facets = [replace(part, smooth=False, pose=moves[0] @ part.pose) for part in apart]
    sides = SceneRenderer(Scene(facets), WIDE).phasors(placed()).phasor
    np.testing.assert_allclose(flat, sides, atol=1e-9 * np.abs(sides).max())


def test_a_joined_body_whose_mesh_was_changed_is_that_mesh():
    ball = Body.sphere(0.1, albedo=0.5)
    joined = Body.joined([ball, replace(ball, pose=placed((0.0, 0.12, 0.0)))])
    joined.mesh.vertices = np.asarray(joined.mesh.vertices) * [1.0, 1.5, 0.7]
    mesh = Body(trimesh.Trimesh(joined.mesh.vertices, joined.mesh.faces, process=False), 0.5)
    image, expected = (
        SceneRenderer(Scene([replace(body, pose=placed((1, 0, 0)))]), WIDE).phasors(placed()).phasor
        for body in (joined, mesh)
    )
    np.testing.assert_array_equal(image, expected)


@pytest.mark.parametrize("angle_deg", [5, 20, 28, 60])
def test_faces_of_joined_boxes_that_meet_at_a_small_angle_are_flat(angle_deg):
    half = math.radians(angle_deg) / 2
    turns = (Rotation.from_euler("z", turn).as_matrix() for turn in (half, -half))
    boxes = [
        Body.box((0.1, 0.3, 0.2), albedo=0.5, pose=placed((1.3, side, 0), turn))
        for side, turn in zip((0.1, -0.1), turns, strict=True)
    ]
    apart = SceneRenderer(Scene(boxes), WIDE).phasors(placed()).phasor
    joined = SceneRenderer(Scene([Body.joined(boxes, "roof")]), WIDE).phasors(placed()).phasor
    np.testing.assert_allclose(joined, apart, atol=1e-5 * np.abs(apart).max())


def test_sheets_of_one_mesh_that_pass_through_one_another_are_cut_there():
    corners = np.array([[0, -0.15, -0.12], [0, 0.15, -0.12], [0, 0.15, 0.12], [0, -0.15, 0.12]])
    sheet = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    turned = sheet.copy()
    turned.vertices = corners @ Rotation.from_rotvec([0.0, 0.9, 0.5]).as_matrix().T
    both = trimesh.util.concatenate([sheet, turned])
    assert isinstance(both, trimesh.Trimesh)
    bodies = [Body(mesh, 0.5, pose=placed((1, 0.02, 0))) for mesh in (sheet, turned)]
    apart = SceneRenderer(Scene(bodies), WIDE).phasors(placed()).phasor
    one = SceneRenderer(Scene([Body(both, 0.5, pose=placed((1, 0.02, 0)))]), WIDE).phasors(placed()).phasor
    np.testing.assert_allclose(one, apart, atol=1e-6 * np.abs(apart).max())


def test_a_ball_dented_through_itself_is_what_dense_rays_see():
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.15)
    ball.vertices = np.where(ball.vertices[:, :1] < -0.05, ball.vertices * [-1.5, 1, 1], ball.vertices)
    scene = Scene([Body(ball, 0.5, smooth=False, pose=placed((1, 0, 0)))])
    exact = SceneRenderer(scene, WIDE).phasors(placed()).phasor
    dense = SceneRenderer(scene, WIDE, rays=100).phasors(placed()).phasor
    np.testing.assert_allclose(exact, dense, atol=2e-3 * np.abs(dense).max())  # 10 000 rays a pixel


def test_moving_bodies_are_rendered_as_where_they_stand():
    rng = np.random.default_rng(5)
    bodies = [body_of(solid) for solid in random_solids(rng, 6)]
    renderer, n = SceneRenderer(Scene(bodies), WIDE), 4
    cameras = np.repeat(placed((-0.4, 0, 0.4))[None], n, axis=0)
    moving = np.repeat(renderer.scene.poses[None], n, axis=0)
    moving[:, 3, :3, 3] += rng.normal(0, 0.2, (n, 3))  # the fourth goes its way, the others stand
    together = renderer.phasors(cameras, moving)
    threads = SceneRenderer(Scene(bodies), WIDE).phasors(cameras, moving, workers=2)
    named = renderer.phasors(cameras, {"body 3": moving[:, 3]})
    for k in range(n):
        there = [replace(body, pose=moving[k, b]) for b, body in enumerate(bodies)]
        alone = SceneRenderer(Scene(there), WIDE).phasors(cameras[k])
        np.testing.assert_array_equal(together.phasor[k], alone.phasor[0])
        np.testing.assert_array_equal(together.shares[k], alone.shares[0])
    np.testing.assert_array_equal(together.phasor, threads.phasor)
    np.testing.assert_array_equal(together.phasor, named.phasor)
    assert renderer.phasors(cameras[:0]).shares.shape == (0, WIDE.rows, WIDE.cols, len(bodies))


def test_the_mesh_of_a_ball_that_was_stretched_is_no_ball_any_more():
    mesh = Body.sphere(0.2).mesh
    assert isinstance(mesh, trimesh.Trimesh)
    mesh = mesh.copy()
    mesh.apply_transform(np.diag([1.0, 1.0, 2.0, 1.0]))
    camera = placed((-1.0, 0, 0))
    stretched = SceneRenderer(Scene([Body(mesh)]), WIDE).phasors(camera)
    true = SceneRenderer(Scene([Body.ellipsoid((0.2, 0.2, 0.4))]), WIDE).phasors(camera)
    np.testing.assert_allclose(stretched.phasor, true.phasor, atol=2e-3 * np.abs(true.phasor).max())


@pytest.mark.parametrize("distance_m", [0.3, 0.5, 1.5])
def test_a_sphere_fills_the_share_of_its_cone(distance_m):
    """Seen on the axis, a sphere's outline is a circle of tangents, of radius tan(arcsin(R / d))."""
    one = WIDE.with_(rows=1, cols=1)
    image = SceneRenderer(Scene([Body.sphere(0.1, pose=placed((distance_m, 0, 0)))]), one).phasors(np.eye(4))
    tangent = math.tan(math.asin(0.1 / distance_m)) / math.tan(math.radians(22.5))
    assert image.shares is not None
    assert image.shares[0, 0, 0, 0] == pytest.approx(math.pi / 4 * tangent**2, abs=3e-5)


@pytest.mark.parametrize(
    ("half_m", "tolerance"),
    [
        ((0.0015, 0.0015, 0.0015), 2e-4),  # a twentieth of a pixel
        ((0.006, 0.004, 0.005), 3e-4),
        ((0.042, 0.014, 0.056), 2e-3),  # three quarters of it
        ((0.01, 0.04, 0.04), 2e-3),
        ((0.002, 0.016, 0.016), 2e-3),
    ],
)
def test_small_and_flat_ellipsoids_return_the_light_of_their_surface(half_m, tolerance):
    one = WIDE.with_(rows=1, cols=1, half_angle_h_deg=2.86, half_angle_v_deg=2.86)
    for number in range(3):
        rotation = Rotation.random(random_state=number).as_matrix()
        pose = placed((1.5, 0.004 * number, -0.007), rotation)
        image = SceneRenderer(Scene([Body.ellipsoid(half_m, albedo=1.0, pose=pose)]), one).phasors(np.eye(4))
        true = light_of_ellipsoid(half_m, pose, one.frequencies_hz[0], 1000)
        found = complex(image.phasor[0, 0, 0]) * (2 * math.tan(math.radians(2.86))) ** 2
        assert abs(found - true) < tolerance * abs(true)


@pytest.mark.parametrize("shape", ["box", "sphere", "capsule"])
def test_a_body_hidden_by_another_leaves_no_trace(shape):
    hidden = {"box": Body.box((0.1, 0.1, 0.1)), "sphere": Body.sphere(0.07), "capsule": Body.capsule(0.05, 0.1)}[shape]
    cover = Body.box((0.05, 0.6, 0.6), pose=placed((0.8, 0, 0)))
    renderer = SceneRenderer(Scene([cover, replace(hidden, pose=placed((1.5, 0.05, 0.03)))]), WIDE)
    alone = SceneRenderer(Scene([cover]), WIDE).phasors(np.eye(4))
    np.testing.assert_array_equal(renderer.phasors(np.eye(4)).phasor, alone.phasor)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_cylinders_and_ellipsoids_are_what_their_fine_meshes_are(axis):
    """The facets of a mesh are 4° wide."""
    turned = np.eye(4)[:, [axis, (axis + 1) % 3, (axis + 2) % 3, 3]]
    turned[:3, 3] = 1.0, 0.1, 0.05
    for body in (Body.cylinder(0.12, 0.3, pose=turned), Body.ellipsoid((0.1, 0.2, 0.15), pose=turned)):
        exact = SceneRenderer(Scene([body]), WIDE).phasors(np.eye(4))
        each = np.full(len(body.mesh.faces), body.albedo)  # an albedo of each facet
        facets = SceneRenderer(Scene([replace(body, albedo=each)]), WIDE).phasors(np.eye(4))
        np.testing.assert_allclose(exact.phasor, facets.phasor, atol=2e-3 * np.abs(exact.phasor).max())


def test_a_scene_is_the_same_wherever_the_world_begins():
    fast = WIDE.with_(modulation_hz=60e6)

    def phasor(shift: Any, sensor: Any) -> Any:
        bodies = [
            Body.box((4, 4, 0.1), pose=placed(np.add(shift, (1.5, 0, -0.4)))),
            Body.sphere(0.2, pose=placed(np.add(shift, (1.2, 0.1, 0.1)))),
            Body.box((0.1, 3, 3), pose=placed(np.add(shift, (2.5, 0, 0)))),
        ]
        return np.asarray(SceneRenderer(Scene(bodies), sensor).phasors(placed(shift)).phasor[0])

    here = phasor(np.zeros(3), fast)
    np.testing.assert_allclose(phasor(np.array([7.0, -3.0, 1.0]), fast), here, atol=1e-7)
    fine = phasor(np.zeros(3), fast.with_(rows=32, cols=32)).reshape(4, 8, 4, 8).mean(axis=(1, 3))
    np.testing.assert_allclose(here, fine, atol=3e-4 * np.abs(fine).max())


def test_both_intersectors_see_the_same_scene():
    scene = Scene(body_of(solid) for solid in random_solids(np.random.default_rng(8), 8))
    camera = placed((-0.4, 0.1, 0.5))
    embree = SceneRenderer(scene, WIDE).phasors(camera)
    own = SceneRenderer(scene, WIDE, intersector="float64").phasors(camera)
    np.testing.assert_allclose(own.phasor, embree.phasor, atol=2e-5 * np.abs(embree.phasor).max())


def test_each_face_may_have_its_albedo_and_what_is_open_is_seen_from_both_sides():
    sensor = preset("pmd-16x16")
    plane = Body.plane((4, 4)).mesh
    front = placed((1, 0, 0), Rotation.from_euler("y", 90, degrees=True).as_matrix())
    back = placed((1, 0, 0), Rotation.from_euler("y", -90, degrees=True).as_matrix())
    for pose in (front, back):
        one = SceneRenderer(Scene([Body(plane, 0.5, pose=pose)]), sensor).phasors(np.eye(4))
        two = SceneRenderer(Scene([Body(plane, np.array([0.25, 0.75]), pose=pose)]), sensor).phasors(np.eye(4))
        # the rays' amplitude is the albedo times cos θ / r², and the diagonal halves the image
        assert abs(two.intensity.sum() / one.intensity.sum() - 1) < 1e-6
        assert two.intensity.max() / one.intensity.max() == pytest.approx(1.5, rel=1e-2)
    assert one.intensity[0, 8, 8] == pytest.approx(0.5, rel=1e-2)


@pytest.mark.parametrize(
    ("material", "albedo"),
    [
        ({"baseColorTexture": 255}, 1.0),
        ({"baseColorTexture": 51, "baseColorFactor": [255, 255, 255, 255]}, 0.2),
        ({"baseColorTexture": 255, "baseColorFactor": [51, 51, 51, 255]}, 0.2),
        ({"roughnessFactor": 0.5}, 0.8),
    ],
)
def test_a_texture_counts_with_its_mean_and_no_colour_is_the_usual_albedo(tmp_path, material, albedo):
    box, grey = trimesh.creation.box((0.2, 0.2, 0.2)), material.get("baseColorTexture")
    if grey is not None:
        material = {**material, "baseColorTexture": Image.new("RGB", (4, 4), (grey, grey, grey))}
    box.visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((8, 2)), material=trimesh.visual.material.PBRMaterial(**material)
    )
    trimesh.Scene(box).export(tmp_path / "scene.glb")
    assert Scene.read(tmp_path / "scene.glb").bodies[0].albedo == pytest.approx(albedo)


@pytest.mark.parametrize("field", ["bearing_offset_deg", "height_offset_m"])
def test_where_a_sensor_points_from_its_mount_is_stated_by_the_pose_of_the_camera(field):
    with pytest.raises(UsageError, match=f"'{field}' of the sensor is that before a landmark, got 0.05: a scene"):
        SceneRenderer(Scene([Body.sphere(0.1)]), preset("pmd-16x16").with_(**{field: 0.05}))


def test_a_file_with_materials_becomes_a_scene(tmp_path):
    loaded = trimesh.Scene()
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    box.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 255, 255, 255])
    )
    loaded.add_geometry(box, node_name="white", transform=placed((1, 0, 0)))
    grey = trimesh.creation.icosphere(radius=0.1)
    grey.visual.face_colors = [51, 51, 51, 255]
    scaled = placed((1, 0.5, 0))
    scaled[:3, :3] *= 2
    loaded.add_geometry(grey, node_name="grey", transform=scaled)
    loaded.export(tmp_path / "scene.glb")
    scene = Scene.read(tmp_path / "scene.glb")
    assert set(scene.names) == {"white", "grey"}
    assert scene["white"].albedo == pytest.approx(1.0)
    assert np.mean(scene["grey"].albedo) == pytest.approx(0.2, abs=0.01)
    assert np.ptp(scene["grey"].mesh.vertices, axis=0) == pytest.approx([0.4] * 3, rel=1e-6)
    assert scene["grey"].pose[1, 3] == pytest.approx(0.5)
    with pytest.raises(InputFileError, match="there is no such file"):
        Scene.read(tmp_path / "none.glb")
    (tmp_path / "broken.glb").write_bytes(b"glTF of sorts")
    with pytest.raises(InputFileError, match=r"broken\.glb: cannot be read as a scene"):
        Scene.read(tmp_path / "broken.glb")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Scene([]), "needs at least one body"),
        (lambda: Scene([Body.sphere(1, name="a"), Body.sphere(2, name="a")]), "two bodies are named 'a'"),
        (lambda: Scene(["box"]), "made of Body objects, got str"),  # type: ignore[list-item]
        (lambda: Scene(None), "made of Body objects, got NoneType"),
        (lambda: Body.sphere(-1), "positive numbers of metres"),
        (lambda: Body.box((1, 2)), "'size_m' must be 3 positive numbers"),
        (lambda: Body.sphere(1, albedo=1.2), r"'albedo' must be in \[0, 1\], got 1.2"),
        (lambda: Body.sphere(1).with_gloss(specular=0.3), "together must be at most 1, got 0.8 \\+ 0.3"),
        (lambda: Body.sphere(1).with_gloss(shininess=0), r"'shininess' must be in \[1, 1000\], got 0"),
        (lambda: Body.sphere(1).with_gloss(retroreflecting=np.nan), "must be finite and at least 0, got nan"),
        (lambda: Body(trimesh.creation.box(), np.ones(3)), "one for each of 12 faces"),
        (lambda: Body.sphere(1, pose=np.full((4, 4), np.nan)), "pose of a body must be finite"),
        (lambda: Body.sphere(1, name="x", pose=np.diag([2, 1, 1, 1])), "pose of body 'x' must be a rotation"),
        (lambda: Body.height_field(np.diag([0, np.nan]), (1, 1)), "'heights_m' must be finite"),
        (lambda: Scene([Body.sphere(1)]).posed({"y": np.eye(4)}, 1), "no body is named 'y'"),
        (
            lambda: Scene([Body.sphere(1, name="x")]).posed(np.full((2, 1, 4, 4), np.nan), 2),
            "pose of body 'x' must be finite, matrix 0",
        ),
        (lambda: Body.sphere("wide"), "must be 3 positive numbers of metres, got ..wide"),  # type: ignore[arg-type]
        (lambda: Body.sphere(1, albedo="white"), "'albedo' must be numbers, got 'white'"),  # type: ignore[arg-type]
        (lambda: Body(trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False)), "has an area"),
        (lambda: Body.joined([]), "must be at least one, and agree"),
        (lambda: Scene([Body.sphere(1)]).posed(np.zeros((3, 3)), 1), "'bodies2world' must have shape"),
        (lambda: SceneRenderer("scene", WIDE), "'scene' must be a Scene"),  # type: ignore[arg-type]
        (lambda: SceneRenderer(Scene([Body.sphere(1)]), WIDE).phasors(np.eye(3)), "'camera2world' must have shape"),
        (
            lambda: SceneRenderer(Scene([Body.sphere(1)]), WIDE).phasors(np.eye(4), workers=1.5),  # type: ignore[arg-type]
            "'workers' must be at least 1, a whole number, got 1.5",
        ),
    ],
)
def test_what_is_no_scene_is_refused_in_words(make, message):
    with pytest.raises(UsageError, match=message):
        make()
