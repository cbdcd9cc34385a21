"""The probability of a class is the posterior's, integrated over all of its views."""

import math

import numpy as np
import pytest
import trimesh

from phasemark.data import BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import export_mesh
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.likelihood.refine import costs_at
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.render import Renderer, capture, preset

SIDES = {"post": 72, "prism": 6}
FREE = "distance_m", "delta_rad"
N = 20


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    """A post and a prism with six sides: single exposures hardly tell which of them they show."""
    folder = tmp_path_factory.mktemp("parts")
    for name, sides in SIDES.items():
        (folder / f"{name}.ply").write_bytes(export_mesh(trimesh.creation.cylinder(0.09, 0.3, sections=sides), "ply"))
    plan = BankPlan(
        meshes=tuple(MeshPlan(name=name, path=str(folder / f"{name}.ply"), unit="m") for name in SIDES),
        sensor="pmd-16x16", distance_m="0.9:1.1:0.01", delta_deg="0:359:1", layout="full",
    )  # fmt: skip
    with build_bank(plan) as built:
        yield built


def posterior(matcher, evidence, frame, class_index, distance_m, delta_rad):
    """Return the logarithm of the likelihood's mean over a grid of views."""
    method = matcher._method
    view = np.zeros((len(distance_m) * len(delta_rad), 6))
    view[:, 0], view[:, 1] = np.repeat(distance_m, len(delta_rad)), np.tile(delta_rad, len(distance_m))
    same = np.zeros(len(view), np.int64)
    settings = method._scene.settings(method._setup)
    cost = costs_at(method._scene.final, evidence, same + frame, same + class_index, view, settings)
    least = cost.min()
    return math.log(np.exp((least - cost) / 2).mean()) - least / 2


def test_odds_of_two_classes_are_those_of_their_likelihoods_integrated_over_all_views(bank):
    rng, matcher = np.random.default_rng(5), Matcher(bank, "refine", free=FREE)
    distance, off = np.linspace(0.9, 1.1, 201), []
    turns = [np.zeros(1), np.radians(np.arange(0, 60, 0.5))]  # a post has one view, and a prism those of its period
    for name in SIDES:
        renderer = Renderer(bank.mesh(name), preset("pmd-16x16"), albedo=0.8)
        image = renderer.render(rng.uniform(0.94, 1.06, N), rng.uniform(0, 2 * np.pi, N))
        frames = kalman_filter(capture(image, bank.sensor, rng=rng, n_frames=1))
        evidence = Evidence.from_frames(matcher.read_out(frames).without_offset().with_pooled_noise(), "ranges")
        for k, match in enumerate(matcher.match(frames)):
            stated = math.log(match.class_probability["post"] / match.class_probability["prism"])
            post, prism = (posterior(matcher, evidence, k, c, distance, turns[c]) for c in range(2))
            off.append(stated - (post - prism))
    # an error of one is a factor of e; a pixel that a view nearby excuses costs 25 or nothing
    assert abs(np.median(off)) < 0.3
    assert np.mean(np.abs(off) < 1.0) >= 0.85
    assert np.abs(off).max() < 6.0  # no class is given up whose likelihood is not
