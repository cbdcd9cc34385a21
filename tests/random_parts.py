"""Random landmark parts: prisms, walls, furniture and irregular bodies, each drawn from a generator."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import trimesh

_Size = tuple[float, float, float]
_ORIGIN = (0.0, 0.0, 0.0)
_WIDTHS_M = _HEIGHTS_M = (0.15, 0.35)
_AXES_APART_M = (0.05, 0.12)


def _box(size: _Size, at: _Size = _ORIGIN, turn_rad: float = 0.0) -> trimesh.Trimesh:
    """Return a box about `at`, turned about its vertical axis."""
    mesh: trimesh.Trimesh = _turned(trimesh.creation.box(size), turn_rad).apply_translation(at)
    return mesh


def _post(sides: int, radius: float, height: float, at: _Size = _ORIGIN) -> trimesh.Trimesh:
    """Return an upright prism with a regular base about `at`."""
    mesh: trimesh.Trimesh = trimesh.creation.cylinder(radius, height, sections=sides).apply_translation(at)
    return mesh


def _turned(mesh: trimesh.Trimesh, turn_rad: float) -> trimesh.Trimesh:
    """Return the mesh turned about the vertical axis through the origin."""
    return mesh.apply_transform(trimesh.transformations.rotation_matrix(turn_rad, (0, 0, 1)))


def _union(*bodies: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh: trimesh.Trimesh = trimesh.boolean.union(bodies, engine="manifold")
    return mesh


def _difference(body: trimesh.Trimesh, *others: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh: trimesh.Trimesh = trimesh.boolean.difference([body, *others], engine="manifold")
    return mesh


def _prism(rng: np.random.Generator) -> trimesh.Trimesh:
    return _post(int(rng.integers(3, 13)), 0.5, 1.0)


def _beside(rng: np.random.Generator, size: _Size) -> trimesh.Trimesh:
    """Return a box whose middle lies 0.4 from the axis, in a random direction and at a random height."""
    height = (1 - size[2]) / 2
    return _turned(_box(size, (0.4, 0, rng.uniform(-height, height))), rng.uniform(0, 2 * math.pi))


def _prism_rib(rng: np.random.Generator) -> trimesh.Trimesh:
    return _union(_prism(rng), _beside(rng, (rng.uniform(0.4, 0.7), rng.uniform(0.06, 0.2), rng.uniform(0.5, 1.0))))


def _prism_notch(rng: np.random.Generator) -> trimesh.Trimesh:
    return _difference(
        _prism(rng), _beside(rng, (rng.uniform(0.3, 0.5), rng.uniform(0.15, 0.4), rng.uniform(0.3, 0.9)))
    )


def _prism_boss(rng: np.random.Generator) -> trimesh.Trimesh:
    radius, height, far = rng.uniform(0.15, 0.3), rng.uniform(0.2, 0.5), rng.uniform(0.0, 0.3)
    return _union(_prism(rng), _turned(_post(12, radius, 2 * height, (far, 0, 0.5)), rng.uniform(0, 2 * math.pi)))


def _bracket(rng: np.random.Generator) -> trimesh.Trimesh:
    thick, arm = rng.uniform(0.04, 0.2), rng.uniform(0.3, 1.0)
    return _union(
        _box((thick, 1, 1)), _box((arm, thick, rng.uniform(0.4, 1.0)), ((arm - thick) / 2, (thick - 1) / 2, 0))
    )


def _tee(rng: np.random.Generator) -> trimesh.Trimesh:
    thick, arm = rng.uniform(0.04, 0.2), rng.uniform(0.3, 1.0)
    return _union(_box((thick, 1, 1)), _box((arm, thick, 1), ((arm - thick) / 2, rng.uniform(-0.3, 0.3), 0)))


def _cross(rng: np.random.Generator) -> trimesh.Trimesh:
    thick = rng.uniform(0.06, 0.3)
    return _union(_box((thick, 1, 1)), _box((rng.uniform(0.5, 1.0), thick, rng.uniform(0.5, 1.0))))


def _wedge(rng: np.random.Generator) -> trimesh.Trimesh:
    depth, top = rng.uniform(0.4, 1.0), rng.uniform(0.0, 0.6)
    foot = [(x, y, -0.5) for x in (0, depth) for y in (-0.5, 0.5)]
    mesh: trimesh.Trimesh = trimesh.convex.convex_hull(
        np.array([*foot, *((x, y, 0.5) for x in (0, top * depth) for y in (-0.5, 0.5))])
    )
    return mesh


def _chair(rng: np.random.Generator) -> trimesh.Trimesh:
    leg, seat, depth = rng.uniform(0.08, 0.15), rng.uniform(-0.2, 0.1), rng.uniform(0.7, 1.0)
    x, y = (depth - leg) / 2, (1 - leg) / 2
    legs = [_box((leg, leg, seat + 0.5), (a, b, (seat - 0.5) / 2)) for a in (-x, x) for b in (-y, y)]
    back = _box((leg, 1, 0.55 - seat), (x, 0, (seat + 0.45) / 2))
    return _union(*legs, _box((depth, 1, 0.1), (0, 0, seat)), back)


def _plate_with_holes(rng: np.random.Generator) -> trimesh.Trimesh:
    thick = rng.uniform(0.05, 0.3)
    holes = [
        _box((1, *rng.uniform(0.1, 0.4, 2)), (0, *rng.uniform(-0.25, 0.25, 2))) for _ in range(int(rng.integers(1, 4)))
    ]
    return _difference(_box((thick, 1, 1)), *holes)


def _mug(rng: np.random.Generator) -> trimesh.Trimesh:
    ring = trimesh.creation.torus(rng.uniform(0.2, 0.3), rng.uniform(0.04, 0.08), major_sections=16, minor_sections=8)
    ring.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, (1, 0, 0))).apply_translation((0.5, 0, 0))
    wall = rng.uniform(0.04, 0.1)
    return _difference(_union(_post(24, 0.5, 1.0), ring), _post(24, 0.5 - wall, 1.0, (0, 0, wall)))


def _stairs(rng: np.random.Generator) -> trimesh.Trimesh:
    n, width = int(rng.integers(2, 6)), rng.uniform(0.4, 1.0)
    steps = [_box((1 - k / n, width, (k + 1) / n), (k / n / 2, 0, (k + 1) / n / 2)) for k in range(n)]
    return _union(*steps)


def _two_bodies(rng: np.random.Generator) -> trimesh.Trimesh:
    first = _post(int(rng.integers(3, 13)), rng.uniform(0.1, 0.2), 1.0, (0, 0.3, 0))
    height = rng.uniform(0.4, 1.0)
    second = _box((rng.uniform(0.15, 0.6), rng.uniform(0.15, 0.4), height), (0, -0.3, (height - 1) / 2))
    mesh = trimesh.util.concatenate([first, second])
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def _ball_on_block(rng: np.random.Generator) -> trimesh.Trimesh:
    radius, depth = rng.uniform(0.2, 0.35), rng.uniform(0.5, 1.0)
    ball = trimesh.creation.icosphere(2, radius).apply_translation((*rng.uniform(-0.2, 0.2, 2), 0.8 * radius))
    return _union(_box((depth, 1, 0.5), (0, 0, -0.25)), ball)


def _arch(rng: np.random.Generator) -> trimesh.Trimesh:
    gate = _box((2, rng.uniform(0.3, 0.6), 1), (0, rng.uniform(-0.15, 0.15), rng.uniform(-0.4, -0.1)))
    return _difference(_box((rng.uniform(0.15, 0.6), 1, 1)), gate)


def _tower(rng: np.random.Generator) -> trimesh.Trimesh:
    return _union(
        *(
            _box((*rng.uniform(0.3, 0.9, 2), 0.4), (*rng.uniform(-0.15, 0.15, 2), z), rng.uniform(0, math.pi))
            for z in (0.0, 0.3, 0.6)
        )
    )


def _stone(rng: np.random.Generator) -> trimesh.Trimesh:
    mesh: trimesh.Trimesh = trimesh.convex.convex_hull(rng.uniform(-0.5, 0.5, (int(rng.integers(6, 16)), 3)))
    return mesh


KINDS: dict[str, Callable[[np.random.Generator], trimesh.Trimesh]] = {
    "prism_rib": _prism_rib,
    "prism_notch": _prism_notch,
    "prism_boss": _prism_boss,
    "bracket": _bracket,
    "tee": _tee,
    "cross": _cross,
    "wedge": _wedge,
    "chair": _chair,
    "plate_with_holes": _plate_with_holes,
    "mug": _mug,
    "stairs": _stairs,
    "two_bodies": _two_bodies,
    "ball_on_block": _ball_on_block,
    "arch": _arch,
    "tower": _tower,
    "stone": _stone,
}
"""Functions that draw the body of each kind, about 1 wide and high; :func:`random_part` gives it size and place."""


def random_part(kind: str, rng: np.random.Generator) -> trimesh.Trimesh:
    """Return a random watertight part, 0.15 to 0.35 m wide and high, turned by a random angle about the vertical axis.

    In half of the parts the axis goes through the middle, in the others up to 15 % of depth and width beside it.
    """
    mesh = KINDS[kind](rng)
    width, height = rng.uniform(*_WIDTHS_M), rng.uniform(*_HEIGHTS_M)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    across = width / max(mesh.extents[:2])
    mesh.apply_transform(np.diag([across, across, height / mesh.extents[2], 1.0]))
    aside = rng.uniform(-0.15, 0.15, 2) * mesh.extents[:2] * rng.integers(0, 2)
    return _turned(mesh.apply_translation((*aside, 0.0)), rng.uniform(0, 2 * math.pi))


def shared_face_pair(rng: np.random.Generator) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Return two parts that have the same plate in front and different backs, which the plate hides at δ = 0.

    The plate faces −x. It lies 0.05 to 0.12 m farther before the axis of the second part than before that of the first,
    ``first.bounds[0, 0] - second.bounds[0, 0]``, so that the second shows it at a distance D larger by this.
    """
    y, z = rng.uniform(*_WIDTHS_M), rng.uniform(*_HEIGHTS_M)
    thick, front = rng.uniform(0.02, 0.04), rng.uniform(0.03, 0.07)
    corner = _box((1.0, 0.4 * y, 0.4 * z), (0.0, 0.5 * y, 0.5 * z))
    plate = _difference(_box((thick, y, z), (thick / 2, 0, 0)), corner)
    deep = rng.uniform(0.1, 0.2, 2)
    block = _box((deep[0], 0.5 * y, 0.5 * z), (deep[0] / 2, -0.1 * y, -0.1 * z))
    rod = _post(12, 0.1 * y, deep[1]).apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, (0, 1, 0)))
    rod.apply_translation((deep[1] / 2, -0.2 * y, -0.2 * z))
    first, second = _union(plate, block), _union(plate, rod)
    return (
        first.apply_translation((-front, 0, 0)),
        second.apply_translation((-front - rng.uniform(*_AXES_APART_M), 0, 0)),
    )


def scaled_copies(mesh: trimesh.Trimesh, factors: Sequence[float]) -> list[trimesh.Trimesh]:
    """Return the mesh in other sizes, about its origin."""
    return [mesh.copy().apply_scale(factor) for factor in factors]


def mirrored(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mirror image of the mesh in the plane y = 0, its faces wound outward again."""
    return trimesh.Trimesh(mesh.vertices * (1, -1, 1), mesh.faces[:, ::-1], process=False)
