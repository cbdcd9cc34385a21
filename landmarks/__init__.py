"""What stands in the world: the parts, the catalogue, and meshes from files."""

from typing import TYPE_CHECKING

from phasemark.landmarks.catalog import catalog
from phasemark.landmarks.mesh import DEFAULT_TOLERANCE_M, LOWER, MAX_FACES, UPPER, build_mesh
from phasemark.landmarks.mesh_files import MeshReport, MeshWarning, check_mesh, export_mesh, read_mesh
from phasemark.landmarks.spec import Box, Cone, Cylinder, LandmarkSpec, Revolution, Sphere
from phasemark.landmarks.symmetry import MAX_SYMMETRY, has_symmetry, mesh_symmetry, symmetry_tolerance_m

if TYPE_CHECKING:
    from phasemark.landmarks.figures import mesh_figure, mesh_html

__all__ = [
    "DEFAULT_TOLERANCE_M",
    "LOWER",
    "MAX_FACES",
    "MAX_SYMMETRY",
    "UPPER",
    "Box",
    "Cone",
    "Cylinder",
    "LandmarkSpec",
    "MeshReport",
    "MeshWarning",
    "Revolution",
    "Sphere",
    "build_mesh",
    "catalog",
    "check_mesh",
    "export_mesh",
    "has_symmetry",
    "mesh_figure",
    "mesh_html",
    "mesh_symmetry",
    "read_mesh",
    "symmetry_tolerance_m",
]


def _figure(spec: LandmarkSpec) -> bytes:
    """Draw a landmark as a PNG."""
    from phasemark.landmarks.figures import mesh_figure

    return mesh_figure(build_mesh(spec))


LandmarkSpec.figure = staticmethod(_figure)


def __getattr__(name: str) -> object:
    """Import figures when they are asked for: matplotlib takes half a second to load."""
    if name in ("mesh_html", "mesh_figure"):
        from phasemark.landmarks import figures

        return getattr(figures, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
