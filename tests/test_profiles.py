"""Profile likelihoods: an accepted answer has no explanation a tolerance away, whatever its covariance says."""

import math

import numpy as np
import pytest
from random_parts import KINDS, random_part

from phasemark.data import BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import export_mesh
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.likelihood.refine import costs_at
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.render import Renderer, capture, preset

TRUTH = 1.2667, math.radians(183.52)
TOLERANCE_RAD = math.radians(6.0)


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    """A wedge whose front is flat: from 174° to 186° its image hardly changes."""
    rng = np.random.default_rng((213, 2))
    kind = str(rng.choice(list(KINDS)))
    assert kind == "wedge"
    path = tmp_path_factory.mktemp("part") / "wedge.ply"
    path.write_bytes(export_mesh(random_part(kind, rng), "ply"))
    plan = BankPlan(
        meshes=(MeshPlan(name="wedge", path=str(path), unit="m"),), sensor="pmd-16x16",
        distance_m="1.2:1.34:0.02", delta_deg="150:214:2", layout="full",
    )  # fmt: skip
    with build_bank(plan) as built:
        yield built


def frames_of(bank, exposures, n):
    renderer = Renderer(bank.mesh("wedge"), preset("pmd-16x16"), albedo=bank.mesh("wedge").metadata["albedo"])
    image = renderer.render(np.full(n, TRUTH[0]), np.full(n, TRUTH[1]))
    return kalman_filter(capture(image, bank.sensor, rng=np.random.default_rng(7), n_frames=exposures))


def rise_at(matcher, frames, k, match, offset_rad):
    """Return by how much the least cost over all distances grows when δ is turned by an offset."""
    method = matcher._method
    evidence = Evidence.from_frames(matcher.read_out(frames).without_offset().with_pooled_noise(), "ranges")
    near = np.arange(-0.03, 0.0301, 0.0005)
    view = np.zeros((len(near), 6))
    view[:, 0], view[:, 1] = match.distance_m + near, match.delta_rad + offset_rad
    frame, class_index = np.full(len(near), k), np.zeros(len(near), np.int64)
    settings = method._scene.settings(method._setup)
    return costs_at(method._scene.final, evidence, frame, class_index, view, settings).min() - match.chi2


def test_accepted_answers_rise_by_three_and_a_half_sigma_at_the_tolerance_whatever_their_covariance(bank):
    frames, matcher = frames_of(bank, 1, 40), Matcher(bank, "refine", free=("distance_m", "delta_rad"))
    narrow = 0
    for k, match in enumerate(matcher.match(frames)):
        rise = min(rise_at(matcher, frames, k, match, side * TOLERANCE_RAD) for side in (-1, 1))
        if match.accepted:
            assert rise > 3.5**2 - 0.5  # the grid of distances is not the minimum
        elif match.covariance is not None and 3 * math.sqrt(match.covariance[1, 1]) < TOLERANCE_RAD and rise < 3.5**2:
            assert match.reason in ("undetermined", "poor fit")
            narrow += 1
    assert narrow > 2  # parabolas alone would have passed these


def test_answers_that_many_exposures_determine_are_accepted(bank):
    matcher = Matcher(bank, "refine", free=("distance_m", "delta_rad"))
    accepted = [match for match in matcher.match(frames_of(bank, 200, 40)) if match.accepted]
    assert len(accepted) > 30
    assert all(abs(math.degrees(match.delta_rad - TRUTH[1])) < 6 for match in accepted)
