"""Frame sets of scenes: the file holds the scenes that a generator makes, the same however it is built."""

from __future__ import annotations

import hashlib
import importlib
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
import xarray
from own_generators import WALL, at

from phasemark import InputFileError, UsageError
from phasemark.cli import main
from phasemark.data import build_frames, open_frames
from phasemark.data.commands.interruption import Interruption
from phasemark.data.export import export_frames
from phasemark.data.files import write_checksum
from phasemark.data.frames import FrameSet
from phasemark.data.partial_outputs import build_part, estimate_build, merge_parts
from phasemark.data.plans import SceneFramesPlan, planned_size
from phasemark.data.plans.generated_scene import imported_generator
from phasemark.data.seeds import stream
from phasemark.data.verify import verify_frames
from phasemark.matcher.plan_kinds import check_plan, plan_example
from phasemark.render import Flag, Scene, SceneRenderer, capture, preset
from phasemark.render.direct.targets import Status


def plan_of(generator: str, n: int = 1, **about: Any) -> SceneFramesPlan:
    """A plan of a generator of the tests' own module."""
    scenes = {"generator": f"own_generators:{generator}", "n": n, **about.pop("scenes", {})}
    return SceneFramesPlan(scenes=scenes, **{"seed": 3, "frames_per_view": 2, **about})


ROOM = plan_of(
    "room", 9, sensor="vl53l8cx-8x8", scenes={"classes": ["wall", "ball"], "bodies": 3, "options": {"nearest": 0.9}}
)
DRIVE = plan_of("drive", 4, scenes={"classes": ["ball", "other"], "bodies": 2, "steps": 3}, variants=["mixed", "shot"])


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scenes") / "scenes.h5"
    build_frames(ROOM, path, workers=1).close()
    return path


@pytest.fixture(scope="module")
def frames(path: Path) -> Iterator[FrameSet]:
    with open_frames(path) as opened:
        yield opened


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FrameSet]:
    with build_frames(DRIVE, tmp_path_factory.mktemp("drive") / "drive.h5", workers=1) as opened:
        yield opened


# --- the same bytes, however they are built ---------------------------------------------------------------------------


def test_the_bytes_do_not_depend_on_workers_shards_or_parts(path: Path, tmp_path: Path) -> None:
    build_frames(ROOM, tmp_path / "two.h5", workers=2, shard_items=2).close()
    assert (tmp_path / "two.h5").read_bytes() == path.read_bytes()
    parts = [build_part(ROOM, (k, 2), tmp_path / f"part-{k}.h5", workers=1) for k in (1, 2)]
    assert merge_parts(parts, tmp_path / "merged.h5").read_bytes() == path.read_bytes()


def test_parts_are_merged_without_their_generator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = build_part(plan_of("one_wall"), (1, 1), tmp_path / "part.h5", workers=1)
    monkeypatch.setattr("phasemark.data.plans.scene_frames_plan.imported_generator", lambda name: 1 / 0)
    assert merge_parts([part], tmp_path / "merged.h5").exists()


def test_verify_makes_scenes_again_if_the_generator_is_named(path: Path) -> None:
    assert verify_frames(path)["rendered_again"] == 0  # it would run a program
    assert verify_frames(path, sample=4, generator="own_generators:room")["rendered_again"] == 4
    with pytest.raises(UsageError, match="its generator is own_generators:room, not 'own_generators:drive'"):
        verify_frames(path, generator="own_generators:drive")


@pytest.mark.parametrize(
    ("name", "number", "message"),
    [
        ("label_front_m", 1.0, "'label_front_m' of item 2 is not what rendering it again gives"),
        ("label_what", b"cat", "'label_what' of item 2 is b'cat', and b'2 b\\\\xc3\\\\xa4lle' when made again"),
        ("shares", 0.5, "'shares' of item 2"),
        ("step", 1, "'step'.* has numbers outside 0 … 0"),
    ],
)
def test_verify_finds_a_truth_that_was_changed(
    path: Path, tmp_path: Path, name: str, number: Any, message: str
) -> None:
    changed = tmp_path / "changed.h5"
    changed.write_bytes(path.read_bytes())
    with h5py.File(changed, "r+") as file:
        file[name][2] = number
    write_checksum(changed)
    with pytest.raises(InputFileError, match=message):
        verify_frames(changed, sample=9, generator="own_generators:room")


# --- what lies in the file -------------------------------------------------------------------------------------------


