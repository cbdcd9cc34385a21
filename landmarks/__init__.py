"""What stands in the world: the parts, the catalogue, and meshes from files."""

from phasemark.landmarks.catalog import catalog
from phasemark.landmarks.mesh import DEFAULT_TOLERANCE_M, LOWER, MAX_FACES, UPPER, build_mesh
from phasemark.landmarks.spec import Box, Cone, Cylinder, LandmarkSpec, Revolution, Sphere

__all__ = [
    "DEFAULT_TOLERANCE_M",
    "LOWER",
    "MAX_FACES",
    "UPPER",
    "Box",
    "Cone",
    "Cylinder",
    "LandmarkSpec",
    "Revolution",
    "Sphere",
    "build_mesh",
    "catalog",
]
