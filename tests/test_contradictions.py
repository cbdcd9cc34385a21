"""Pixels that a solution contradicts are excused by one view nearby, not each by another."""

import math
from typing import Any

import numpy as np
import pytest
from random_parts import KINDS, random_part

from phasemark.data import BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import export_mesh
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.likelihood.refine import costs_at, refine
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MAY_RETURN_COVERAGE, MUST_RETURN_COVERAGE
from phasemark.render import Renderer, Views, capture

N = 8
WEDGE = 1.3717, math.radians(14.65), math.radians(0.22)
ARCH = 1.28906, math.radians(125.574), math.radians(1.169)
"""Through the opening of the arch nothing is seen where the wedge returns; where both return the ranges agree."""


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    folder, rng, meshes = tmp_path_factory.mktemp("parts"), np.random.default_rng((921, 5)), []
    for name in ("arch", None, "wedge"):
        kind = str(rng.choice(list(KINDS)))
        part = random_part(kind, rng)
        if name:
            assert kind == name
            (folder / f"{name}.ply").write_bytes(export_mesh(part, "ply"))
            meshes.append(MeshPlan(name=name, path=str(folder / f"{name}.ply"), unit="m"))
    plan = BankPlan(
        meshes=tuple(meshes), sensor="pmd-16x16", distance_m="1.2:1.44:0.02", delta_deg="0:358:2", layout="full"
    )
    with build_bank(plan) as built:
        yield built


def test_fits_cost_what_one_view_nearby_contradicts(bank):
    renderers = [
        Renderer(bank.mesh(name), bank.sensor, albedo=bank.mesh(name).metadata["albedo"]) for name in bank.classes
    ]
    image = renderers[1].render(np.full(N, WEDGE[0]), np.full(N, WEDGE[1]), np.full(N, WEDGE[2]))
    frames = kalman_filter(capture(image, bank.sensor, rng=np.random.default_rng(3), n_frames=50))
    matcher = Matcher(bank, "refine")
    evidence = Evidence.from_frames(matcher.read_out(frames).without_offset().with_pooled_noise(), "ranges")
    likelihood: Any = matcher._method
    scene, each = likelihood._scene, np.arange(N)
    settings = scene.settings(likelihood._setup)

    wedge = np.tile([*WEDGE, 0.0, 0.0, 0.0], (N, 1))
    true = refine(scene.final, evidence, each, np.ones(N, np.int64), wedge, settings)
    # a true view is excused: no fit costs more than the view that its frame was made at
    assert (true.cost <= costs_at(scene.final, evidence, each, np.ones(N, np.int64), wedge, settings) + 9).all()

    arch = np.tile([*ARCH, 0.0, 0.0, 0.0], (N, 1))
    fits = refine(scene.final, evidence, each, np.zeros(N, np.int64), arch, settings)
    rng = np.random.default_rng(4)
    for k in range(N):
        off = rng.standard_normal((600, 3))
        off *= 3 * rng.uniform(size=(600, 1)) ** (1 / 3) / np.linalg.norm(off, axis=1, keepdims=True)
        view = np.vstack([np.zeros(3), off @ np.linalg.cholesky(fits.covariance[k]).T]) + fits.view[k, :3]
        coverage = renderers[0].render_views(Views.broadcast(*view.T)).coverage.reshape(len(view), -1)
        seen = evidence.seen
        wrong = (seen.returned[k] & (coverage < MAY_RETURN_COVERAGE)) | (
            seen.not_returned[k] & (coverage > MUST_RETURN_COVERAGE)
        )
        fewest = wrong.sum(axis=1).min()
        assert fewest >= 8
        assert fits.cost[k] >= DISAGREEMENT * fewest
