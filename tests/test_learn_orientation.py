"""The orientation of a recording, learnt from frames of the landmark."""

import math

import numpy as np
import pytest
import trimesh
from random_parts import random_part

from phasemark import UsageError
from phasemark.cli import main
from phasemark.data import BankPlan, build_bank
from phasemark.data.measured.recording import ORIENTATIONS, Orientation
from phasemark.data.plans import MeshPlan
from phasemark.matcher import Matcher
from phasemark.matcher.recordings import learn_orientation
from phasemark.render import Frames, Renderer, Views, capture, preset

SENSOR = preset("vl53l5cx-8x8")
VIEW = ("distance_m", "delta_rad")


@pytest.fixture(scope="module")
def banks(tmp_path_factory):
    """Return banks of two parts without a plane of symmetry, and of a box, each built when it is first used."""
    folder, opened = tmp_path_factory.mktemp("parts"), {}
    block, post = trimesh.creation.box((0.2, 0.16, 0.06)), trimesh.creation.box((0.05, 0.05, 0.16))
    shelf = trimesh.creation.box((0.12, 0.04, 0.03)).apply_translation((0.04, 0.06, 0.1))
    block.apply_translation((0.0, 0.0, -0.05))
    post.apply_translation((0.06, 0.05, 0.04))
    meshes = {
        "handed": trimesh.boolean.union([block, post, shelf], engine="manifold"),
        "stone": random_part("stone", np.random.default_rng(5)),
        "box": trimesh.creation.box((0.1, 0.2, 0.15)),
    }

    def bank(name):
        if name not in opened:
            meshes[name].export(folder / f"{name}.ply")
            part = MeshPlan(name=name, path=str(folder / f"{name}.ply"), unit="m")
            plan = BankPlan(
                meshes=(part,), sensor="vl53l5cx-8x8", distance_m="0.42:0.58:0.02", delta_deg="0:360:4", layout="full"
            )
            opened[name] = build_bank(plan, folder / f"{name}.h5")
        return opened[name]

    yield bank
    for one in opened.values():
        one.close()


def recording(bank, true, seed, n=4):
    """Return frames as a board in some orientation prints them, of a camera that moves slowly."""
    rng = np.random.default_rng(seed)
    distance_m = np.linspace(rng.uniform(0.45, 0.55), rng.uniform(0.45, 0.55), n)
    delta_rad = rng.uniform(0, 2 * math.pi) + np.linspace(0, 0.5, n)
    images = Renderer(bank.mesh(bank.classes[0]), SENSOR).render_views(
        Views.broadcast(distance_m=distance_m, delta_rad=delta_rad)
    )
    frames = capture(images, SENSOR, rng=rng, n_frames=1)
    back = true if true.flip_h else Orientation(rotate=(360 - true.rotate) % 360)
    return Frames(back.apply(frames.range_m), flags=back.apply(frames.flags), sensor=SENSOR)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_mirroring_first_and_turning_then_is_undone_by_the_inverse(orientation):
    image = np.arange(9).reshape(3, 3)
    back = orientation if orientation.flip_h else Orientation(rotate=(360 - orientation.rotate) % 360)
    assert (orientation.apply(back.apply(image)) == image).all()
    assert len({str(one.apply(image)) for one in ORIENTATIONS}) == 8


@pytest.mark.soak
@pytest.mark.parametrize(("name", "seed"), [("handed", 1), ("stone", 0)])
def test_the_orientation_of_a_part_without_symmetry_is_learnt(banks, name, seed, monkeypatch):
    match, matched = Matcher.match, []
    monkeypatch.setattr(Matcher, "match", lambda self, frames: matched.append(len(frames)) or match(self, frames))
    true = ORIENTATIONS[(3 * seed + 1) % 8]
    learnt = learn_orientation(Matcher(banks(name), "refine", free=VIEW), recording(banks(name), true, seed, 12))
    assert learnt.left == (true,)
    assert learnt.n_frames == 10
    # ten frames in each of eight orientations are 80: six in each, and four in the one that is left then, are 52
    assert sum(matched) <= 52


def test_a_symmetric_box_leaves_the_mirrored_orientation_open(banks):
    true, box = Orientation(rotate=90), banks("box")
    learnt = learn_orientation(Matcher(box, "refine", free=VIEW), recording(box, true, 3, 2))
    assert {true, Orientation(True, 270)} <= set(learnt.left)
    with pytest.raises(UsageError, match="by a Matcher of the method 'refine'"):
        learn_orientation(Matcher(box), recording(box, true, 3, 2))


def test_frames_that_nothing_explains_and_a_single_frame_do_not_decide(banks):
    matcher = Matcher(banks("handed"), "refine", free=VIEW)
    noise = Frames(np.random.default_rng(0).uniform(0.3, 1.5, (1, 1, 8, 8)), sensor=SENSOR)
    learnt = learn_orientation(matcher, noise)
    assert len(learnt.left) == 8
    assert learnt.n_explained == 0
    assert len(learn_orientation(matcher, recording(banks("handed"), ORIENTATIONS[3], 1)[:1]).left) > 1


def match_command(bank, true, path):
    """Save a recording; return the command that matches it."""
    frames = recording(bank, true, 1, 2)
    np.savez(path, range=frames.range_m[:, 0], unit="m", quantity="range")
    return ["match", str(bank.path), str(path), "--on", "ranges", "--no-background", "--moving", "--fix", "bearing"]


def test_match_learns_the_orientation_and_says_which_options_it_is(banks, tmp_path, capsys):
    command = [*match_command(banks("handed"), Orientation(True, 90), tmp_path / "a.npz"), "--json"]
    assert main([*command, "--learn-orientation"]) == 0
    learnt = capsys.readouterr()
    assert (
        "the orientation is --flip-h --rotate 90, by 2 of 2 frames that show the landmark, with odds of" in learnt.err
    )
    assert main([*command, "--flip-h", "--rotate", "90"]) == 0
    assert capsys.readouterr().out == learnt.out


def test_match_refuses_a_recording_that_leaves_orientations_open(banks, tmp_path, capsys):
    assert main([*match_command(banks("box"), Orientation(), tmp_path / "a.npz"), "--learn-orientation"]) == 3
    said = capsys.readouterr()
    assert not said.out
    assert "orientations open: " in said.err
    assert "--flip-h" in said.err


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--method", "nearest"], "goes with --method refine"),
        (["--flip-h"], "leave --flip-h, --flip-v and --rotate out"),
    ],
)
def test_options_that_contradict_the_learning_are_refused(banks, tmp_path, capsys, options, reason):
    command = match_command(banks("box"), Orientation(), tmp_path / "a.npz")[:3]
    assert main([*command, "--learn-orientation", *options]) == 2
    assert reason in capsys.readouterr().err