def test_the_range_without_noise_of_a_wall_is_its_closed_form(tmp_path: Path) -> None:
    # a pixel's phasor is the mean over its area: it differs from the range of the ray of its centre by
    # 2e-4 of that at most, the second order in half a pixel of 1.4°
    with build_frames(plan_of("one_wall"), tmp_path / "wall.h5", workers=1) as found:
        expected = 0.95 / found.sensor.axis_cosine()
        np.testing.assert_allclose(found[0]["range_mixed_m"], expected, rtol=2e-4)
        np.testing.assert_array_equal(found[0]["coverage"], 1.0)


@pytest.mark.parametrize("sensor", ["pmd-16x16", "vl53l8cx-8x8"])
def test_an_empty_scene_returns_nothing_and_its_background_alone(tmp_path: Path, sensor: str) -> None:
    plan = plan_of("room", 4, sensor=sensor, scenes={"classes": ["wall", "ball"], "bodies": 3})
    with build_frames(plan, tmp_path / "empty.h5", workers=1) as found:
        empty = found[6]
        assert empty["label_what"] == "nothing"
        assert math.isnan(empty["label_front_m"])
        assert (empty["flags"] & int(Flag.NO_RETURN)).all()
        assert not empty["shares"].any()
        assert not empty["coverage"].any()
        assert np.isnan(empty["bodies2world"]).all()
        assert (empty["class_of_body"] == -1).all()
        if "target_status" in empty:  # a false alarm of the dark counts is a few in 10⁴ zones
            assert (empty["target_status"] != Status.VALID).mean() > 0.99
    with build_frames(plan_of("background_alone", sensor=sensor), tmp_path / "wall.h5", workers=1) as found:
        np.testing.assert_allclose(found[0]["range_mixed_m"], 1.25 / found.sensor.axis_cosine(), rtol=1e-3)
        assert not found[0]["coverage"].any()


def test_the_file_holds_what_renderer_and_sensor_make_of_each_scene(frames: FrameSet) -> None:
    sensor = preset("vl53l8cx-8x8")
    for index in (1, 8):
        made = ROOM.generate(index)
        assert made.scene is not None
        renderer = SceneRenderer(made.scene, sensor)
        counts = renderer.histograms(made.camera2world, made.bodies2world)
        exact = renderer.phasors(made.camera2world, made.bodies2world)
        shots = capture(counts, sensor, rng=stream(3, "frames.noise", 0), n_frames=2, first_view=index)
        sample = frames[2 * index : 2 * index + 2]
        np.testing.assert_array_equal(sample["histogram"], shots.counts[0])
        np.testing.assert_array_equal(sample["target_distance_m"], shots.targets.distance_m[0].astype("f4"))
        np.testing.assert_array_equal(sample["range_m"], shots.ranges.range_m[0].astype("f4"))
        np.testing.assert_array_equal(sample["range_mixed_m"][0], exact.range_m[0].astype("f4"))
        assert counts.shares is not None
        balls = counts.shares[0, ..., 1:].sum(axis=-1)
        np.testing.assert_allclose(sample["shares"][0, ..., 1], balls, atol=1e-6)  # float32
        np.testing.assert_allclose(sample["shares"][0].sum(axis=-1), sample["coverage"][0], atol=1e-6)
        b = len(made.scene)
        np.testing.assert_array_equal(sample["bodies2world"][0, :b], made.bodies2world)
        assert sample["class_of_body"][0].tolist() == ([0] + [1] * (b - 1) + [-1] * (3 - b))
        assert sample["label_front_m"].tolist() == [made.labels["front_m"]] * 2
        assert sample["label_what"].tolist() == [made.labels["what"]] * 2
        assert 0.9 <= made.labels["front_m"] <= 1.5


def test_a_sequence_has_its_steps_in_order_and_one_split(drive: FrameSet) -> None:
    assert drive.truth["sequence"].tolist() == np.repeat(range(4), 3).tolist()
    assert drive.truth["step"].tolist() == [0, 1, 2] * 4
    split = drive.truth["split_index"].reshape(4, 3)
    assert (split == split[:, :1]).all()
    for view in range(12):
        sample = drive[2 * view]
        way = 0.1 * sample["step"]
        assert sample["label_way_m"] == way
        assert sample["camera2world"][0, 3] == way
        corner = sample["range_mixed_m"][0, 0] * drive.sensor.axis_cosine()[0, 0]
        assert corner == pytest.approx(2.0 - way, abs=1e-3)  # the wall, beside the ball
    rolls = np.diff(drive[::2]["bodies2world"].reshape(4, 3, 2, 4, 4)[..., 1, 1, 3], axis=1)
    np.testing.assert_allclose(rolls, 0.1, atol=1e-12)


