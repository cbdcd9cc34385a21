"""Interface of what can be rendered: corners and triangles, with or without a mesh library around them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


class SurfaceMesh(Protocol):
    """Triangles in metres: a `trimesh.Trimesh`, or :class:`~phasemark.landmarks.mesh.Surface`."""

    @property
    def vertices(self) -> NDArray[np.float64]:
        """Points, (v, 3)."""

    @property
    def faces(self) -> NDArray[np.int64]:
        """Corners of each triangle, (f, 3), counter-clockwise from outside."""

    @property
    def face_attributes(self) -> Mapping[str, Any]:
        """What is known of faces.

        ``part``: 0 for faces of the lower part, 1 for faces of the upper one, (f,). ``albedo`` of each, (f,).
        ``quadric``: the row of ``metadata["quadrics"]``, (q, 10), that is the true surface of a face, (f,); −1: none.
        """

    @property
    def metadata(self) -> Mapping[str, Any]:
        """What else is known of the mesh, its ``albedo`` for instance."""
