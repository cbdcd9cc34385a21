"""A plugin of pytest that flips the last bit of every pose and ray: ``make test ARGS="-p last_bits"``.

Another processor, compiler or library rounds sines and products otherwise. A test that fails only with this plugin
compares numbers more closely than they are computed. Tests that compare this process with worker processes of its own
fail: those do not load the plugin.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.render import renderer
from phasemark.render.integral import area_integral, scene_samples
from phasemark.render.integral.arguments import Poses


def flipped(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return numbers with the other last bit; 0, ± 1 and what is not finite stay."""
    bits = np.ascontiguousarray(values, np.float64).view(np.uint64) ^ np.uint64(1)
    exact = ~np.isfinite(values) | (values == 0) | (np.abs(values) == 1)
    return np.where(exact, values, bits.view(np.float64))


def poses_with_other_bits(*arguments: Any) -> Poses:
    """Return the poses that the renderer makes, each number one bit off."""
    poses = _poses(*arguments)
    return poses._replace(lens=flipped(poses.lens), matrix=flipped(poses.matrix), offset=flipped(poses.offset))


_poses = area_integral.poses_of_views
for module in (renderer, scene_samples):
    vars(module)["poses_of_views"] = poses_with_other_bits
