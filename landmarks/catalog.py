"""The four classes of PHYSICS section 5."""

from __future__ import annotations

from phasemark import UsageError
from phasemark.landmarks.spec import Box, Cone, Cylinder, LandmarkSpec, Sphere

_BOX = Box(length_m=0.24, width_m=0.16, height_m=0.15)


class _Catalog(dict[str, LandmarkSpec]):
    """Landmarks by name; what asks for another is told which there are."""

    def __missing__(self, name: object) -> LandmarkSpec:
        raise UsageError(f"no landmark '{name}': {', '.join(self)}")


def catalog() -> dict[str, LandmarkSpec]:
    """Return the catalogue: ``cylinder``, ``cone``, ``sphere`` and ``post``, each 0.15 m high on the same box.

    Returns
    -------
    dict of str to LandmarkSpec
        A new dictionary, in the order above.

    Raises
    ------
    UsageError
        The dictionary is asked for a name that it does not have.

    Examples
    --------
    >>> list(catalog())
    ['cylinder', 'cone', 'sphere', 'post']
    """
    height_m = 0.15
    uppers: dict[str, Cylinder | Cone | Sphere] = {
        "cylinder": Cylinder(radius_m=0.06, height_m=height_m),
        "cone": Cone(radius_m=0.075, height_m=height_m),
        "sphere": Sphere(radius_m=height_m / 2),
        "post": Cylinder(radius_m=0.035, height_m=height_m),
    }
    return _Catalog({name: LandmarkSpec(name=name, box=_BOX, upper=upper) for name, upper in uppers.items()})


def class_of_catalog(name: str) -> LandmarkSpec:
    """Return a class of the catalogue that a user names.

    Parameters
    ----------
    name : str

    Raises
    ------
    UsageError
        The catalogue does not have it.
    """
    known = catalog()
    if name not in known:
        raise UsageError(f"unknown class {name!r}: the catalogue has {', '.join(known)}")
    return known[name]
