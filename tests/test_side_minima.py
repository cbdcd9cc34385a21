"""Views whose likelihood has side minima all around: the search finds them, or something as likely."""

import math
from typing import Any

import numpy as np
import pytest
from random_parts import KINDS, random_part

from phasemark.data import BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import export_mesh
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.likelihood.refine import refine
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.render import Background, Renderer, Views, capture

FIXED, BEARING = ("distance_m", "delta_rad"), ("distance_m", "delta_rad", "bearing_rad")
VIEWS: dict[str, tuple[tuple[int, int], int, str, int, tuple[float, float, float], dict[str, Any]]] = {
    # an arch on its edge: without the pixels that have a kink its images are alike over ten degrees
    "edge": ((212, 4), 0, "0.64:0.76:0.02", 4, (0.6857, 116.96, 0.0), {"free": FIXED}),
    "edge before a wall": (
        (411, 9), 1, "1.08:1.2:0.02", 50, (1.1464, 209.46, 0.0), {"free": FIXED, "background": Background(wall_m=2.5)}
    ),
    # a step of the bearing by a column leads from one side minimum to the next
    "columns": ((401, 5), 3, "0.64:0.76:0.02", 50, (0.7244, 133.69, 1.04), {"free": BEARING}),
}  # fmt: skip
N = 12


def part_of(seed, number):
    """Return the part of some place in a bank of random parts, as the table of random parts draws them."""
    rng = np.random.default_rng(seed)
    for _ in range(number + 1):
        part = random_part(str(rng.choice(list(KINDS))), rng)
    return part


def likelihood_of(matcher):
    return matcher._method


@pytest.mark.parametrize("name", VIEWS)
def test_nothing_is_likelier_than_the_answer(name, tmp_path):
    seed, number, distance_m, exposures, (distance, delta_deg, bearing_deg), options = VIEWS[name]
    (tmp_path / "part.ply").write_bytes(export_mesh(part_of(seed, number), "ply"))
    meshes = (MeshPlan(name="part", path=str(tmp_path / "part.ply"), unit="m"),)
    plan = BankPlan(meshes=meshes, sensor="pmd-16x16", distance_m=distance_m, delta_deg="0:358:2", layout="full")
    with build_bank(plan) as bank:
        mesh = bank.mesh("part")
        renderer = Renderer(mesh, bank.sensor, albedo=mesh.metadata["albedo"])
        truth = np.tile([distance, math.radians(delta_deg), math.radians(bearing_deg), 0.0, 0.0, 0.0], (N, 1))
        image = renderer.render_views(Views(*truth.T.copy()), background=options.get("background"))
        frames = kalman_filter(capture(image, bank.sensor, rng=np.random.default_rng(5), n_frames=exposures))
        matcher = Matcher(bank, "refine", **options)
        method, evidence = likelihood_of(matcher), Evidence.from_frames(frames.with_pooled_noise(), "ranges")
        scene, each = method._scene, np.arange(N)
        true = refine(scene.final, evidence, each, np.zeros(N, np.int64), truth, scene.settings(method._setup))
        for k, match in enumerate(matcher.match(frames)):
            places = [(match.distance_m, match.delta_rad), *((o.distance_m, o.delta_rad) for o in match.alternatives)]
            near = [
                abs(d - distance) < 0.03 and abs(math.remainder(a - truth[k, 1], 2 * math.pi)) < math.radians(6)
                for d, a in places
            ]
            # either the true view is among the explanations, or it costs so much more that it is none
            assert any(near) or true.cost[k] > match.chi2 + 25
            assert not match.accepted or near[0]
