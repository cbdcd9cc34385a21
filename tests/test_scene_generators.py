"""The generators of scenes among the examples: their labels are true of the scenes that they label."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from phasemark import UsageError
from phasemark.data import build_frames
from phasemark.data.plans import SceneFramesPlan
from phasemark.data.seeds import stream
from phasemark.render import Renderer, Scene, SceneRenderer, preset

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


@pytest.fixture(scope="module")
def generators() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        return importlib.import_module("scene_generators")


def plan_of(generators: ModuleType, name: str, n: int, **options: int) -> SceneFramesPlan:
    """The plan of a generator, as the example builds it."""
    about = generators.PLANS[name]
    scenes = {**about["scenes"], "generator": f"scene_generators:{name}", "n": n, "options": options}
    return SceneFramesPlan(**{**about, "scenes": scenes | {"steps": options.get("steps", 1)}, "seed": 7})


def test_the_dock_is_seen_from_its_labels(generators: ModuleType) -> None:
    sensor = preset("pmd-16x16")
    renderer = Renderer(generators.DOCK.mesh, sensor, albedo=0.8)
    seen = 0
    for index in range(12):
        made = generators.dock(index, stream(7, "scenes", index), steps=2)
        if not made.labels["there"]:
            assert np.isnan(made.labels["distance_m"])
            continue
        seen += 1
        alone = SceneRenderer(Scene([generators.DOCK]), sensor)
        found = alone.phasors(made.camera2world)
        distance_m, delta_rad = made.labels["distance_m"], made.labels["delta_rad"]
        heading = np.arctan2(made.camera2world[0, 1, 0], made.camera2world[0, 0, 0])
        expected = renderer.render(distance_m, delta_rad, delta_rad - heading)
        brightest = np.abs(expected.phasor).max()
        # the same integral in another frame: pieces of a pixel that are narrower than rounding are sampled or not
        np.testing.assert_allclose(found.phasor, expected.phasor, rtol=0, atol=1e-6 * brightest)
    assert seen > 6


def test_clutter_stands_clear_of_the_dock_and_the_lens(generators: ModuleType, tmp_path: Path) -> None:
    plan = plan_of(generators, "dock", 12, steps=3)
    with build_frames(plan, tmp_path / "dock.h5", workers=1) as frames:  # a lens inside of a body is refused
        classes = frames[:]["class_of_body"]
        assert set(classes[classes >= 0].tolist()) == {0, 1}
        there = frames.truth["label_there"] == 1
        assert (frames[there]["shares"][..., 0].max(axis=(1, 2)) > 0).all()
        assert not frames[~there]["shares"][..., 0].any()


def test_the_count_is_that_of_the_people(generators: ModuleType, tmp_path: Path) -> None:
    with build_frames(plan_of(generators, "people", 12), tmp_path / "people.h5", workers=1) as frames:
        sample = frames[:]
        assert ((sample["class_of_body"] == 1).sum(axis=1) == sample["label_count"]).all()
        assert len(set(sample["label_count"].tolist())) > 2
        nobody = sample["label_count"] == 0
        assert not sample["shares"][nobody][..., 1].any()
        # floor and people fill the image between them
        np.testing.assert_allclose(sample["shares"].sum(axis=-1), 1.0, atol=1e-4)


def test_people_walk_from_step_to_step(generators: ModuleType) -> None:
    made = generators.people(1, stream(7, "scenes", 1), steps=4)
    assert made.labels["count"] > 0
    walked = np.diff(made.bodies2world[:, 1:, 0, 3], axis=0)
    np.testing.assert_allclose(np.abs(walked), 0.1)


def test_bent_fingers_are_nearer_to_the_sensor(generators: ModuleType) -> None:
    tips = np.cumsum([len(generators.THUMB_M), *[len(generators.FINGER_M)] * 4])
    seen = set()
    for index in range(40):
        made = generators.hand(index, stream(7, "scenes", index))
        posture = made.labels["posture"]
        seen.add(posture)
        if posture == "none":
            assert made.scene is None
            continue
        wrist = np.linalg.inv(made.bodies2world[0])
        tip = np.array([(wrist @ pose)[:3, 2] for pose in made.bodies2world[tips]])  # where the last bones point
        bent = np.array(generators.POSTURES[posture], bool)
        assert (tip[1:, 2][bent[1:]] < 0.0).all()
        assert (tip[1:, 2][~bent[1:]] > 0.4).all()
    assert seen == {*generators.POSTURES, "none"}


def test_bent_fingers_of_the_shadow_hand_are_nearer_to_the_sensor(generators: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    pytest.importorskip("gymnasium_robotics")
    of_name = {body.name: k for k, body in enumerate(generators.shadow()[1].bodies)}
    seen = set()
    for index in range(20):
        made = generators.shadow_hand(index, stream(7, "scenes", index))
        seen.add(made.labels["posture"])
        if made.scene is None:
            continue
        middles = (np.linalg.inv(made.camera2world) @ made.bodies2world)[:, :3, 3]
        bent_fingers = generators.POSTURES[made.labels["posture"]][1:]
        for finger, bent in zip(generators.SHADOW_FINGERS[1:], bent_fingers, strict=True):
            knuckle, tip = (middles[of_name[f"robot0:{finger.lower()}{bone}"]] for bone in ("knuckle", "distal"))
            # 45 and 25 mm of bones lie between them, and half of the last; a hand that leans by 25° takes 35 mm of it
            assert (np.linalg.norm(tip - knuckle) > 0.075) != bent
            assert tip[0] < knuckle[0] - 0.02 or not bent
    assert seen == {*generators.POSTURES, "none"}
    with build_frames(plan_of(generators, "shadow_hand", 2), tmp_path / "hand.h5", workers=1) as frames:
        assert frames[:]["shares"].sum() > 2 * 8  # of 64 zones each


def test_a_hand_that_is_not_installed_is_named(generators: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generators.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match="needs the packages mujoco and gymnasium-robotics: pip install both"):
        generators.shadow.__wrapped__()


def test_the_bytes_of_a_hand_do_not_depend_on_workers(generators: ModuleType, tmp_path: Path) -> None:
    plan = plan_of(generators, "hand", 3)
    for workers in (1, 2):
        build_frames(plan, tmp_path / f"{workers}.h5", workers=workers, shard_items=workers).close()
    assert (tmp_path / "1.h5").read_bytes() == (tmp_path / "2.h5").read_bytes()
