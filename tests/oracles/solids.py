"""The catalogue's solids met by rays in closed form."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from phasemark.landmarks import catalog
from phasemark.landmarks.spec import Cone, Cylinder, Sphere

Hit: TypeAlias = tuple[NDArray[Any], NDArray[Any]]
"""Range and cosine of the angle of incidence, (n,) each; inf and 0 where nothing is met."""


def first_hit(name: str, origin: NDArray[Any], d: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return where rays from one point first meet a landmark.

    Parameters
    ----------
    name : str
        Class of the catalogue.
    origin : (3,)
    d : (n, 3)
        Unit vectors, landmark frame.

    Returns
    -------
    range_m : (n,)
        inf where nothing is met.
    cos_theta : (n,)
    part : (n,)
        1 for the box, 2 for what stands on it.
    """
    upper = catalog()[name].upper
    if isinstance(upper, Sphere):
        hits = [(*_sphere(origin, d, upper.radius_m), 2)]
    elif isinstance(upper, Cone):
        hits = [(*_cone(origin, d, upper.radius_m, upper.height_m), 2)]
    else:
        assert isinstance(upper, Cylinder)
        hits = [(*_side(origin, d, upper.radius_m, upper.height_m), 2)]
        hits.append((*_lid(origin, d, upper.radius_m, upper.height_m), 2))
    hits.append((*_box(origin, d, np.array([0.24, 0.16, 0.15])), 1))
    t = np.stack([hit[0] for hit in hits])
    nearest = t.argmin(axis=0)
    cos = np.take_along_axis(np.stack([hit[1] for hit in hits]), nearest[None], axis=0)[0]
    return t.min(axis=0), cos, np.array([hit[2] for hit in hits])[nearest]


def _keep(t: NDArray[Any], cos: NDArray[Any], good: NDArray[Any]) -> Hit:
    good = good & (t > 0)
    return np.where(good, t, np.inf), np.where(good, cos, 0.0)


def _roots(a: NDArray[Any], b: NDArray[Any], c: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return both roots of a t² + 2 b t + c, nan where there are none."""
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(b * b - a * c)
        return (-b - root) / a, (-b + root) / a


def _sphere(o: NDArray[Any], d: NDArray[Any], radius: float) -> Hit:
    o = o - [0, 0, radius]
    t, _ = _roots(np.ones(len(d)), d @ o, o @ o - radius**2)
    normal = (o + t[:, None] * d) / radius
    return _keep(t, -np.einsum("ij,ij->i", normal, d), np.isfinite(t))


def _side(o: NDArray[Any], d: NDArray[Any], radius: float, height: float) -> Hit:
    t, _ = _roots((d[:, :2] ** 2).sum(axis=1), d[:, :2] @ o[:2], o[:2] @ o[:2] - radius**2)
    p = o + t[:, None] * d
    return _keep(t, -np.einsum("ij,ij->i", p[:, :2] / radius, d[:, :2]), (p[:, 2] >= 0) & (p[:, 2] <= height))


def _lid(o: NDArray[Any], d: NDArray[Any], radius: float, height: float) -> Hit:
    with np.errstate(divide="ignore"):
        t = (height - o[2]) / d[:, 2]
    p = o[:2] + t[:, None] * d[:, :2]
    return _keep(t, -d[:, 2], ((p**2).sum(axis=1) <= radius**2) & (d[:, 2] < 0))


def _cone(o: NDArray[Any], d: NDArray[Any], radius: float, height: float) -> Hit:
    k = (radius / height) ** 2
    w = o[2] - height
    a = (d[:, :2] ** 2).sum(axis=1) - k * d[:, 2] ** 2
    b = d[:, :2] @ o[:2] - k * w * d[:, 2]
    t, _ = _roots(a, b, o[:2] @ o[:2] - k * w * w)
    p = o + t[:, None] * d
    normal = np.column_stack([p[:, :2], k * (height - p[:, 2])])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return _keep(t, -np.einsum("ij,ij->i", normal, d), (p[:, 2] >= 0) & (p[:, 2] <= height))


def _box(o: NDArray[Any], d: NDArray[Any], size: NDArray[Any]) -> Hit:
    low, high = np.array([-size[0] / 2, -size[1] / 2, -size[2]]), np.array([size[0] / 2, size[1] / 2, 0.0])
    with np.errstate(divide="ignore"):
        a, b = (low - o) / d, (high - o) / d
    near, far = np.minimum(a, b), np.maximum(a, b)
    axis = near.argmax(axis=1)
    t = near.max(axis=1)
    return _keep(t, np.abs(d[np.arange(len(d)), axis]), t <= far.min(axis=1))
