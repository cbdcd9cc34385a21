"""Pictures of a landmark: a shaded drawing, and a page to turn it in 3D that needs nothing but a browser."""

from __future__ import annotations

import base64
import html
import io
import json
import string
from importlib import resources

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import NDArray

_CREASE_RAD = np.radians(30)
_COLOUR = np.array([0.47, 0.65, 0.85])
_FIRST_COLOUR = "#b3261e"  # of the line of sight at δ = 0


def mesh_figure(
    mesh: trimesh.Trimesh, *, azimuth_deg: float = -50.0, elevation_deg: float = 22.0, directions: bool = False
) -> bytes:
    """Draw a mesh, shaded, its edges marked.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Metres, landmark frame.
    azimuth_deg, elevation_deg : float
        Where it is seen from.
    directions : bool
        Whether to draw beside it, seen from above, the axis and the viewing directions δ (PHYSICS section 1).

    Returns
    -------
    bytes
        A PNG.
    """
    side_in = 5.2
    figure = Figure(figsize=(side_in * (1 + directions), side_in))
    share = 1 / (1 + directions)
    axes = Axes3D(figure, (0.0, 0.03, 0.92 * share, 0.94), computed_zorder=False)
    figure.add_axes(axes)
    if directions:
        _draw_axis(axes, mesh)
        _draw_directions(figure.add_axes((0.585, 0.12, 0.395, 0.79)), mesh)
    _draw_solid(axes, mesh, azimuth_deg, elevation_deg)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()


def _draw_solid(axes: Axes3D, mesh: trimesh.Trimesh, azimuth_deg: float, elevation_deg: float) -> None:
    """Draw a mesh in three dimensions."""
    axes.view_init(elev=elevation_deg, azim=azimuth_deg)
    towards = _direction(azimuth_deg, elevation_deg)
    light = _direction(azimuth_deg - 35, elevation_deg + 25)
    normals = np.asarray(mesh.face_normals)
    closed = bool(mesh.is_watertight and mesh.volume > 0)
    seen = normals @ towards > 0 if closed else np.ones(len(normals), bool)
    triangles = np.asarray(mesh.triangles)[seen] * 100
    shade = 0.35 + 0.65 * np.abs(normals[seen] @ light)
    order = np.argsort(triangles.mean(axis=1) @ towards)
    colours = np.clip(shade[order, None] * _COLOUR, 0, 1)
    axes.add_collection3d(Poly3DCollection(triangles[order], facecolors=colours, edgecolors=colours, linewidths=0.4))
    axes.add_collection3d(
        Line3DCollection(_visible_edges(mesh, towards, closed) * 100, colors="#1d2733", linewidths=0.7)
    )
    low, high = mesh.bounds * 100
    for name, a, b in zip("xyz", low, high, strict=True):
        middle, half = (a + b) / 2, 0.55 * (high - low).max()
        getattr(axes, f"set_{name}lim")(middle - half, middle + half)
    axes.set_box_aspect((1, 1, 1))
    axes.set(xlabel="x' (cm)", ylabel="y' (cm)", zlabel="z' (cm)")


def _draw_axis(axes: Axes3D, mesh: trimesh.Trimesh) -> None:
    """Draw the axis z' through a mesh, and an arrow along the line of sight at δ = 0."""
    low, high = np.asarray(mesh.bounds)[:, 2] * 100
    beyond = 0.12 * 100 * float(mesh.extents.max())
    axes.plot([0, 0], [0, 0], [low - beyond, high + beyond], "-.", color="#1d2733", lw=1.0, zorder=3)
    reach = 100 * _reach_m(mesh)
    axes.quiver(-1.6 * reach, 0, (low + high) / 2, 0.5 * reach, 0, 0, color=_FIRST_COLOUR, lw=2.2, zorder=0)


def _draw_directions(axes: Axes, mesh: trimesh.Trimesh) -> None:
    """Draw a mesh from above, with the axis, and an arrow from the camera towards it for some δ."""
    from_above, closed = np.array([0.0, 0.0, 1.0]), bool(mesh.is_watertight and mesh.volume > 0)
    faces = np.asarray(mesh.triangles)[:, :, :2] * 100
    edges = _visible_edges(mesh, from_above, closed)[:, :, :2] * 100
    axes.add_collection(PolyCollection(list(faces), facecolors="0.85", edgecolors="none"))
    axes.add_collection(LineCollection(list(edges), colors="#1d2733", linewidths=0.7))
    reach = 100 * _reach_m(mesh)
    for delta_deg in range(0, 360, 45):
        colour, width, label = (_FIRST_COLOUR, 2.2, "δ = 0") if delta_deg == 0 else ("0.4", 1.0, f"{delta_deg}°")
        x, y, _ = -reach * _direction(delta_deg, 0.0)  # the lens is at -D (cos δ, sin δ)
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": width, "mutation_scale": 16}
        axes.annotate("", (1.08 * x, 1.08 * y), (1.5 * x, 1.5 * y), arrowprops=arrow)
        axes.text(1.72 * x, 1.72 * y, label, color=colour, ha="center", va="center")
    axes.plot(0, 0, "o", ms=8, mfc="white", mec="#1d2733")
    axes.plot(0, 0, ".", ms=3, color="#1d2733")
    paper = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
    axes.annotate("axis z'", (0, 0), (7, 7), textcoords="offset points", fontsize=9, bbox=paper)
    shown = (-2 * reach, 2 * reach)
    axes.set(xlim=shown, ylim=shown, aspect="equal", xlabel="x' (cm)")
    axes.set_title("from above: δ is the direction in which the camera looks", fontsize=10)
    axes.set_ylabel("y' (cm)", labelpad=0)


