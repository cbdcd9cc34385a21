"""Landmarks: their parts, the catalogue, and meshes from files."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use
from phasemark.landmarks.catalog import catalog
from phasemark.landmarks.spec import LandmarkSpec

if TYPE_CHECKING:
    from phasemark.landmarks.figures import mesh_figure
    from phasemark.landmarks.mesh import build_mesh
    from phasemark.landmarks.mesh_files import check_mesh, export_mesh, read_mesh
    from phasemark.landmarks.symmetry import mesh_symmetry
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)  # trimesh and matplotlib take time to import

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
    from phasemark.landmarks.mesh import build_mesh

    return mesh_figure(build_mesh(spec))


LandmarkSpec.figure = staticmethod(_figure)
