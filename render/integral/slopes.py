"""Derivatives of a batch's phasors by the view, from the samples and edges that its images are made of.

∂S/∂p = Σ weights · ∂f/∂p at the samples, the faces they see held, + ∫ (f_left − f_right) ẋ ds along the edges. ∂f/∂p is
taken at fixed points of the image. Both ẋ and ∂f/∂p are differences over a step of 3e-8 that no edge and no sample
notices: nothing is sampled or cast again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phasemark.render.integral.arguments import Borders, Camera, Light, Motion, Poses, Samples, Sums
from phasemark.render.integral.edge_motion import follow_bent_borders, follow_borders
from phasemark.render.integral.light import add_background, sum_samples
from phasemark.render.integral.mesh_topology import MeshTopology
from phasemark.render.integral.ray_plan import SKIPPED, UNTRUSTED
from phasemark.render.integral.swept_light import sum_borders

STEP = 2.0**-25
"""Width of a difference, metres or radians: far below the facets of a curved mesh, far above rounding."""


class SlopeSums:
    """Sums for the slopes of one batch.

    Parameters
    ----------
    slope : (m, pixels, p) complex128
        The result, added to, at each of m frequencies.
    columns : (m,) int64
        Where each frequency stands among the orders of the light.
    motion : Motion
    own : Sums
        The sums of the images themselves; read when the batch is complete.
    turns : (p,) bool
        Which parameters turn what stands behind the landmark.
    """

    def __init__(
        self,
        slope: NDArray[np.complex128],
        columns: NDArray[np.int64],
        motion: Motion,
        own: Sums,
        turns: NDArray[np.bool_],
    ) -> None:
        self._slope, self._columns, self._motion, self._own, self._turns = slope, columns, motion, own, turns
        p = len(motion.step)
        self._poses = [
            Poses(*(np.ascontiguousarray(part[k :: 1 + p]) for part in motion.poses)) for k in range(1, 1 + p)
        ]
        pixels = len(own.intensity)
        self._sums = Sums(
            phasor=np.empty((pixels, len(columns)), np.complex128),
            intensity=np.empty(pixels),
            coverage=np.empty(pixels),
            shares=np.empty((pixels, own.shares.shape[1])),
            state=own.state,
        )
        self._moved = np.zeros((p, pixels, len(columns)), np.complex128)

    def add(
        self,
        views: tuple[int, int],
        n: int,
        samples: Samples,
        borders: Borders,
        mesh: MeshTopology,
        poses: Poses,
        camera: Camera,
        light: Light,
    ) -> None:
        """Add n samples and the points on edges of some of the views, (first, one past the last)."""
        follow = follow_bent_borders if camera.distortion.model else follow_borders
        follow(mesh, self._motion, poses, camera, borders)
        frequencies = light._replace(orders=light.orders[self._columns])
        per_view = self._own.state[0].size
        pixels = slice(views[0] * per_view, views[1] * per_view)
        for k, moved in enumerate(self._poses):
            for values in self._sums[:4]:
                values[pixels] = 0
            sum_samples(n, samples, mesh, moved, camera, frequencies, self._sums)
            if self._turns[k]:
                add_background(views[0], views[1], moved, camera, frequencies, self._sums)
            self._moved[k, pixels] = self._sums.phasor[pixels]
        for multiple, slope in zip(frequencies.orders, self._slope, strict=True):
            one = light._replace(radians_per_metre=light.radians_per_metre * multiple, orders=light.orders[:1])
            sum_borders(n, samples, samples.chosen, mesh, poses, camera, one, borders, slope)

    def conclude(self) -> None:
        """Add what the light changes at fixed points of the image, once all samples of the batch are in.

        Pixels whose edges are not all known become NaN.
        """
        skipped = (self._own.state == SKIPPED).reshape(-1)
        self._slope[:, (self._own.state == UNTRUSTED).reshape(-1)] = np.nan
        for k, moved in enumerate(self._moved):
            for j, column in enumerate(self._columns):
                change = (moved[:, j] - self._own.phasor[:, column]) / STEP
                if not self._turns[k]:
                    change[skipped] = 0
                self._slope[j, :, k] += change