def test_a_body_of_no_class_is_other_where_a_plan_has_it(drive: FrameSet) -> None:
    assert drive.classes == ("ball", "other")
    assert drive[0]["class_of_body"].tolist() == [1, 0]


def test_xarray_names_classes_and_units(path: Path) -> None:
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        assert data["shares"].dims == ("view", "row", "col", "body_class")
        assert data["body_class"].values.tolist() == ["wall", "ball"]
        assert data["bodies2world"].dims == ("view", "body", "pose_row", "pose_col")


def test_sizes_are_known_before(path: Path) -> None:
    size = planned_size(ROOM)
    assert (size["views"], size["frames"]) == (9, 18)
    header = path.stat().st_size - size["bytes"]
    assert 0 < header < 1 << 16
    assert estimate_build(ROOM, trial_seconds=0.1)["bytes"] == path.stat().st_size


def test_what_is_not_kept_is_not_there(tmp_path: Path) -> None:
    plan = ROOM.model_copy(update={"keep": ("targets",), "variants": ()}).with_scenes(2)
    with build_frames(plan, tmp_path / "lean.h5", workers=1) as found:
        assert found.info()["fields"] == [
            "range",
            "flags",
            *(f"target_{k}" for k in ("distance", "sigma", "signal", "status")),
            "coverage",
        ]
        assert found.targets().distance_m.shape == (4, 1, 8, 8, 4)
        with pytest.raises(UsageError, match="holds no histograms: build it with 'histograms' in 'keep'"):
            found.histograms()


def test_a_mesh_that_a_generator_changes_is_analysed_again(tmp_path: Path) -> None:
    with build_frames(plan_of("changes_a_mesh", 3), tmp_path / "blocks.h5", workers=1) as found:
        depth = found[::2]["range_mixed_m"][:, 8, 8] * found.sensor.axis_cosine()[8, 8]
        np.testing.assert_allclose(depth, [2.0, 1.9, 1.8], rtol=2e-4)


def test_a_mesh_returns_light_as_each_scene_says(tmp_path: Path) -> None:
    """On the axis a wall of albedo 0.5 is brighter by 1 + g / 0.5 with a share g of retroreflected light."""
    plan = plan_of("brighter", 3, variants=["mixed", "shot"])
    with build_frames(plan, tmp_path / "one.h5", workers=1) as found:
        amplitude = found[::2]["amplitude_e"][:, 6:10, 6:10].mean(axis=(1, 2))
    np.testing.assert_allclose(amplitude / amplitude[0], [1, 3, 5], rtol=2e-2)
    build_frames(plan, tmp_path / "two.h5", workers=2, shard_items=1).close()
    assert (tmp_path / "two.h5").read_bytes() == (tmp_path / "one.h5").read_bytes()


def test_scenes_come_from_files_with_cameras_and_labels(tmp_path: Path) -> None:
    for k, x in enumerate((1.05, 1.55)):
        trimesh.Scene({"wall": trimesh.creation.box((0.1, 6, 6), transform=at(x))}).export(tmp_path / f"{k}.glb")
    (tmp_path / "plan.toml").write_text(
        "frames_per_view = 1\nseed = 1\n[scenes]\nclasses = ['wall']\nsteps = 2\nlist = [\n"
        + "".join(
            f"{{ path = '{k}.glb', labels = {{ number = {k} }}, cameras = [{{ position_m = [0, 0, 0] }},"
            " { position_m = [0.5, 0, 0], yaw_deg = 180 }] },\n"
            for k in range(2)
        )
        + "]\n"
    )
    assert main(["frames", "build", str(tmp_path / "plan.toml"), "--out", str(tmp_path / "files.h5")]) == 0
    with open_frames(tmp_path / "files.h5") as found:
        assert found[:]["label_number"].tolist() == [0, 0, 1, 1]
        depth = found[:]["range_mixed_m"][:, 8, 8] * found.sensor.axis_cosine()[8, 8]
        np.testing.assert_allclose(depth[[0, 2]], [1.0, 1.5], rtol=2e-4)
        assert (found[:]["coverage"][[1, 3]] == 0).all()  # looking away from the wall
    assert verify_frames(tmp_path / "files.h5", sample=2)["rendered_again"] == 2
    (tmp_path / "1.glb").write_bytes((tmp_path / "0.glb").read_bytes())
    with pytest.raises(UsageError, match="the listed files are not as it was"):
        verify_frames(tmp_path / "files.h5", sample=2)


