"""Public names of the package, by the module from which a user imports each."""

from __future__ import annotations

import importlib
import inspect
import pkgutil

import phasemark

ROOMS = ("phasemark", "phasemark.landmarks", "phasemark.render", "phasemark.data", "phasemark.matcher")
OF_MODULES = {
    "phasemark.data.partial_outputs": ("build_part", "estimate_build", "merge_parts", "parse_part"),
    "phasemark.data.verify": ("verify_bank", "verify_frames"),
    "phasemark.landmarks.figures": ("mesh_html",),
    "phasemark.landmarks.mesh": ("DEFAULT_TOLERANCE_M", "LOWER", "MAX_FACES", "UPPER"),
    "phasemark.landmarks.mesh_files": ("MeshReport", "MeshWarning"),
    "phasemark.landmarks.spec": ("Box", "Cone", "Cylinder", "Revolution", "Sphere"),
    "phasemark.landmarks.symmetry": ("MAX_SYMMETRY", "has_symmetry", "symmetry_tolerance_m"),
    "phasemark.matcher.match": ("Candidate",),
    "phasemark.matcher.statistics": (
        "ErrorStatistics",
        "Interval",
        "binomial_interval",
        "error_statistics",
        "mean_interval",
        "nees",
        "rms_interval",
        "within_ellipsoid",
    ),
    "phasemark.render.figures": ("PAPER_CMAP", "range_figure", "terminal_figure"),
    "phasemark.render.phasor_images": ("wrap_difference_m", "wrap_range_m"),
    "phasemark.render.planar": ("PlanarLandmark", "planar_images"),
    "phasemark.render.simulators.gymnasium": ("TofObservation",),
    "phasemark.render.simulators.mujoco": ("TofReading", "TofSensor", "TofTruth"),
    "phasemark.render.view": ("delta_period_rad", "wrap_delta_difference_rad", "wrap_delta_rad"),
}
"""Public names of modules that are no packages, and that no package lists."""


def public_names() -> dict[str, list[str]]:
    """Return the public names of each module that has some.

    A name is public where a package lists it in ``__all__``, or where `OF_MODULES` has it. What the root module takes
    from a room is listed under the room alone.

    Returns
    -------
    dict of str to list of str
        Names by dotted module, the rooms first, then their sub-packages and modules in alphabetical order.
    """
    packages = ["phasemark"]
    packages += [found.name for found in pkgutil.walk_packages(phasemark.__path__, "phasemark.") if found.ispkg]
    found = {name: list(getattr(importlib.import_module(name), "__all__", [])) for name in packages}
    found |= {module: list(names) for module, names in OF_MODULES.items()}
    rooms = {name for room in ROOMS[1:] for name in found[room]}
    found["phasemark"] = [name for name in found["phasemark"] if name not in rooms]
    order = sorted(name for name in found if found[name] and name not in ROOMS)
    return {name: [each for each in found[name] if each != "__version__"] for name in (*ROOMS, *order)}


def described_at(module: str, name: str) -> str:
    """Return the dotted name under which the site describes a public name.

    It is the place of import, unless a module of the same name lies there: then the place where the name is defined.

    Parameters
    ----------
    module, name : str

    Returns
    -------
    str
    """
    place = f"{module}.{name}"
    known = inspect.getattr_static(importlib.import_module(module), name, None)
    return f"{place}.{name}" if getattr(known, "__module__", None) == place else place
