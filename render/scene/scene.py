"""A scene: bodies that hide one another."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from phasemark import InputFileError, UsageError
from phasemark.render.rigid import rigid_transforms
from phasemark.render.scene.body import Body
from phasemark.render.scene.mesh_files import bodies_of_trimesh, loaded_meshes


class Scene:
    """Bodies, each with a name of its own.

    Parameters
    ----------
    bodies : iterable of Body
        Those without a name get the number at which they stand, as in "body 3".

    Raises
    ------
    UsageError
        There is no body, or two have one name.

    Examples
    --------
    >>> from phasemark.render import Body, Scene
    >>> Scene([Body.sphere(0.1, name="ball"), Body.plane((2, 2))]).names
    ('ball', 'body 1')
    """

    def __init__(self, bodies: Iterable[Body]) -> None:
        given = list(bodies) if isinstance(bodies, Iterable) else [bodies]
        wrong = [type(body).__name__ for body in given if not isinstance(body, Body)]
        if wrong:
            raise UsageError(f"a scene is made of Body objects, got {wrong[0]}")
        if not given:
            raise UsageError("a scene needs at least one body")
        self.bodies = tuple(body if body.name else body.named(f"body {k}") for k, body in enumerate(given))
        self.names = tuple(body.name for body in self.bodies)
        """Names of the bodies, in the order of ``shares``."""
        twice = [name for name, count in Counter(self.names).items() if count > 1]
        if twice:
            raise UsageError(f"two bodies are named '{twice[0]}': names of bodies must differ")

    def __repr__(self) -> str:
        """Describe in one line how many bodies and faces there are."""
        return f"Scene({len(self)} bodies, {sum(len(body.mesh.faces) for body in self)} faces)"

    def __len__(self) -> int:
        return len(self.bodies)

    def __iter__(self) -> Iterator[Body]:
        return iter(self.bodies)

    def __getitem__(self, name: str) -> Body:
        """Return the body of a name."""
        return self.bodies[self.index(name)]

    @property
    def poses(self) -> NDArray[np.float64]:
        """Where the bodies stand unless a frame says otherwise, body2world, (b, 4, 4)."""
        return np.array([body.pose for body in self.bodies])

    def index(self, name: str) -> int:
        """Return the number of the body of a name.

        Raises
        ------
        UsageError
            There is none.
        """
        if name not in self.names:
            raise UsageError(f"no body is named '{name}': there are {', '.join(self.names[:8])}")
        return self.names.index(name)

    @classmethod
    def of_trimesh(cls, scene: trimesh.Scene, *, albedo: float | None = None) -> Scene:
        """Return the meshes of a trimesh scene as bodies, named as its nodes.

        Parameters
        ----------
        scene : trimesh.Scene
            Metres.
        albedo : float, optional
            Of all bodies; None: the mean luminance (Rec. 709) of each mesh's material or of its face colours, 0.8 where
            it has neither.

        Raises
        ------
        UsageError
            The scene has no mesh.
        """
        return cls(bodies_of_trimesh(scene, albedo))

    @classmethod
    def read(cls, path: str | Path, *, albedo: float | None = None) -> Scene:
        """Return a scene of a file: glTF, GLB, OBJ with materials, PLY and others that trimesh reads, URDF or MJCF.

        Parameters
        ----------
        path : path
            In metres. Of a URDF the visual geometry of each link is a body, named as the link, with all joints at 0.
            MJCF (.xml) and compiled models (.mjb) need the extra ``[mujoco]``; their geoms are seen as in MuJoCo's
            viewer, at the first positions of the joints.
        albedo : float, optional
            As for :meth:`of_trimesh`.

        Raises
        ------
        InputFileError
            The file is missing, cannot be read or holds no mesh.
        UsageError
            The package that a format needs is not installed.
        """
        path = Path(path)
        if not path.is_file():
            raise InputFileError(f"{path}: there is no such file")
        if path.suffix.lower() == ".urdf":
            from phasemark.render.scene.urdf import links_of_urdf

            return cls(links_of_urdf(path, albedo))
        if path.suffix.lower() in (".xml", ".mjcf", ".mjb"):
            from phasemark.render.scene.mujoco_scene import bodies_of_mjcf

            return cls(bodies_of_mjcf(path, albedo))
        return cls(bodies_of_trimesh(loaded_meshes(path), albedo))

    def posed(self, bodies2world: ArrayLike | dict[str, ArrayLike] | None, n: int) -> NDArray[np.float64]:
        """Return where the bodies stand in each of n frames, (n, b, 4, 4).

        Parameters
        ----------
        bodies2world : (b, 4, 4) or (n, b, 4, 4) array_like, or a mapping from names to (4, 4) or (n, 4, 4), optional
            A mapping leaves bodies that it does not name where they are.
        n : int

        Raises
        ------
        UsageError
            A shape or a name is wrong, or a pose is not rigid.
        """
        poses = np.repeat(self.poses[None], n, axis=0)
        if bodies2world is None:
            return poses
        if isinstance(bodies2world, dict):
            for name, given in bodies2world.items():
                own = rigid_transforms(given, f"pose of body '{name}'")
                if len(own) not in (1, n):
                    raise UsageError(f"body '{name}' has {len(own)} poses for {n} frames")
                poses[:, self.index(name)] = own
            return poses
        array: NDArray[Any] = np.asarray(bodies2world, np.float64)
        if array.shape not in ((len(self), 4, 4), (n, len(self), 4, 4)):
            raise UsageError(
                f"'bodies2world' must have shape ({len(self)}, 4, 4) or ({n}, {len(self)}, 4, 4), got {array.shape}"
            )
        try:
            rigid_transforms(array.reshape(-1, 4, 4), "bodies2world")
        except UsageError:
            for b, name in enumerate(self.names):
                rigid_transforms(array.reshape(-1, len(self), 4, 4)[:, b], f"pose of body '{name}'")
        poses[:] = array
        return poses
