"""Bodies of a scene: a mesh or a primitive, its albedo, its name and its pose (PHYSICS section 13)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.render.integral.shells import shells_of, unite_shells
from phasemark.render.integral.surface_mesh import SurfaceMesh
from phasemark.render.rigid import composed, rigid_transforms
from phasemark.render.scene.solids import Solid

SEGMENTS = 96
"""Sides of the polygon that stands for a circle."""
_SHARPEST = 1000.0


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of a body as the renderer asks for them, see :class:`SurfaceMesh`."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_attributes: dict[str, Any]
    metadata: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, body: Body) -> Surface:
        """Take the mesh of a body, with the albedo of each face if faces have their own."""
        attributes: dict[str, Any] = {"part": np.zeros(len(body.mesh.faces), np.int32)}
        if not isinstance(body.albedo, float):
            attributes["albedo"] = body.albedo
        metadata: dict[str, Any] = {}
        own = body.primitive
        if body.smooth and own is not None and own.has_faces_of(body.mesh):
            attributes["quadric"], metadata["quadrics"] = own.solid.quadric[own.face], own.solid.quadrics
        return cls(
            np.asarray(body.mesh.vertices, np.float64), np.asarray(body.mesh.faces, np.int64), attributes, metadata
        )


_CORNER = (math.pi / SEGMENTS) / math.sin(math.pi / SEGMENTS)
"""Radius of the polygon's corners, in radii of a circle of the same mean width (Cauchy: perimeter / π)."""


