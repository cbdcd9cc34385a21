"""Light that bounces between a landmark and its background: the foreign path tracer's frames, rendered and matched."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.cli import main
from phasemark.data import Bank, build_bank
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.accuracy import accuracy_card, multipath_shift
from phasemark.matcher.calibration import KnownPoses, Mounting, calibrate
from phasemark.matcher.diagnosis.search import wider
from phasemark.matcher.likelihood.systematic import carried_covariances, carried_errors
from phasemark.render import (
    Background,
    Body,
    PhasorImages,
    Renderer,
    Scene,
    SceneRenderer,
    Sensor,
    Views,
    capture,
    preset,
)
from phasemark.render.bounces import standing

GOLDEN = Path(__file__).parent / "golden" / "multipath.npz"
BEHIND = Background(wall_m=2.2, floor_m=0.15, wall_albedo=0.4, floor_albedo=0.5)
"""Of the scene "box"; the box's albedo is 0.8."""
N = 3
METRES = "--unit", "m", "--quantity", "range"


@pytest.fixture(scope="module")
def known() -> dict[str, Any]:
    """Return the arrays of the scene "box"."""
    with np.load(GOLDEN) as file:
        return {key.removeprefix("box/"): file[key] for key in file.files if key.startswith("box/")}


@pytest.fixture(scope="module")
def sensor(known: dict[str, Any]) -> Sensor:
    about = json.loads(str(known["description"]))
    return preset("pmd-16x16").with_(**about["camera"], lamp_half_angle_deg=about["lamp_half_angle_deg"])


@pytest.fixture(scope="module")
def mesh(known: dict[str, Any]) -> trimesh.Trimesh:
    """Return the box as a landmark whose axis is 1 m before the lens."""
    return trimesh.Trimesh(known["vertices_2"] - [1.0, 0.0, 0.0], known["faces_2"], process=False)


@pytest.fixture(scope="module")
def renderer(bank: Bank) -> Renderer:
    """Return a renderer that shares its light with those of the bank's matchers."""
    return Renderer(bank.mesh("box"), bank.sensor, albedo=0.8)


@pytest.mark.parametrize(("bounces", "key", "largest"), [(1, "bounces_1", 2e-3), ("all", "all", 3e-3)])
def test_a_box_before_floor_and_wall_returns_the_light_of_a_foreign_path_tracer(
    known: dict[str, Any], renderer: Renderer, bounces: Any, key: str, largest: float
) -> None:
    images = [renderer.render(1.0, background=replace(BEHIND, bounces=n)) for n in (0, bounces)]
    error = np.abs(images[1].phasor[0] - images[0].phasor[0] - known[f"{key}_minus_direct_S"][0])
    brightest = np.abs(known["direct_quadrature_S"][0]).max()
    beyond = np.maximum(error - 4 * known[f"{key}_minus_direct_S_se"][0], 0) / brightest
    assert np.quantile(beyond, 0.9) < 5e-4
    assert beyond.max() < largest
    assert (images[1].intensity >= images[0].intensity - 1e-9).all()


