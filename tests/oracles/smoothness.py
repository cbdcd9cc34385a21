"""How smoothly images change with the view: windows of tiny steps, and the events in the image that excuse a kink.

The light of a pixel is a smooth function of the view except where the topology inside the pixel changes: an edge passes
a corner of the pixel, or a vertex passes its border. Those events are found here from the mesh alone, by projecting its
creases and silhouettes once more.

What counts as an edge or vertex is the solid's own: creases and limbs as curves, corners where creases meet or bend,
the points where a limb ends or is cut by another edge. The joints inside the chains that stand for a rim or a limb are
not corners of the solid; neither are the moments in which a limb steps from one facet to the next. They are part of
the tessellation, whose traces have to stay below the bar like everything else's.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark.render import Renderer, Sensor, Views

PARAMETERS = ("distance_m", "delta_rad", "bearing_rad", "height_m")
STEP = 1e-6
STEPS = 11
_CREASE_RAD = math.radians(30)
_CORNER_RAD = math.radians(10)


def random_views(rng: np.random.Generator, n: int) -> Views:
    """Return n views over the range in which the landmarks are to be matched."""
    return Views(
        rng.uniform(0.75, 2.0, n),
        rng.uniform(0, math.pi, n),
        np.radians(rng.uniform(-3, 3, n)),
        rng.uniform(-0.05, 0.05, n),
    )


def shifted(views: Views, parameter: str, step: float | NDArray[Any]) -> Views:
    """Return views with one parameter moved."""
    values = {name: getattr(views, name) for name in PARAMETERS}
    values[parameter] = values[parameter] + step
    return Views(**values)


class Outline:
    """The edges of a closed mesh that matter in the image of a view.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Closed, wound outward.
    sensor : Sensor
        Level.
    """

    def __init__(self, mesh: trimesh.Trimesh, sensor: Sensor) -> None:
        mesh = mesh.copy()
        mesh.merge_vertices()
        self.sensor = sensor
        self.vertices = np.asarray(mesh.vertices)
        self.normals = np.asarray(mesh.face_normals)
        self.origins = self.vertices[mesh.faces[:, 0]]
        angle = np.asarray(mesh.face_adjacency_angles)
        self.edges, self.faces = np.asarray(mesh.face_adjacency_edges), np.asarray(mesh.face_adjacency)
        bent = angle > 1e-6
        self.edges, self.faces, self.crease = self.edges[bent], self.faces[bent], angle[bent] > _CREASE_RAD + 1e-9
        self.is_corner = self._corners(self.edges[self.crease])

    def _corners(self, creases: NDArray[Any]) -> NDArray[Any]:
        """Tell which vertices are corners: more or fewer than two creases meet, or two that do not run on."""
        corner = np.zeros(len(self.vertices), bool)
        count = np.bincount(creases.ravel(), minlength=len(self.vertices))
        corner[(count > 0) & (count != 2)] = True
        along = self.vertices[creases[:, 1]] - self.vertices[creases[:, 0]]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        outward = np.zeros((len(self.vertices), 3))
        np.add.at(outward, creases[:, 0], along)
        np.add.at(outward, creases[:, 1], -along)
        # two edges that run straight on cancel; the sum of two unit vectors at an angle π − t is 2 sin(t / 2) long
        corner[(count == 2) & (np.linalg.norm(outward, axis=1) > 2 * math.sin(_CORNER_RAD / 2))] = True
        return corner

    def project(self, view: Views, points: NDArray[Any]) -> NDArray[Any]:
        """Return u, v of points of the landmark frame, (n, 2)."""
        rotation, translation = view.landmark2cam()
        x, y, z = (points @ rotation[0].T + translation[0]).T
        tan_h, tan_v = self.sensor.tan_half_angles
        u0, v0 = self.sensor.centre_px
        return np.column_stack(
            [u0 - y / x * self.sensor.cols / (2 * tan_h), v0 - z / x * self.sensor.rows / (2 * tan_v)]
        )

    def shown(self, view: Views) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the edges that can be seen from a view, as indices, and whether each is a silhouette."""
        lens = view.lens_in_landmark()[0]
        front = np.einsum("ij,ij->i", self.normals, lens - self.origins) > 0
        first, second = front[self.faces].T
        silhouette = first != second
        return np.flatnonzero((first | second) & (self.crease | silhouette)), silhouette

    def events(self, view: Views, parameter: str, reach: float) -> tuple[int, int]:
        """Return how many pixel corners edges pass, and how many borders vertices pass, within ± reach of a view."""
        before, after = (self.project(shifted(view, parameter, s), self.vertices) for s in (-reach, reach))
        middle = self.project(view, self.vertices)
        travel = 0.55 * np.linalg.norm(after - before, axis=1)  # half the way, and a little
        index, silhouette = self.shown(view)
        a, b = self.edges[index].T
        moved = np.maximum(travel[a], travel[b])
        passed = _corners_passed(middle[a], middle[b], moved, self.sensor)
        ends = np.unique(self.edges[index])
        limb = index[silhouette[index] & ~self.crease[index]]
        meeting = np.intersect1d(self.edges[limb], self.edges[self.crease])
        own = ends[self.is_corner[ends]]
        own = np.union1d(own, meeting)
        own_uv, own_travel = middle[own], travel[own]
        crossings = _crossings(middle[a], middle[b], moved)
        points = np.vstack([own_uv, crossings[:, :2]])
        slack = np.concatenate([own_travel, crossings[:, 2]])
        return passed, _borders_passed(points, slack, self.sensor)