def test_a_file_with_y_up_is_turned(tmp_path: Path) -> None:
    high = trimesh.creation.box((2.0, 0.1, 2.0), transform=at(0.0, 3.0))  # a ceiling 2.95 m above, y up
    trimesh.Scene({"ceiling": high}).export(tmp_path / "ceiling.glb")
    cameras = [{"position_m": (0.0, 0.0, 1.0), "pitch_deg": -90.0}]
    scenes = {"list": [{"path": str(tmp_path / "ceiling.glb"), "up": "y", "cameras": cameras}]}
    with build_frames(SceneFramesPlan(scenes=scenes), tmp_path / "up.h5", workers=1) as found:
        np.testing.assert_allclose(found[0]["range_mixed_m"] * found.sensor.axis_cosine(), 1.95, rtol=2e-4)


# --- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        ({}, "give 'generator' = \"module:function\" or 'list' = [files], got neither"),
        ({"generator": "a:b"}, "'n' is missing"),
        ({"generator": "ab", "n": 1}, "'generator' must be MODULE:NAME"),
        ({"generator": "a:b", "n": 0}, "'scenes.n' must be greater than or equal to 1, got 0"),
        ({"generator": "a:b", "n": 1, "classes": ["a", "a"]}, "'classes' must not repeat"),
        ({"generator": "a:b", "n": 1, "colour": 1}, "colour"),
        ({"list": [{"path": "a.glb", "cameras": []}]}, "cameras"),
        ({"list": [{"path": "a.glb", "cameras": [{"position_m": [0, 0, 0]}]}], "n": 3}, "'n' must be left out"),
    ],
)
def test_a_plan_that_cannot_be_is_refused_by_its_key(scenes: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as caught:
        SceneFramesPlan(scenes=scenes)
    assert message.split("'")[-1] in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("generator", "about", "message"),
    [
        ("nowhere", {}, "the generator 'own_generators:nowhere' cannot be imported"),
        ("NOT_CALLABLE", {}, "the generator 'own_generators:NOT_CALLABLE' must be callable, got int"),
        ("returns_a_scene", {}, "scene 0: the generator .* must return a GeneratedScene, got an object of type Scene"),
        ("returns_none", {}, "scene 0: the generator .* must return a GeneratedScene, got None"),
        ("nan_pose", {}, "scene 0: 'camera2world' must be finite"),
        ("nan_body", {}, "scene 0: pose of body 'wall' must be finite"),
        (
            "raises_at_3",
            {},
            r"scene 3 \(plan.generate\(3\) repeats it\): the generator .* raised ZeroDivisionError: no luck",
        ),
        ("other_labels_at_2", {}, "scene 2: labels must be those of scene 0, count, got number"),
        ("text_at_2", {}, "scene 2: the label 'count' must be a number as in scene 0, got a text"),
        ("a_lamp", {"classes": ["wall"]}, "scene 0: the body 'lamp' is of none of the classes wall"),
        ("a_lamp", {"bodies": 1}, "scene 0: has 2 bodies, more than 'bodies' = 1"),
        ("two_steps", {}, "scene 0: 'camera2world' has 2 poses for 'steps' = 1"),
        ("inside_the_wall", {}, "scene 0 of the plan cannot be rendered: in frame 0 the lens is inside body 'wall'"),
        ("no_labels", {}, "scene 0: 'labels' must be a mapping from names, got NoneType"),
        ("half_a_letter", {}, "scene 0: the label 'what' must be text that UTF-8 can hold"),
        ("too_large", {}, "scene 0: the label 'count' must be finite, or NaN where it is not there, got inf"),
        ("draws_elsewhere", {}, "scene 0: .* made another scene when it was called again"),
        ("room", {"options": {"colour": 1}}, "scene 0 .* raised TypeError: .* unexpected keyword argument 'colour'"),
    ],
)
def test_a_generator_that_is_wrong_is_named_with_its_scene(
    tmp_path: Path, generator: str, about: dict[str, Any], message: str
) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        build_frames(plan_of(generator, 4, scenes=about), tmp_path / "bad.h5", workers=1, shard_items=1)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "bad.h5").exists()


