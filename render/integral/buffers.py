"""Scratch of the area integral: made once, lent to one thread at a time, and kept for the next call."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from phasemark.render.integral.arguments import Borders, Edges, Pieces, Returns, Samples
from phasemark.render.integral.mesh_topology import CLUSTER, MeshTopology
from phasemark.render.integral.pixel_splitting import Scratch
from phasemark.render.integral.ray_plan import SHORT_LINKS, SHORT_SEGMENTS

_BORDERS, _RETURNS = 1 << 14, 1 << 9
_LINKS = 1 << 10
"""Further segments that a view is given room for when edges become chains behind a lens with distortion."""
_KEPT = 8
_MOST_KEPT_SAMPLES = 1 << 18
"""Scratch with room for more is not kept: 25 MB."""


class Layout(NamedTuple):
    """Use that scratch is made for.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the image.
    n_samples : int
        Samples that there is room for at first.
    n_parameters : int
        Of the slopes of images; 0: only the images are asked for.
    keeps_pieces : bool
        Whether the outlines of pieces are kept beside their samples.
    """

    shape: tuple[int, int]
    n_samples: int = 1 << 17
    n_parameters: int = 0
    keeps_pieces: bool = False


class Buffers:
    """Scratch of one thread; grows when a view needs more."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        rows, cols = layout.shape
        n_links = 1 << 14
        self.scratch = Scratch.empty()
        self.edges = Edges(
            segments=np.empty((0, 4)),
            limb=np.empty(0, np.int8),
            body=np.empty(0, np.int32),
            head=np.empty((rows + 2, cols + 2), np.int32),
            link=np.empty(n_links, np.int32),
            owner=np.empty(n_links, np.int32),
            heights=np.empty(CLUSTER),
            arc=np.empty((3, 3)),
            points=np.empty((2, 3)),
            ends=np.empty((0, 2), np.int32),
            extent=np.empty((2, 4)),
            line=np.empty(4),
            near=np.empty(0, np.int32),
        )
        self.samples = room_for_samples(layout.n_samples, layout.keeps_pieces)
        self.borders = _room_for_borders(_BORDERS if layout.n_parameters else 0, layout.n_parameters)

    def fit(self, mesh: MeshTopology) -> None:
        """Make room for the edges and the convex parts of a surface."""
        n_segments = len(mesh.creases) + len(mesh.folds) + 1
        if len(self.edges.segments) < n_segments:
            self._make_segments(n_segments)
        if len(self.edges.near) < len(mesh.parts):
            self.edges = self.edges._replace(near=np.empty(len(mesh.parts), np.int32))

    def make_room(self, reached: int) -> None:
        """Grow what was too short, as :func:`plan_rays` says in place of the next view."""
        if reached == SHORT_LINKS:
            n = 2 * len(self.edges.link)
            self.edges = self.edges._replace(link=np.empty(n, np.int32), owner=np.empty(n, np.int32))
        elif reached == SHORT_SEGMENTS:
            self._make_segments(2 * len(self.edges.segments) + _LINKS)
        else:
            self.samples = room_for_samples(2 * len(self.samples.weights), self.layout.keeps_pieces)
            self.borders = _room_for_borders(2 * len(self.borders.weights), self.layout.n_parameters)

    def _make_segments(self, n: int) -> None:
        self.edges = self.edges._replace(
            segments=np.empty((n, 4)),
            limb=np.empty(n, np.int8),
            body=np.empty(n, np.int32),
            ends=np.empty((n, 2), np.int32),
        )


_IDLE: defaultdict[Layout, list[Buffers]] = defaultdict(list)
"""Scratch that no thread is using."""


@contextmanager
def lend_buffers(mesh: MeshTopology, layout: Layout) -> Iterator[Buffers]:
    """Lend scratch with room for the edges of a surface.

    Room that was too short once is not so again, and no fresh pages are asked of the system.
    """
    try:
        buffers = _IDLE[layout].pop()
    except IndexError:
        buffers = Buffers(layout)
    buffers.fit(mesh)
    yield buffers
    if len(buffers.samples.weights) <= _MOST_KEPT_SAMPLES:
        if sum(map(len, list(_IDLE.values()))) >= _KEPT:
            _IDLE.clear()
        _IDLE[layout].append(buffers)


def room_for_samples(n: int, keeps_pieces: bool = False) -> Samples:
    """Return room for n samples."""
    return Samples(
        points=np.empty((n, 2)),
        rays=np.empty((n, 2)),
        weights=np.empty(n),
        regions=np.empty(n, np.int32),
        pixel=np.empty(n, np.int64),
        face=np.empty(n, np.int32),
        chosen=np.empty(n, np.int64),
        origins=np.empty((n, 3), np.float32),
        directions=np.empty((n, 3), np.float32),
        returns=Returns.empty(_RETURNS),
        pieces=Pieces.empty(n if keeps_pieces else 0),
    )


def _room_for_borders(n: int, p: int) -> Borders:
    return Borders(
        placed=np.zeros(1, np.int64),
        points=np.empty((n, 2)),
        weights=np.empty(n),
        regions=np.empty((n, 2), np.int32),
        segment=np.empty(n, np.int32),
        ends=np.empty((n, 2), np.int32),
        along=np.empty((n, 2)),
        side=np.empty(n),
        along_v=np.empty(n, np.int8),
        pixel=np.empty(n, np.int64),
        depth=np.empty(n),
        rates=np.empty((n, p)),
    )