def _corners_passed(a: NDArray[Any], b: NDArray[Any], moved: NDArray[Any], sensor: Sensor) -> int:
    """Count the pixel corners that lie within `moved` of a segment."""
    count = 0
    for p, q, reach in zip(a, b, moved, strict=True):
        low = np.ceil(np.maximum(np.minimum(p, q) - reach, 0)).astype(int)
        high = np.floor(np.minimum(np.maximum(p, q) + reach, [sensor.cols, sensor.rows])).astype(int)
        if (low > high).any():
            continue
        u, v = np.mgrid[low[0] : high[0] + 1, low[1] : high[1] + 1].reshape(2, -1)
        d, w = q - p, np.column_stack([u, v]) - p
        t = np.clip(w @ d / max(d @ d, 1e-300), 0, 1)
        count += int((np.linalg.norm(w - t[:, None] * d, axis=1) <= reach).sum())
    return count


def _borders_passed(points: NDArray[Any], reach: NDArray[Any], sensor: Sensor) -> int:
    """Count the points inside the image that lie within `reach` of a border between pixels."""
    inside = np.all((points > -0.01) & (points < np.array([sensor.cols, sensor.rows]) + 0.01), axis=1)
    return int((inside[:, None] & (np.abs(points - np.round(points)) <= reach[:, None])).sum())


def _crossings(a: NDArray[Any], b: NDArray[Any], moved: NDArray[Any]) -> NDArray[Any]:
    """Return where segments cross, (n, 3): u, v, and how far the place moves at most."""
    low, high = np.minimum(a, b), np.maximum(a, b)
    order = np.argsort(low[:, 0])
    out = []
    d = b - a
    for position, i in enumerate(order):
        j = order[position + 1 :]
        j = j[low[j, 0] <= high[i, 0]]
        j = j[(low[j, 1] <= high[i, 1]) & (high[j, 1] >= low[i, 1])]
        if not j.size:
            continue
        cross = d[i, 0] * d[j, 1] - d[i, 1] * d[j, 0]
        w = a[j] - a[i]
        with np.errstate(divide="ignore", invalid="ignore"):
            s = (w[:, 0] * d[j, 1] - w[:, 1] * d[j, 0]) / cross
            t = (w[:, 0] * d[i, 1] - w[:, 1] * d[i, 0]) / cross
        met = (s > 1e-9) & (s < 1 - 1e-9) & (t > 1e-9) & (t < 1 - 1e-9)
        if met.any():
            sine = np.abs(cross) / (np.linalg.norm(d[i]) * np.linalg.norm(d[j], axis=1))
            slack = (moved[i] + moved[j]) / sine
            out.append(np.column_stack([a[i] + s[met, None] * d[i], slack[met]]))
    return np.vstack(out) if out else np.empty((0, 3))


@dataclass
class Windows:
    """Windows of :data:`STEPS` steps of :data:`STEP`, one for each view.

    Parameters
    ----------
    residual : (n,) float64
        Largest deviation of any pixel's phasor from its best quadratic, as a share of the image's brightest pixel.
    pixel : (n, 2) int
        Row and column of that pixel.
    crossed : (n,) bool
        Whether an edge passes a pixel corner, or a vertex a border, in the window.
    """

    residual: NDArray[Any]
    pixel: NDArray[Any]
    crossed: NDArray[Any]


def measure_windows(renderer: Renderer, outline: Outline, views: Views, parameter: str, **background: Any) -> Windows:
    """Measure windows of one parameter around some views."""
    offsets = STEP * (np.arange(STEPS) - STEPS // 2)
    n = len(views)
    flat = Views(*(np.repeat(getattr(views, name), STEPS) for name in PARAMETERS))
    moved = shifted(flat, parameter, np.tile(offsets, n))
    shape = (n, STEPS, renderer.sensor.rows, renderer.sensor.cols)
    phasor = renderer.render_views(moved, **background).phasor.reshape(shape)
    basis = np.linalg.qr(np.vander(offsets / offsets.max(), 3))[0]
    fit = np.einsum("sk,tk,ntrc->nsrc", basis, basis, phasor)
    residual = np.abs(phasor - fit).max(axis=1) / np.abs(phasor).max(axis=(1, 2, 3))[:, None, None]
    worst = residual.reshape(n, -1).argmax(axis=1)
    crossed = [any(outline.events(views[i : i + 1], parameter, offsets.max())) for i in range(n)]
    return Windows(
        residual=residual.reshape(n, -1).max(axis=1),
        pixel=np.column_stack(np.unravel_index(worst, shape[2:])),
        crossed=np.array(crossed),
    )


def difference_quotients(
    renderer: Renderer, views: Views, parameter: str, steps: tuple[float, float] = (1e-4, 5e-5), **background: Any
) -> NDArray[Any]:
    """Compare central differences of two steps: their largest difference as a share of the largest slope, (n,)."""
    slopes = []
    for step in steps:
        up, down = (renderer.render_views(shifted(views, parameter, s), **background).phasor for s in (step, -step))
        slopes.append((up - down) / (2 * step))
    return np.asarray(np.abs(slopes[0] - slopes[1]).max(axis=(1, 2)) / np.abs(slopes[1]).max(axis=(1, 2)))