class Primitive(NamedTuple):
    """The solid that a mesh stands for.

    Parameters
    ----------
    solid : Solid
    face : (f,) int64
        The face of the solid that each triangle stands for.
    vertices, faces : (v, 3) float64, (f, 3) int64
        Of the mesh that was made of it.
    """

    solid: Solid
    face: NDArray[np.int64]
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]

    def is_of(self, mesh: SurfaceMesh) -> bool:
        """Return True if a mesh is still the one that was made."""
        return np.array_equal(mesh.vertices, self.vertices) and np.array_equal(mesh.faces, self.faces)

    def has_faces_of(self, mesh: SurfaceMesh) -> bool:
        """Return True if a mesh is still the one that was made, or that one turned inside out."""
        return np.array_equal(mesh.vertices, self.vertices) and np.array_equal(np.sort(mesh.faces), np.sort(self.faces))


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body, Lambertian unless it is given gloss.

    With lamp and lens in one place a face that is met at the angle θ returns

        a = [ ρ cos θ + s_r + s N(m) cosᵐ⁺¹ θ ] / r²,    N(m) = (m + 2)(m + 4) / (8 (m + 2^(−m/2)))

    of albedo ρ, `retroreflecting` s_r, `specular` s and `shininess` m: Lambert's law, sheeting that returns light along
    the incident ray, and Blinn-Phong's lobe, normalised.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Metres, body frame. An open mesh is seen from both sides.
    albedo : float or (f,) array_like
        Of the body, or of each face of the mesh, in [0, 1].
    name : str
        Of which a scene has no two; empty: the scene numbers it.
    pose : (4, 4) array_like
        Rigid transform body2world.
    smooth : bool
        Whether normals are interpolated between faces that meet at less than 30°, as on a mesh that stands for a curved
        surface; False: every facet is flat.
    primitive : Primitive, optional
        What the mesh stands for: the box, ellipsoid, cylinder or capsule that it was made of is rendered in its place
        as long as nobody changes the mesh, or its facets (`albedo` of each, `smooth`).
    parts : tuple of Body
        What was joined, if there are primitives in it: rendered in place of the mesh as long as nobody changes that.
    retroreflecting : float
        s_r, at all angles: 1 is a white Lambertian face seen head on, and sheeting returns hundreds.
    specular : float
        s, the share of light from straight ahead that the lobe about the mirror direction reflects.
    shininess : float
        m, 1 … 1000: cosᵐ θ falls to a half at θ = 1.18 / √m.

    Raises
    ------
    UsageError
        The mesh has no faces, a vertex is not finite, an albedo is out of range, or the pose is not rigid; gloss is out
        of range, or a body's albedo and `specular` together are above 1.

    Examples
    --------
    >>> from phasemark.render import Body
    >>> import trimesh
    >>> Body.box((1.0, 1.0, 0.02), pose=trimesh.transformations.translation_matrix((1.5, 0, -0.3)), name="table")
    Body('table', 12 faces, albedo 0.8, at (1.5, 0, -0.3) m)
    """

    mesh: SurfaceMesh
    albedo: float | NDArray[np.float64] = 0.8
    name: str = ""
    pose: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    smooth: bool = True
    primitive: Primitive | None = field(default=None, repr=False)
    parts: tuple[Body, ...] = field(default=(), repr=False)
    retroreflecting: float = 0.0
    specular: float = 0.0
    shininess: float = 32.0

    def __post_init__(self) -> None:
        if not (hasattr(self.mesh, "vertices") and hasattr(self.mesh, "faces")):
            raise UsageError(f"{self._who}: 'mesh' must be a mesh, got {type(self.mesh).__name__}")
        vertices, faces = np.asarray(self.mesh.vertices, np.float64), np.asarray(self.mesh.faces)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise UsageError(f"{self._who}: 'mesh' must have vertices (v, 3) and at least one face (f, 3)")
        if not np.isfinite(vertices).all():
            raise UsageError(f"{self._who}: vertex {int(np.argmin(np.isfinite(vertices).all(axis=1)))} is not finite")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise UsageError(f"{self._who}: a face names a vertex that is not there, counted from 0")
        corners = vertices[faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        if not (area > 1e-14 * np.ptp(vertices, axis=0).max() ** 2).any():  # as MeshTopology drops faces
            raise UsageError(f"{self._who}: no face of the mesh has an area")
        try:
            albedo = np.asarray(self.albedo, np.float64)
        except (TypeError, ValueError):
            raise UsageError(f"{self._who}: 'albedo' must be numbers, got {self.albedo!r}") from None
        if albedo.shape not in ((), (len(faces),)):
            raise UsageError(
                f"{self._who}: 'albedo' must be a number or one for each of {len(faces)} faces, got {albedo.shape}"
            )
        wrong = albedo[~((albedo >= 0) & (albedo <= 1))]
        if wrong.size:
            raise UsageError(f"{self._who}: 'albedo' must be in [0, 1], got {wrong.flat[0]:g}")
        self._check_gloss(float(albedo.max()))
        object.__setattr__(self, "albedo", float(albedo) if albedo.ndim == 0 else albedo)
        object.__setattr__(self, "pose", rigid_transforms(self.pose, f"pose of {self._who}")[0])

    def _check_gloss(self, albedo: float) -> None:
        """Refuse gloss that is out of range, or that reflects more than comes in."""
        bounds = {"retroreflecting": (0.0, math.inf), "specular": (0.0, 1.0), "shininess": (1.0, _SHARPEST)}
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if not (isinstance(value, (int, float, np.number)) and math.isfinite(value) and low <= value <= high):
                allowed = f"in [{low:g}, {high:g}]" if math.isfinite(high) else "finite and at least 0"
                raise UsageError(f"{self._who}: '{name}' must be {allowed}, got {value!r}")
        rounding = 1e-9
        if self.specular > 0 and albedo + self.specular > 1 + rounding:
            raise UsageError(
                f"{self._who}: 'albedo' and 'specular' together must be at most 1, got {albedo:g} + {self.specular:g}"
            )

    @property
    def is_glossy(self) -> bool:
        """Whether the body returns more than Lambertian light."""
        return self.retroreflecting > 0 or self.specular > 0

    @property
    def _who(self) -> str:
        return f"body '{self.name}'" if self.name else "a body"

    def __repr__(self) -> str:
        """Describe in one line the body's name, size, albedo and place."""
        albedo = f"{self.albedo:g}" if isinstance(self.albedo, float) else "of each face"
        place = ", ".join(f"{x:g}" for x in self.pose[:3, 3])
        return f"Body('{self.name}', {len(self.mesh.faces)} faces, albedo {albedo}, at ({place}) m)"

    @property
    def solid(self) -> Solid | None:
        """What is rendered in place of the mesh."""
        own = self.primitive
        if own is None or not (self.smooth and isinstance(self.albedo, float)):
            return None
        return own.solid if own.is_of(self.mesh) else None

    def pieces(self) -> list[Body]:
        """Return the bodies that are rendered in its place: its parts, each where it stands in the body, or itself."""
        vertices, faces = _put_together(self.parts)
        if not (np.array_equal(self.mesh.vertices, vertices) and np.array_equal(self.mesh.faces, faces)):
            return [replace(self, pose=np.eye(4))]
        pieces, end = [], 0
        for part in self.parts:
            begin, end = end, end + len(part.mesh.faces)
            gloss = {key: getattr(self, key) for key in ("retroreflecting", "specular", "shininess")}
            albedo = self.albedo if isinstance(self.albedo, float) else _one_if_equal(self.albedo[begin:end])
            pieces.append(replace(part, albedo=albedo, name=self.name, smooth=self.smooth, **gloss))
        return pieces

    def shells(self) -> list[Body]:
        """Return the body in pieces that no edge joins, those that run through one another united; or itself."""
        mesh = unite_shells(Surface.of(self))
        shells = shells_of(mesh)
        if len(shells) == 1:
            return [self]
        albedo = np.broadcast_to(mesh.face_attributes.get("albedo", self.albedo), len(mesh.faces))
        return [
            replace(self, mesh=trimesh.Trimesh(points, faces, process=False), albedo=_one_if_equal(albedo[number]),
                    primitive=None, parts=())
            for points, faces, number in shells
        ]  # fmt: skip

    def named(self, name: str) -> Body:
        """Return the body under another name."""
        return replace(self, name=name)

    def with_gloss(self, *, retroreflecting: float = 0.0, specular: float = 0.0, shininess: float = 32.0) -> Body:
        """Return the body with a retroreflecting or specular share, see the class.

        Examples
        --------
        >>> from phasemark.render import Body
        >>> Body.sphere(0.1, albedo=0.4).with_gloss(specular=0.1, shininess=50.0).is_glossy
        True
        """
        return replace(self, retroreflecting=retroreflecting, specular=specular, shininess=shininess)

    def inside_out(self) -> Body:
        """Return the body with its faces turned over, as a room that is seen from inside.

        Examples
        --------
        >>> from phasemark.render import Body
        >>> room = Body.box((5.0, 4.0, 2.5), albedo=0.6, name="room").inside_out()
        """
        vertices, faces = np.asarray(self.mesh.vertices), np.asarray(self.mesh.faces)
        return replace(self, mesh=trimesh.Trimesh(vertices, faces[:, ::-1], process=False))

    @classmethod
    def joined(cls, bodies: Iterable[Body], name: str = "") -> Body:
        """Return bodies as one in the frame in which they stand: where solids run through one another, they unite.

        Parameters
        ----------
        bodies : iterable of Body
        name : str

        Raises
        ------
        UsageError
            There is none, or they differ in `smooth` or in gloss.
        """
        parts = list(bodies)
        if len({(part.smooth, part.retroreflecting, part.specular, part.shininess) for part in parts}) != 1:
            raise UsageError("bodies that are joined must be at least one, and agree in 'smooth' and in gloss")
        pieces = tuple(
            replace(piece, pose=composed(part.pose, piece.pose)) for part in parts for piece in part.pieces()
        )
        vertices, faces = _put_together(pieces)
        albedo = np.concatenate([np.broadcast_to(piece.albedo, len(piece.mesh.faces)) for piece in pieces])
        return replace(
            parts[0],
            mesh=trimesh.Trimesh(vertices, faces, process=False),
            albedo=_one_if_equal(albedo),
            name=name,
            pose=np.eye(4),
            primitive=None,
            parts=pieces if any(piece.primitive for piece in pieces) else (),
        )

    @classmethod
    def box(cls, size_m: ArrayLike, *, albedo: float = 0.8, name: str = "", pose: ArrayLike | None = None) -> Body:
        """Return a box around the origin.

        Parameters
        ----------
        size_m : (3,) array_like
            Lengths of its sides along x, y and z.
        albedo, name, pose
            As for the class; no pose: the identity.
        """
        size = _lengths(size_m, 3, "size_m")
        mesh = trimesh.creation.box(size)
        solid = Solid.box(size)
        face = np.argmax(np.asarray(mesh.face_normals) @ solid.planes[:, :3].T, axis=1)
        return cls._of(mesh, albedo, name, pose, solid, face)

    @classmethod
    def plane(cls, size_m: ArrayLike, *, albedo: float = 0.8, name: str = "", pose: ArrayLike | None = None) -> Body:
        """Return a rectangle in the plane z = 0 of the body, seen from both sides.

        Parameters
        ----------
        size_m : (2,) array_like
            Lengths of its sides along x and y.
        albedo, name, pose
            As for the class; no pose: the identity.
        """
        x, y = 0.5 * _lengths(size_m, 2, "size_m")
        corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
        return cls._of(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False), albedo, name, pose)

    @classmethod
    def sphere(cls, radius_m: float, *, albedo: float = 0.8, name: str = "", pose: ArrayLike | None = None) -> Body:
        """Return a sphere around the origin, as :meth:`ellipsoid` with three equal half axes."""
        return cls.ellipsoid((radius_m,) * 3, albedo=albedo, name=name, pose=pose)

    @classmethod
    def ellipsoid(
        cls, half_axes_m: ArrayLike, *, albedo: float = 0.8, name: str = "", pose: ArrayLike | None = None
    ) -> Body:
        """Return an ellipsoid around the origin.

        Facets lie a little outside of the surface at their corners and a little inside in their middle, so that the
        outline has the right area on average over all directions (Cauchy's formula).

        Parameters
        ----------
        half_axes_m : (3,) array_like
        albedo, name, pose
            As for the class; no pose: the identity.
        """
        half = _lengths(half_axes_m, 3, "half_axes_m")
        angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, SEGMENTS // 2 + 1)
        ball = _turned(np.cos(angle), np.sin(angle))
        ball.vertices = ball.vertices * half * math.sqrt(4 * math.pi / ball.area)
        return cls._of(ball, albedo, name, pose, Solid.ellipsoid(half), np.zeros(len(ball.faces)))

    @classmethod
    def cylinder(
        cls, radius_m: float, height_m: float, *, albedo: float = 0.8, name: str = "", pose: ArrayLike | None = None
    ) -> Body:
        """Return a cylinder along z around the origin.

        Parameters
        ----------
        radius_m, height_m : float
        albedo, name, pose
            As for the class; no pose: the identity.
        """
        radius, height = _lengths((radius_m, height_m), 2, "radius_m, height_m")
        rho, z = np.array([0.0, 1.0, 1.0, 0.0]), np.array([-0.5, -0.5, 0.5, 0.5])
        mesh = _turned(radius * _CORNER * rho, height * z)
        up = np.asarray(mesh.face_normals)[:, 2]
        steep = math.sqrt(0.5)
        face = np.where(up > steep, 1, np.where(up < -steep, 2, 0))
        return cls._of(mesh, albedo, name, pose, Solid.cylinder(radius, height), face)

    @classmethod
    def capsule(
        cls, radius_m: float, height_m: float, *, albedo: float = 0.8, name: str = "", pose: ArrayLike | None = None
    ) -> Body:
        """Return a cylinder along z around the origin with half a sphere at either end.

        Parameters
        ----------
        radius_m : float
        height_m : float
            Of the cylinder between the half spheres.
        albedo, name, pose
            As for the class; no pose: the identity.
        """
        radius, height = _lengths((radius_m, height_m), 2, "radius_m, height_m")
        angle = np.linspace(0.0, 0.5 * math.pi, SEGMENTS // 4 + 1)
        rho, z = radius * _CORNER * np.cos(angle), radius * _CORNER * np.sin(angle) + 0.5 * height
        mesh = _turned([*rho[::-1], *rho], [*-z[::-1], *z])
        middle = mesh.triangles_center[:, 2]
        face = np.where(middle > 0.5 * height, 3, np.where(middle < -0.5 * height, 4, 0))
        return cls._of(mesh, albedo, name, pose, Solid.capsule(radius, height), face)

    @classmethod
    def height_field(
        cls,
        heights_m: ArrayLike,
        size_m: ArrayLike,
        *,
        base_m: float = 0.1,
        albedo: float = 0.8,
        name: str = "",
        pose: ArrayLike | None = None,
    ) -> Body:
        """Return a solid whose top is a height field and whose bottom is flat.

        Parameters
        ----------
        heights_m : (rows, cols) array_like
            z of the top; columns along x, rows along y, both rising.
        size_m : (2,) array_like
            Lengths of the sides along x and y; the origin is below the middle.
        base_m : float
            How far below z = 0, or the lowest point of the top if that is lower, the bottom lies.
        albedo, name, pose
            As for the class; no pose: the identity.
        """
        heights = np.asarray(heights_m, np.float64)
        if heights.ndim != 2 or min(heights.shape) < 2 or not np.isfinite(heights).all():
            raise UsageError(f"'heights_m' must be finite, (rows, cols) of at least 2 × 2, got {heights.shape}")
        size, base = _lengths(size_m, 2, "size_m"), float(_lengths((base_m,), 1, "base_m")[0])
        rows, cols = heights.shape
        x, y = np.meshgrid(size[0] * np.linspace(-0.5, 0.5, cols), size[1] * np.linspace(-0.5, 0.5, rows))
        top = np.stack([x, y, heights], axis=-1).reshape(-1, 3)
        number = np.arange(rows * cols).reshape(rows, cols)
        a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
        upper = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
        rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
        below = top[rim] * [1, 1, 0] - [0, 0, base - min(float(heights.min()), 0.0)]
        centre = len(top) + len(rim)
        first = len(top) + np.arange(len(rim))
        after = np.roll(first, -1)
        sides = np.concatenate(
            [
                np.column_stack([rim, first, after]),
                np.column_stack([rim, after, np.roll(rim, -1)]),
                np.column_stack([np.full(len(rim), centre), after, first]),
            ]
        )
        middle = np.array([[0.0, 0.0, below[0, 2]]])
        solid = trimesh.Trimesh(np.concatenate([top, below, middle]), np.concatenate([upper, sides]), process=False)
        return cls._of(solid, albedo, name, pose)

    @classmethod
    def _of(
        cls,
        mesh: trimesh.Trimesh,
        albedo: float,
        name: str,
        pose: ArrayLike | None,
        solid: Solid | None = None,
        face: ArrayLike = (),
    ) -> Body:
        """Return a body of a mesh that stands for a solid."""
        own = None
        if solid is not None:
            vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
            own = Primitive(solid, np.asarray(face, np.int64), vertices, faces)
        return cls(mesh, albedo, name, np.eye(4) if pose is None else np.asarray(pose), primitive=own)


def _put_together(bodies: Iterable[Body]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return vertices and faces of bodies where they stand, one after another."""
    vertices, faces, first = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for body in bodies:
        vertices.append(trimesh.transform_points(np.asarray(body.mesh.vertices), body.pose))
        faces.append(np.asarray(body.mesh.faces) + first)
        first += len(vertices[-1])
    return np.concatenate(vertices), np.concatenate(faces)


def _one_if_equal(albedo: NDArray[np.float64]) -> float | NDArray[np.float64]:
    """Return one albedo if all faces have the same."""
    return float(albedo[0]) if (albedo == albedo[0]).all() else albedo


def _lengths(values: ArrayLike, n: int, name: str) -> NDArray[np.float64]:
    """Return n positive lengths."""
    try:
        found = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (n,) or not (np.isfinite(found) & (found > 0)).all():
        raise UsageError(f"'{name}' must be {n} positive number{'s' * (n > 1)} of metres, got {values!r}")
    return found


def _turned(radius_m: ArrayLike, z_m: ArrayLike) -> trimesh.Trimesh:
    """Return a solid of revolution about z from its profile, bottom to top."""
    return trimesh.creation.revolve(np.column_stack([radius_m, z_m]), sections=SEGMENTS)
