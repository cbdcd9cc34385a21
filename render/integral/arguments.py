"""Arguments of the integral's kernels: camera, poses, light, and the buffers they fill."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.render.kernel import inner


class Distortion(NamedTuple):
    """The distortion of a camera's lens, with what is computed of it once.

    Parameters
    ----------
    model : int
        0 for the ideal lens, all else of which is empty, or as :mod:`~phasemark.render.sensor.lens_map` numbers them.
    coefficients : (8,) float64
        In OpenCV's order.
    nodes : (2 rows + 1, 2 cols + 1, 2) float64
        y and z of the rays of corners, edge middles and centres of all pixels.
    reach : (rows, cols + 1, 4) float64
        Of each pixel's rays: lowest and highest y, lowest and highest z; in the last column of all rays of the row.
    rule : (rows, cols, n, 2) float64
        Rays of the points at which a background is integrated over a pixel: of 3 × 3, of 4 × 4, or of both.
    low_y, high_y, low_z, high_z, radius : float
        Edges of the mesh are clipped to this rectangle of tangents, which holds the image, and to this circle, within
        which the lens does not fold.
    bend : float
        The image of a straight line of length L, in tangents, leaves its chord by less than bend · L² (pixels).
    """

    model: int
    coefficients: NDArray[np.float64]
    nodes: NDArray[np.float64]
    reach: NDArray[np.float64]
    rule: NDArray[np.float64]
    low_y: float
    high_y: float
    low_z: float
    high_z: float
    radius: float
    bend: float


IDEAL = Distortion(
    0, np.zeros(8), np.empty((0, 0, 2)), np.empty((0, 0, 4)), np.empty((0, 0, 0, 2)), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
)
"""No distortion."""


class Camera(NamedTuple):
    """The camera of a batch.

    Parameters
    ----------
    scale_u, scale_v, centre_u, centre_v : float
        A ray (1, y, z) of the tilted camera meets the image in u = centre_u − scale_u · y, v = centre_v − scale_v · z;
        with distortion, y and z are the distorted ones.
    slope_u, slope_v : float
        1 / scale_u, 1 / scale_v.
    rows, cols : int
    first_row, stop_row : int
        Image rows to render.
    fill_u, fill_v : float
        Fill factor.
    level : (3, 3) float64
        Camera frame to that of its mount, which is level unless the view is tilted.
    distortion : Distortion
    """

    scale_u: float
    scale_v: float
    centre_u: float
    centre_v: float
    slope_u: float
    slope_v: float
    rows: int
    cols: int
    first_row: int
    stop_row: int
    fill_u: float
    fill_v: float
    level: NDArray[np.float64]
    distortion: Distortion = IDEAL


class Poses(NamedTuple):
    """Poses of the landmark in n views.

    Parameters
    ----------
    lens : (n, 3) float64
        The lens in the landmark frame.
    matrix, offset : (n, 3, 3), (n, 3) float64
        p_image = matrix · p' + offset: landmark frame to the tilted camera's frame (x along the axis).
    bearing : (n,) float64
    level : (n, 3, 3) float64
        Tilted to level camera frame: mount and view together.
    background : (n, 5) float64
        What stands behind the landmark, rows as :meth:`~phasemark.render.background.Background.parameters`.
    """

    lens: NDArray[np.float64]
    matrix: NDArray[np.float64]
    offset: NDArray[np.float64]
    bearing: NDArray[np.float64]
    level: NDArray[np.float64]
    background: NDArray[np.float64]


class Light(NamedTuple):
    """Light: the numbers that turn a hit into a phasor.

    Parameters
    ----------
    albedo : float
        Of the surface, times that of the face.
    radians_per_metre : float
        4πf / c of the first frequency f.
    orders : (k,) float64
        Which multiples of f phasors are wanted at: harmonic orders, other frequencies and their harmonics; the first
        is 1.
    vignetting : bool
    fastest : float
        4πf / c of the highest modulation frequency, for which the background's pixels are cut finely enough; 0 of a
        single frequency behind an ideal lens, whose pixels are not cut.
    lamp : (m,) float64
        Relative intensity of the lamp at even steps of the tangent off the axis; empty: even light.
    lamp_step : float
    """

    albedo: float
    radians_per_metre: float
    orders: NDArray[np.float64]
    vignetting: bool
    fastest: float
    lamp: NDArray[np.float64]
    lamp_step: float


HIDDEN_LIMB = 2
"""Kind of a limb that another body hides: no edge of the image, yet a surface that is seen beside it ends there."""
SLENDER = 1 << 20
"""Ellipsoids with unequal axes are numbered from here on: across them cos θ turns more quickly than across a ball."""


class Edges(NamedTuple):
    """The edges of one view, and which of them each pixel has.

    Parameters
    ----------
    segments : (e, 4) float64
        u, v of both ends. With distortion, an edge is a chain of links.
    limb : (e,) int8
        1 for a silhouette of a smooth surface; then the surface lies on the side where
        du·(v − v_a) − dv·(u − u_a) < 0. :data:`HIDDEN_LIMB` where another body hides it.
    body : (e,) int32
        Part of the surface that a silhouette belongs to, −1 where that is not known; of an ellipsoid with unequal axes
        plus :data:`SLENDER`.
    head : (rows + 2, cols + 2) int32
        First entry of each pixel's list, −1: none; with a border of one pixel around the image.
    link, owner : (m,) int32
        Next entry, and the entry's segment.
    heights : (CLUSTER,) float64
        How far before the faces of one cluster the lens is.
    ends : (e, 2) int32
        Vertices at both ends of the edge; −1: the line where wall and floor meet, or the horizon.
    extent : (2, 4) float64
        With distortion: lowest and highest y, lowest and highest z of all edges, and of the limbs among them.
    line : (4,) float64
        Scratch: an edge in tangents.
    arc, points : (3, 3), (2, 3) float64
        Scratch: the ellipse of a round edge, and the ends of a segment of it.
    near : (parts,) int32
        Scratch: convex parts that may hide an edge.
    """

    segments: NDArray[np.float64]
    limb: NDArray[np.int8]
    body: NDArray[np.int32]
    head: NDArray[np.int32]
    link: NDArray[np.int32]
    owner: NDArray[np.int32]
    heights: NDArray[np.float64]
    ends: NDArray[np.int32]
    extent: NDArray[np.float64]
    line: NDArray[np.float64]
    arc: NDArray[np.float64]
    points: NDArray[np.float64]
    near: NDArray[np.int32]


class Borders(NamedTuple):
    """Points on the edges inside pixels, where the light of a pixel changes as the edges move; room for m.

    An integral over a pixel changes with a parameter by what the light changes at fixed points of the image, and by
    what the edges sweep: ∫ (f_left − f_right) ẋ ds along each (Leibniz's rule).

    Parameters
    ----------
    placed : (1,) int64
        Points placed; beyond m: there was not room for all.
    points : (m, 2) float64
        u, v.
    weights : (m,) float64
        Length along the sweep, over the pixel's active area.
    regions : (m, 2) int32
        Numbers of the intervals on both sides, towards smaller and larger x; see :class:`Samples`.
    segment : (m,) int32
        The edge, while its view is planned.
    ends : (m, 2) int32
        Its vertices; the first is −1 for that of the background.
    along : (m, 2) float64
        u and v from its begin to its end.
    side : (m,) float64
        +1 for a limb with its surface towards larger x, −1 towards smaller x, 0 for a crease.
    along_v : (m,) int8
        1 where x is u, the coordinate in which the edge is said to move; 0 where it is v.
    pixel : (m,) int64
        view · pixels + pixel.
    depth : (m,) float64
        Of the edge along the camera's axis; 0: it is never hidden.
    rates : (m, p) float64
        How fast the edge moves along x, pixels per unit of each parameter.
    """

    placed: NDArray[np.int64]
    points: NDArray[np.float64]
    weights: NDArray[np.float64]
    regions: NDArray[np.int32]
    segment: NDArray[np.int32]
    ends: NDArray[np.int32]
    along: NDArray[np.float64]
    side: NDArray[np.float64]
    along_v: NDArray[np.int8]
    pixel: NDArray[np.int64]
    depth: NDArray[np.float64]
    rates: NDArray[np.float64]


class Motion(NamedTuple):
    """Motion of a batch's views, from which the speed of their edges follows.

    Parameters
    ----------
    poses : Poses
        1 + p for each view: the view itself, then each parameter moved by its step.
    step : (p,) float64
    segments : (1 + p, 4) float64
        Scratch: one edge in these poses; with distortion, in tangents.
    """

    poses: Poses
    step: NDArray[np.float64]
    segments: NDArray[np.float64]


class Returns(NamedTuple):
    """Returned light of consecutive samples; room for m.

    Parameters
    ----------
    amplitude, phase : (m,) float64
        Weighted amplitude, 0 where nothing is met, and phase of the first order.
    real, imaginary : (m,) float64
        Of the phasor of one order.
    """

    amplitude: NDArray[np.float64]
    phase: NDArray[np.float64]
    real: NDArray[np.float64]
    imaginary: NDArray[np.float64]

    @classmethod
    def empty(cls, m: int) -> Returns:
        """Return room for m samples."""
        return cls(*np.empty((4, m)))


class Pieces(NamedTuple):
    """Parts of pixels whose samples follow one another, in their order; room for m, or for none if nobody asks.

    Parameters
    ----------
    samples : (m, 2) int64
        The first sample, and the one behind the last.
    bounds : (m, 6) float64
        First and last line of the sweep, the ends of the piece on the first, and on the last: a trapezoid, or close to
        it where its sides are curves.
    sweep_v : (m,) bool
        Whether lines lie at v, from u to u, or at u.
    placed : (1,) int64
        How many there are.
    """

    samples: NDArray[np.int64]
    bounds: NDArray[np.float64]
    sweep_v: NDArray[np.bool_]
    placed: NDArray[np.int64]

    @classmethod
    def empty(cls, m: int) -> Pieces:
        """Return room for m pieces."""
        return cls(np.empty((m, 2), np.int64), np.empty((m, 6)), np.empty(m, np.bool_), np.zeros(1, np.int64))


class Samples(NamedTuple):
    """Samples of some views; room for m.

    Parameters
    ----------
    points : (m, 2) float64
        u, v.
    rays : (m, 2) float64
        y and z of their rays (1, y, z), frame of the tilted camera.
    weights : (m,) float64
        Shares of their pixel's active area.
    regions : (m,) int32
        Number of the interval that each lies in.
    pixel : (m,) int64
        view · pixels + pixel.
    face : (m,) int32
        Face met, −1: none.
    chosen : (m,) int64
        Samples whose rays are cast.
    origins, directions : (m, 3) float32
        These rays, landmark frame.
    returns : Returns
        Of fewer than m samples at a time.
    pieces : Pieces
        That these samples stand for.
    """

    points: NDArray[np.float64]
    rays: NDArray[np.float64]
    weights: NDArray[np.float64]
    regions: NDArray[np.int32]
    pixel: NDArray[np.int64]
    face: NDArray[np.int32]
    chosen: NDArray[np.int64]
    origins: NDArray[np.float32]
    directions: NDArray[np.float32]
    returns: Returns
    pieces: Pieces


class Sums(NamedTuple):
    """Sums over the samples of each pixel of a batch.

    Parameters
    ----------
    phasor : (pixels, k) complex128
    intensity, coverage : (pixels,) float64
    shares : (pixels, parts) float64
        The coverage by each part of the surface.
    state : (n, rows, cols) uint8
        Per pixel whether it was sampled, see :mod:`~phasemark.render.integral.ray_plan`.
    """

    phasor: NDArray[np.complex128]
    intensity: NDArray[np.float64]
    coverage: NDArray[np.float64]
    shares: NDArray[np.float64]
    state: NDArray[np.uint8]


@inner
def towards_landmark(matrix, y, z):  # type: ignore[no-untyped-def]
    """Return the ray (1, y, z) in the landmark frame; `matrix` as in :class:`Poses`, of one view."""
    return (
        matrix[0, 0] + matrix[1, 0] * y + matrix[2, 0] * z,
        matrix[0, 1] + matrix[1, 1] * y + matrix[2, 1] * z,
        matrix[0, 2] + matrix[1, 2] * y + matrix[2, 2] * z,
    )


@inner
def towards_level(level, y, z):  # type: ignore[no-untyped-def]
    """Return the ray (1, y, z) in the level camera frame; `level` as in :class:`Poses`, of one view."""
    return (
        level[0, 0] + level[0, 1] * y + level[0, 2] * z,
        level[1, 0] + level[1, 1] * y + level[1, 2] * z,
        level[2, 0] + level[2, 1] * y + level[2, 2] * z,
    )
