"""Limbs of curved surfaces in a pixel and its neighbours: which there are, and which is the nearest on a line."""

from __future__ import annotations

import numpy as np

from phasemark.render.integral.arguments import HIDDEN_LIMB
from phasemark.render.kernel import inner

MAX_LIMBS = 256
_REACH = 0.5
"""How far along the sweep (pixels) the end of a limb is felt."""


@inner
def lists_limb(entry, edges):  # type: ignore[no-untyped-def]
    """Return whether a limb is among the segments listed from `entry` on."""
    while entry >= 0:
        if edges.limb[edges.owner[entry]] == 1:
            return True
        entry = edges.link[entry]
    return False


@inner
def collect_limbs(entry, edges, sweep_v, scratch):  # type: ignore[no-untyped-def]
    """Append a pixel's limbs: s, x at the low end, s at the high end, slope dx/ds, body, whether it is hidden.

    The body is −1 where it is not known.
    Those whose surface lies towards larger x go to ``scratch.limbs[0]``, the others to ``scratch.limbs[1]``;
    ``scratch.n_limbs`` has their numbers. What no longer fits is left out.
    """
    segments, limb, link, owner = edges.segments, edges.limb, edges.link, edges.owner
    limbs, count = scratch.limbs, scratch.n_limbs
    while entry >= 0:
        k = owner[entry]
        entry = link[entry]
        if not limb[k]:
            continue
        if sweep_v:
            xa, sa, xb, sb = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
            which = 0 if sb > sa else 1
        else:
            sa, xa, sb, xb = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
            which = 1 if sb > sa else 0
        n = count[which]
        if sa == sb or n == limbs.shape[1]:
            continue
        if sa > sb:
            sa, xa, sb, xb = sb, xb, sa, xa
        limbs[which, n, 0], limbs[which, n, 1], limbs[which, n, 2] = sa, xa, sb
        limbs[which, n, 3], limbs[which, n, 4] = (xb - xa) / (sb - sa), edges.body[k]
        limbs[which, n, 5] = limb[k] == HIDDEN_LIMB
        count[which] += 1


@inner
def nearest_limb(scratch, s, side, bound, body):  # type: ignore[no-untyped-def]
    """Find, of limbs with their surface on our side, the one nearest to `bound` and beyond it, on or near a line.

    A limb that ends before it reaches the line (at a rim, say) still shapes the surface beside its end. Only those of
    `body` are asked; where that is negative, those of any that are not hidden. Returns where it is, ∓inf where there is
    none, and its body.
    """
    limbs, n_limbs = scratch.limbs, scratch.n_limbs
    which = 0 if side > 0 else 1
    best, whose = -np.inf if side > 0 else np.inf, body
    closest = _REACH
    for i in range(n_limbs[which]):
        if limbs[which, i, 4] != body and (body >= 0.0 or limbs[which, i, 5] > 0.0):
            continue
        gap = max(limbs[which, i, 0] - s, s - limbs[which, i, 2], 0.0)
        if gap > closest:
            continue
        x = (
            limbs[which, i, 1]
            + (min(max(s, limbs[which, i, 0]), limbs[which, i, 2]) - limbs[which, i, 0]) * limbs[which, i, 3]
        )
        if (side > 0 and x > bound) or (side < 0 and x < bound):
            continue
        if gap < closest or (side > 0 and x > best) or (side < 0 and x < best):
            best, closest, whose = x, gap, limbs[which, i, 4]
    return best, whose