def _reach_m(mesh: trimesh.Trimesh) -> float:
    """Return how far a mesh reaches from the axis z', metres."""
    return float(np.hypot(*np.asarray(mesh.vertices)[:, :2].T).max())


def mesh_html(mesh: trimesh.Trimesh, title: str) -> str:
    """Return a self-contained page that shows a mesh in 3D, to be turned and zoomed.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Metres.
    title : str
        Heading of the page.

    Returns
    -------
    str
        HTML with the mesh inside; it loads nothing. Axes x', y', z' and the line of sight at δ = 0 are drawn beside it.
    """
    vertices = np.asarray(mesh.vertices)
    centre = mesh.bounds.mean(axis=0)
    radius = np.linalg.norm(vertices - centre, axis=1).max()
    corners = trimesh.graph.smooth_shade(mesh, angle=_CREASE_RAD)
    extents = " × ".join(f"{100 * value:.4g}" for value in mesh.extents)
    page = resources.files("phasemark.landmarks").joinpath("viewer.html").read_text(encoding="utf-8")
    return string.Template(page).substitute(
        title=html.escape(title),
        facts=f"{extents} cm, {len(mesh.faces)} faces",
        origin=json.dumps((-centre / radius).round(6).tolist()),
        vertices=_base64((np.asarray(corners.vertices) - centre) / radius, np.float32),
        faces=_base64(np.asarray(corners.faces), np.uint32),
        normals=_base64(np.asarray(corners.vertex_normals)[corners.faces], np.float32),
    )


def _base64(values: NDArray[np.generic], kind: type[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<")).tobytes()).decode()


def _direction(azimuth_deg: float, elevation_deg: float) -> NDArray[np.float64]:
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    across = np.cos(elevation)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)], dtype=np.float64)


def _visible_edges(mesh: trimesh.Trimesh, towards: NDArray[np.float64], closed: bool) -> NDArray[np.float64]:
    """Return the pieces of creases and silhouettes that the viewer sees, (n, 2, 3)."""
    pairs, edges = np.asarray(mesh.face_adjacency), np.asarray(mesh.face_adjacency_edges)
    front = np.asarray(mesh.face_normals) @ towards > 0
    sharp = np.asarray(mesh.face_adjacency_angles) > _CREASE_RAD
    shown = (sharp & (front[pairs].any(axis=1) | (not closed))) | (front[pairs[:, 0]] != front[pairs[:, 1]])
    ends = np.asarray(mesh.vertices)[edges[shown]]
    size = float(np.linalg.norm(mesh.extents))
    pieces = np.maximum(1, np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / (0.02 * size))).astype(int)
    whole = np.repeat(np.arange(len(ends)), pieces)
    step = np.arange(len(whole)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    start, stop = step / pieces[whole], (step + 1) / pieces[whole]
    way = ends[whole, 1] - ends[whole, 0]
    parts = np.stack([ends[whole, 0] + start[:, None] * way, ends[whole, 0] + stop[:, None] * way], axis=1)
    blocking = np.asarray(mesh.triangles)[front] if closed else np.asarray(mesh.triangles)
    return np.asarray(parts[~_hidden(parts.mean(axis=1) + 1e-3 * size * towards, blocking, towards)])


def _hidden(
    points: NDArray[np.float64], triangles: NDArray[np.float64], towards: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return True for points that a triangle hides from a distant viewer, (n,)."""
    across = np.cross(towards, [0.0, 0.0, 1.0] if abs(towards[2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    frame = np.stack([across, np.cross(towards, across), towards])
    a, b, c = (triangles[:, k] @ frame.T for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    a, b, c, area = (array[area != 0] for array in (a, b, c, area))
    hidden = np.zeros(len(points), np.bool_)
    for k, (x, y, z) in enumerate(points @ frame.T):
        u = ((b[:, 0] - x) * (c[:, 1] - y) - (c[:, 0] - x) * (b[:, 1] - y)) / area
        v = ((c[:, 0] - x) * (a[:, 1] - y) - (a[:, 0] - x) * (c[:, 1] - y)) / area
        w = 1 - u - v
        over = (u >= 0) & (v >= 0) & (w >= 0)
        hidden[k] = bool((u * a[:, 2] + v * b[:, 2] + w * c[:, 2] > z)[over].any())
    return hidden
