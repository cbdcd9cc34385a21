"""Public names of the package, by the module from which a user imports each."""

from __future__ import annotations

import importlib
import inspect
import pkgutil

import phasemark
from phasemark.inputs.moved_names import MOVED

ROOMS = ("phasemark", "phasemark.landmarks", "phasemark.render", "phasemark.data", "phasemark.matcher")


def public_names() -> dict[str, list[str]]:
    """Return the public names of each module that has some.

    A name is public where a package lists it in ``__all__``, or where a name that once stood in a room is now found.
    What the root module takes from a room is listed under the room alone.

    Returns
    -------
    dict of str to list of str
        Names by dotted module, the rooms first, then their sub-packages and modules in alphabetical order.
    """
    packages = ["phasemark"]
    packages += [found.name for found in pkgutil.walk_packages(phasemark.__path__, "phasemark.") if found.ispkg]
    found = {name: list(getattr(importlib.import_module(name), "__all__", [])) for name in packages}
    for places in MOVED.values():
        for place, names in places.items():
            found[place] = sorted({*found.get(place, []), *names})
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