def test_a_generator_is_what_its_function_and_the_module_that_names_it_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    texts = {
        "makes_it": "import functools\ndef made(index, rng, far=1): ...\npart = functools.partial(made, far=2)\n",
        "names_it": "from makes_it import made\nimport functools\nother = functools.partial(made, far=3)\n",
    }

    def hashes() -> list[str]:
        for name, text in texts.items():
            (tmp_path / f"{name}.py").write_text(text)
            monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        return [imported_generator(text)[1] for text in ("makes_it:made", "makes_it:part", "names_it:other")]

    first = hashes()
    assert first[0] == first[1] == hashlib.sha256((tmp_path / "makes_it.py").read_bytes()).hexdigest()
    texts["names_it"] += "# changed\n"
    second = hashes()
    assert [old == new for old, new in zip(first, second, strict=True)] == [True, True, False]
    texts["makes_it"] += "# changed\n"
    assert not set(hashes()) & {*first, *second}


def test_the_traceback_of_a_generator_begins_in_its_own_code() -> None:
    with pytest.raises(UsageError) as caught:
        plan_of("raises_at_3", 4).generate(3)
    (note,) = caught.value.__notes__
    assert "own_generators.py" in note
    assert "/data/plans/" not in note


def test_a_plan_runs_a_program_only_if_it_is_named_or_trusted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text("[scenes]\ngenerator = 'own_generators:one_wall'\nn = 2\n")
    out = str(tmp_path / "scenes.h5")
    assert main(["frames", "build", str(plan), "--out", out]) == 2
    assert "name it with --generator own_generators:one_wall, or give --trust-plan" in capsys.readouterr().err
    assert main(["frames", "build", str(plan), "--out", out, "--generator", "own_generators:one_wall"]) == 0
    assert main(["frames", "build", str(plan), "--out", out, "--trust-plan", "--views", "3", "--force"]) == 0
    assert main(["frames", "verify", out, "--generator", "own_generators:one_wall", "--sample", "1"]) == 0
    assert main(["frames", "show", out, "--index", "2", "--out", str(tmp_path / "frame.png")]) == 0
    capsys.readouterr()
    assert main(["frames", "info", out, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["scenes"] == 3


def test_the_example_of_a_plan_is_one(tmp_path: Path) -> None:
    (tmp_path / "scenes.toml").write_text(plan_example("scenes"))
    kind, plan = check_plan(tmp_path / "scenes.toml")
    assert kind == "scenes"
    assert isinstance(plan, SceneFramesPlan)
    assert plan.views == 1000


# --- exports ---------------------------------------------------------------------------------------------------------


def test_exports_hold_labels_and_refuse_what_needs_landmarks(frames: FrameSet, tmp_path: Path) -> None:
    with np.load(export_frames(frames, tmp_path / "frames.npz", "npz")) as found:
        assert found["label_what"].tolist() == frames[:]["label_what"].tolist()
        assert found["sequence"].tolist() == frames.truth["sequence"][frames.view_index].tolist()
    export_frames(frames, tmp_path / "frames.jsonl", "jsonl")
    first = json.loads((tmp_path / "frames.jsonl").read_text().splitlines()[6])
    assert first["truth"]["label_what"] == "nothing"
    assert first["truth"]["label_front_m"] is None
    with pytest.raises(UsageError, match="for a set of scenes, got 'bop'"):
        export_frames(frames, tmp_path / "bop", "bop")


def test_a_label_of_several_words_and_lines_is_one_word_of_a_comment(tmp_path: Path) -> None:
    with build_frames(plan_of("text_of_two_lines"), tmp_path / "set.h5", workers=1) as found:
        path = export_frames(found, tmp_path / "frames.csv", "csv")
    told = [line for line in path.read_text().splitlines() if line.startswith("# frame=")]
    label = dict(word.split("=", 1) for word in told[0].split()[1:])["label_what"]
    assert json.loads(label) == "a b\n1,2,3 split=test"
    assert len(path.read_text().splitlines()) == 2 + 2 * len(told)


def test_sigterm_within_a_generator_ends_the_program(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as caught, Interruption():
        plan_of("is_terminated").generate(0)
    assert caught.value.code == 143


def test_a_scene_of_one_name_twice_cannot_be_made() -> None:
    with pytest.raises(UsageError, match="two bodies are named 'wall'"):
        Scene([WALL, WALL])