def test_light_between_nodes_is_that_of_a_node_there(renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    behind, view = replace(BEHIND, bounces="all"), (1.04, 0.07)
    direct = np.abs(renderer.render(*view, background=BEHIND).phasor)
    coarse = renderer.render(*view, background=behind).phasor
    assert renderer._standing is not None
    monkeypatch.setattr(standing, "_STEP_SHARE", np.log(view[0]))  # the view is a node itself
    monkeypatch.setattr(standing, "_STEP_RAD", view[1])
    monkeypatch.setattr(renderer._standing, "_nodes", {})
    exact = renderer.render(*view, background=behind).phasor
    assert len(renderer._standing._nodes) == 1
    assert np.abs(coarse - exact).max() < 1e-3 * direct.max()
    assert np.abs(coarse).max() > 1.01 * direct.max()


def test_what_bounces_is_a_polynomial_in_the_floors_albedo(renderer: Renderer) -> None:
    found = [
        renderer.render(1.0, background=replace(BEHIND, floor_albedo=albedo, bounces="all")).intensity[0, 11, 8]
        - renderer.render(1.0, background=replace(BEHIND, floor_albedo=albedo)).intensity[0, 11, 8]
        for albedo in (0.0, 0.2, 0.4, 0.6)
    ]
    assert found[0] < 0.2 * found[2]  # most of what reaches the box has met the floor
    third = found[3] - 3 * found[2] + 3 * found[1] - found[0]
    assert abs(third) < 0.02 * found[3]


@pytest.mark.parametrize("scene", ["stated", "unknown"])
def test_the_shift_that_is_told_is_that_of_foreign_frames(
    known: dict[str, Any], renderer: Renderer, bank: Bank, scene: str
) -> None:
    behind = BEHIND if scene == "stated" else None
    told = multipath_shift(renderer, Views.broadcast(1.0), free=("distance_m", "delta_rad"), background=behind)
    assert told is not None
    assert told.floor_albedo == 0.5
    assert told.floor_m == pytest.approx(0.15, abs=0.01)
    matcher = Matcher(bank, "refine", free=("distance_m", "delta_rad"), background=behind or "unknown", systematic=())
    like = renderer.render(1.0, background=BEHIND)
    errors = [
        matcher.match(kalman_filter(capture(_frames(known, like), bank.sensor, n_frames=500, rng=rng)))[0].distance_m
        - 1
        for rng in map(np.random.default_rng, range(N))
    ]
    assert told.shift[0] == pytest.approx(np.mean(errors), rel=0.15)
    assert str(told).startswith("multipath is off: a floor of albedo 0.5, 0.15 m below the lens, moves D by +")


def test_accuracy_and_match_tell_the_shift(
    known: dict[str, Any], renderer: Renderer, bank: Bank, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    view = Views.broadcast(1.0)
    told = multipath_shift(renderer, view)
    assert told is not None
    card = accuracy_card(renderer, view)
    assert card.line().endswith(f"; {told}")
    assert card.as_dict()["multipath"]["shift"]["distance_m"] == pytest.approx(told.shift[0])
    frames = capture(
        _frames(known, renderer.render(1.0, background=BEHIND)), bank.sensor, n_frames=50, rng=np.random.default_rng(0)
    )
    np.save(tmp_path / "frames.npy", frames.range_m[0])
    assert (
        main(["match", str(bank.path), str(tmp_path / "frames.npy"), "--unknown-background", "--no-diagnosis", *METRES])
        == 0
    )
    note = capsys.readouterr().err
    assert "note: multipath is off: a floor of albedo 0.5, 0.15 m below the lens, moves D by +" in note


def test_nothing_is_told_of_multipath_that_is_modelled_or_of_an_unknown_lamp(renderer: Renderer, mesh: Any) -> None:
    view = Views.broadcast(1.0)
    assert multipath_shift(renderer, view, background=replace(BEHIND, bounces="all")) is None
    assert multipath_shift(Renderer(mesh, preset("pmd-16x16")), view) is None


def test_a_lamp_that_lights_little_more_than_the_image_takes_a_free_bearing_and_a_diagnosis(bank: Bank) -> None:
    image = Renderer(bank.mesh("box"), bank.sensor, albedo=0.8).render(1.0, 0.1, 0.02)
    frames = kalman_filter(capture(image, bank.sensor, n_frames=50, rng=np.random.default_rng(0)))
    answer = Matcher(bank, "refine", background="unknown", systematic=()).match(frames)[0]
    assert answer.accepted
    assert wider(bank.sensor, 1.1).lamp_half_angle_deg == pytest.approx(17.6)


def _frames(known: dict[str, Any], like: PhasorImages) -> PhasorImages:
    """Return the foreign image of all bounces."""
    phasor = known["direct_quadrature_S"][0] + known["all_minus_direct_S"][0]
    gain = np.abs(phasor) / np.abs(known["direct_quadrature_S"][0])
    return replace(like, phasor=phasor[None].astype(np.complex128), intensity=like.intensity * gain)


@pytest.fixture(scope="module")
def bank(mesh: trimesh.Trimesh, sensor: Sensor, tmp_path_factory: pytest.TempPathFactory) -> Bank:
    folder = tmp_path_factory.mktemp("box")
    mesh.export(folder / "box.stl")
    overrides = {
        name: getattr(sensor, name) for name in ("lamp_half_angle_deg", "half_angle_h_deg", "half_angle_v_deg")
    }
    plan = {
        "classes": [],
        "meshes": [{"name": "box", "unit": "m", "path": str(folder / "box.stl"), "albedo": 0.8}],
        "layout": "full",
        "distance_m": "0.9:1.1:0.01",
        "delta_deg": "-20:20:1",
        "sensor_overrides": overrides,
    }
    return build_bank(plan, folder / "bank.h5")


def _matched(
    bank: Bank, image: PhasorImages, background: Any, n: int = N
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which of some frames are accepted, and error of D and its standard deviation, (n, 2) m."""
    matcher = Matcher(bank, "refine", free=("distance_m", "delta_rad"), background=background)
    accepted, errors = [], []
    for seed in range(n):
        frames = capture(image, bank.sensor, n_frames=50, rng=np.random.default_rng(seed))
        answer = matcher.match(kalman_filter(frames))[0]
        accepted.append(answer.accepted)
        std = np.nan if answer.covariance is None else float(np.sqrt(answer.covariance[0, 0]))
        errors.append((answer.distance_m - 1.0, std))
    return np.array(accepted), np.array(errors)


def test_foreign_frames_are_matched_where_light_bounces_off_a_floor_of_unknown_albedo(
    known: dict[str, Any], renderer: Renderer, bank: Bank
) -> None:
    image = _frames(known, renderer.render(1.0, background=BEHIND))
    unknown_floor = replace(BEHIND, floor_albedo=0.33, floor_albedo_std=0.16, bounces="all")
    accepted, errors = _matched(bank, image, unknown_floor)
    assert accepted.all()
    assert abs(errors[:, 0].mean()) < 3e-4
    assert np.median((errors[:, 0] / errors[:, 1]) ** 2) < 3.0
    direct, _ = _matched(bank, image, BEHIND, n=1)
    assert not direct.any()  # without bounces a frame is refused, whatever its noise


def test_a_box_before_a_wall_alone_returns_the_light_of_the_same_scene() -> None:
    camera, box = preset("pmd-16x16").with_(lamp_half_angle_deg=40), trimesh.creation.box((0.2, 0.2, 0.3))
    turned = trimesh.transformations.rotation_matrix(0.2, [0, 0, 1])
    place, wall = turned.copy(), turned @ trimesh.transformations.rotation_matrix(-np.pi / 2, [0, 1, 0])
    place[:3, 3], wall[:3, 3] = -turned[:3, 0], turned[:3, 0]
    scene = Scene([Body(box, 0.8, "box"), Body.plane((6, 6), albedo=0.5, pose=wall, name="wall")])
    direct, known = (SceneRenderer(scene, camera, bounces=k).phasors(place).phasor for k in (0, 2))
    found = Renderer(box, camera, albedo=0.8).render(1.0, 0.2, background=Background(wall_m=2.0, bounces=2)).phasor
    brightest = np.abs(direct).max()
    assert np.abs(found - known).max() < 5e-4 * brightest
    assert np.abs(known - direct).max() > 3e-3 * brightest


def test_light_does_not_depend_on_which_nodes_are_computed_together(renderer: Renderer) -> None:
    """All 16 around a view at once, or those alone that the view beside it left."""
    behind = replace(BEHIND, bounces="all")
    at_once = renderer.render(1.03, 0.05, background=behind).phasor
    assert renderer._standing is not None
    renderer._standing._nodes.clear()
    renderer.render(1.12, 0.18, background=behind)
    before = len(renderer._standing._nodes)
    np.testing.assert_array_equal(renderer.render(1.03, 0.05, background=behind).phasor, at_once)
    assert before < len(renderer._standing._nodes) < 2 * before  # some of them were there


def test_renderers_of_a_landmark_share_its_patches_and_those_of_an_albedo_the_light(
    bank: Bank, renderer: Renderer
) -> None:
    behind, sensor, mesh = replace(BEHIND, bounces=1), bank.sensor, bank.mesh("box")
    first, again = renderer.render(1.0, background=behind), Renderer(mesh, sensor, albedo=renderer.albedo)
    np.testing.assert_array_equal(again.render(1.0, background=behind).phasor, first.phasor)
    darker = Renderer(mesh, sensor, albedo=0.5 * renderer.albedo)
    darker.render(1.0, background=behind)
    one, other, third = (each._standing for each in (renderer, again, darker))
    assert one is other
    assert third is not one
    assert one is not None
    assert third is not None
    assert one._stands
    assert one._stands == third._stands


def test_light_that_bounces_unmodelled_is_in_the_covariance(
    known: dict[str, Any], renderer: Renderer, bank: Bank
) -> None:
    image = _frames(known, renderer.render(1.0, background=BEHIND))
    accepted, errors = _matched(bank, image, "unknown")
    held = np.abs(errors[:, 0]) < 2.5 * errors[:, 1]
    assert (held | ~accepted).all()
    assert np.abs(errors[accepted, 0]).min(initial=1.0) > 1e-3  # as far off as the covariance says


def test_multipath_may_move_a_view_beside_where_it_should_by_a_share_of_the_way() -> None:
    terms = carried_errors(preset("pmd-16x16").with_(lamp_half_angle_deg=30), ["multipath"])
    # two parameters of standard deviation 1; the brightest floor moves the first by 20
    fields = np.array([[[20.0, 0.0]]]) / np.sqrt(terms["multipath"].covariance[0, 0])
    plain = carried_covariances(np.eye(2)[None], np.eye(2)[None], fields, terms)["multipath"][0]
    np.testing.assert_allclose(plain, np.diag([20.0**2 + 2.0**2, 2.0**2]))
    # the same in other, correlated parameters
    mixed = np.array([[3e-4, 1e-4], [-2e-3, 5e-3]])
    rows = np.linalg.inv(mixed).T[None]
    found = carried_covariances((mixed @ mixed.T)[None], rows, fields, terms)["multipath"][0]
    np.testing.assert_allclose(found, mixed @ plain @ mixed.T)


def test_bounces_that_no_renderer_computes_are_refused(mesh: trimesh.Trimesh, sensor: Sensor) -> None:
    with pytest.raises(UsageError, match="'bounces' must be 0, 1, 2, … or 'all', got 'many'"):
        replace(BEHIND, bounces="many")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="'floor_albedo_std' must be 0 or more, got -1"):
        replace(BEHIND, floor_albedo_std=-1)
    behind = replace(BEHIND, bounces="all")
    with pytest.raises(UsageError, match="needs the sensor's 'lamp_half_angle_deg'"):
        Renderer(mesh, sensor.with_(lamp_half_angle_deg=None)).render(1.0, background=behind)
    with pytest.raises(UsageError, match="without one, put wall and floor into a Scene"):
        Renderer(None, sensor).render(1.0, background=behind)


def test_a_calibration_estimates_the_albedo_of_a_floor_off_which_light_bounces(
    sensor: Sensor, mesh: trimesh.Trimesh
) -> None:
    behind = Background(floor_m=0.15, floor_albedo=0.5, bounces="all")
    truth = Mounting.of_sensor(sensor.with_(pitch_deg=0.8, range_offset_m=0.004), 0.8)
    poses = KnownPoses.polar(np.array([0.9, 1.0, 1.0]), np.radians([0.0, 8.0, -8.0]))
    still = np.zeros(len(poses))
    image = Renderer(mesh, truth.on(sensor)).render_views(
        Views(poses.distance_m, poses.delta_rad, still, still), background=behind
    )
    frames = kalman_filter(capture(image, truth.on(sensor), rng=np.random.default_rng(3), n_frames=50))
    frames = replace(frames, sensor=sensor)
    free = "pitch", "range_offset"
    assumed = replace(behind, floor_albedo=0.33, floor_albedo_std=0.16)
    found = calibrate(mesh, frames, poses, free=[*free, "floor_albedo"], background=assumed)
    for name, true in (("floor_albedo", 0.5), ("pitch", truth.pitch_rad), ("range_offset", 0.004)):
        assert abs(found.value(name) - true) < 4 * found.std(name)
    assert 0 < found.std("floor_albedo") < 0.05
    assert found.p_value > 0.01
    assert "floor_albedo = 0." in found.to_toml(base_name="pmd-16x16")
    direct = calibrate(mesh, frames, poses, free=free, background=replace(behind, bounces=0))
    assert direct.value("range_offset") - 0.004 > 10 * found.std("range_offset")  # all of the light that came late
    with pytest.raises(UsageError, match="a positive floor_albedo_std of the background"):
        calibrate(mesh, frames, poses, free=["pitch", "floor_albedo"], background=behind)
    with pytest.raises(UsageError, match="'on' = ranges"):
        calibrate(mesh, frames, poses, free=free, background=behind, on="phasors")
    with pytest.raises(UsageError, match="light that bounces takes still poses"):
        calibrate(mesh, frames, poses, free=free, background=behind, moving=True)
