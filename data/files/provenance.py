"""Provenance of a result: the versions that made it, and the mesh it was made of."""

from __future__ import annotations

import hashlib
from importlib import metadata

import h5py
import numpy as np
import trimesh

from phasemark import __version__

_PACKAGES = ("embreex", "h5py", "manifold3d", "numba", "numpy", "scipy", "trimesh")


def versions() -> dict[str, str]:
    """Return the version of phasemark and of every package that a result's bytes can depend on."""
    found = {"phasemark": __version__, "hdf5": h5py.version.hdf5_version}
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "absent"  # embreex has no wheel for every platform
    return found


def mesh_sha256(mesh: trimesh.Trimesh) -> str:
    """Return the SHA-256 of a mesh: its vertices as little-endian float64, then its faces as little-endian int64.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        The mesh, metres.

    Returns
    -------
    str
        Lower-case hexadecimal.
    """
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, dtype="<i8").tobytes())
    return digest.hexdigest()
