"""Unknown things in view, other parts and mirrored images: what is not there is not accepted, or not without a word."""

import math

import numpy as np
import pytest
from programs.random_parts_table import SETTINGS, bank_of, draw_cases, frames_of, is_grossly_wrong, renderers_of

from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, kalman_filter
from phasemark.render import Renderer, Views, capture

MORE_THINGS = ("post", 24, 5), ("before", 24, 0), ("second", 24, 8), ("behind", 24, 5), ("board", 24, 0)


@pytest.fixture(scope="module")
def parts():
    with bank_of((41, 0), 2, "pmd-16x16") as bank:
        yield bank, renderers_of(bank)


@pytest.fixture(scope="module")
def bank_of_cone():
    with build_bank(BankPlan(classes=("cone",), distance_m="0.8:1.2:0.01", delta_deg="0:179:1")) as bank:
        yield bank


def answers(parts, setting, n=12, seed=5):
    """Return what each accepted answer says of a mirror, the wrong among the accepted, and all reasons."""
    bank, renderers = parts
    like = {
        "sensor": "pmd-16x16", "bank_seed": (41, 0), "per_bank": 2, "setting": setting, "frame_seed": (seed,),
        "exposures": 50,
    }  # fmt: skip
    cases = draw_cases(bank, like, n)
    matcher, mirrored, wrong, reasons = Matcher(bank, "refine", **SETTINGS[setting]), [], [], []
    for name in bank.classes:
        own = [case for case in cases if case.class_name == name]
        for case, match in zip(own, matcher.match(frames_of(bank, renderers, own)), strict=True):
            reasons.append(match.reason)
            if match.accepted:
                mirrored.append(match.may_be_mirrored)
                wrong += [case] if is_grossly_wrong(bank, case, match) else []
    return mirrored, wrong, reasons


@pytest.mark.parametrize(
    ("things", "n", "least"),
    [("post", 12, 2), *(pytest.param(*more, marks=pytest.mark.soak) for more in MORE_THINGS)],
)
def test_unknown_things_are_not_taken_for_a_landmark(parts, things, n, least):
    accepted, wrong, _ = answers(parts, f"unknown-{things}", n)
    assert not wrong
    assert len(accepted) >= least


def test_parts_of_no_bank_are_refused(parts):
    accepted, _, _ = answers(parts, "stranger")
    assert len(accepted) <= 1  # 2 % of 12


@pytest.mark.parametrize("setting", ["mirrored", "mirrored-default"])
def test_a_mirrored_image_is_refused_or_named(parts, setting):
    accepted, _, _ = answers(parts, setting)
    assert all(accepted)


def test_a_part_without_a_plane_of_symmetry_shows_that_its_image_is_not_mirrored():
    with bank_of((51, 0), 4, "pmd-16x16", distance_m="0.92:1.08:0.02") as bank:
        name = next(part for part in bank.classes if "stone" in part)
        image = renderers_of(bank)[name].render_views(Views.broadcast(1.0, np.linspace(0, 6, 12)))
        frames = kalman_filter(capture(image, bank.sensor, rng=np.random.default_rng(2), n_frames=50))
        matches = Matcher(bank, "refine", free=("distance_m", "delta_rad")).match(frames)
    told = [match.may_be_mirrored for match in matches if match.accepted]
    assert len(told) >= 6
    assert np.mean(told) < 0.3


def test_p_values_of_edges_and_inside_together_are_uniform(bank_of_cone):
    bank, n = bank_of_cone, 300
    rng = np.random.default_rng(8)
    views = Views.broadcast(rng.uniform(0.85, 1.15, n), rng.uniform(0, math.pi, n))
    image = Renderer(build_mesh(catalog()["cone"]), bank.sensor).render_views(views)
    frames = kalman_filter(capture(image, bank.sensor, rng=rng, n_frames=50))
    p = Matcher(bank, "refine", free=("distance_m", "delta_rad")).match(frames).p_value
    for share in (0.1, 0.5, 0.9):  # 99.9 % of a binomial share lie within 3.3 standard deviations
        assert abs(np.mean(p < share) - share) < 3.3 * math.sqrt(share * (1 - share) / n)
