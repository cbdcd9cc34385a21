"""Landmarks: their parts, the catalogue, and meshes from files."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use
from phasemark.landmarks.catalog import catalog
from phasemark.landmarks.mesh import build_mesh
from phasemark.landmarks.mesh_files import check_mesh, export_mesh, read_mesh
from phasemark.landmarks.spec import LandmarkSpec
from phasemark.landmarks.symmetry import mesh_symmetry

if TYPE_CHECKING:
    from phasemark.landmarks.figures import mesh_figure

__all__ = [
    "LandmarkSpec",
    "build_mesh",
    "catalog",
    "check_mesh",
    "export_mesh",
    "mesh_figure",
    "mesh_symmetry",
    "read_mesh",
]


def _figure(spec: LandmarkSpec) -> bytes:
    """Draw a landmark as a PNG."""
    from phasemark.landmarks.figures import mesh_figure

    return mesh_figure(build_mesh(spec))


LandmarkSpec.figure = staticmethod(_figure)


def __getattr__(name: str) -> object:
    """Import figures when they are asked for, since matplotlib takes half a second to load; find names that moved."""
    if name == "mesh_figure":
        from phasemark.landmarks.figures import mesh_figure

        return mesh_figure
    return on_use.moved_name(__name__, name)
