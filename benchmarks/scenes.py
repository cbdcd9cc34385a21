"""Scenes of 50 bodies: frames per second, still and moving, beside dense rays of Embree and of MuJoCo."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark.render import Body, Scene, SceneRenderer, Sensor, preset
from phasemark.render.integral.intersect import make_intersector

_BODIES, _FRAMES, _DENSE = 50, 24, (32, 64, 128)


def scenes(seed: int, median_seconds: Callable[..., float]) -> dict[str, Any]:
    """Time boxes, and round bodies among boxes, on a table; two threads, 8 × 8 pixels of 45°."""
    camera = preset("pmd-16x16").with_(rows=8, cols=8, half_angle_h_deg=22.5, half_angle_v_deg=22.5)
    rows = []
    for kind in ("boxes", "mixed"):
        bodies = _bodies(kind, np.random.default_rng(seed))
        for name, sensor in (("phasors", camera), ("histograms", preset("vl53l5cx-8x8"))):
            for rays, how in ((None, ""), (10, ", 10 × 10 rays a pixel")):
                rows += _timed(f"{_BODIES} {kind}, {name}{how}", bodies, sensor, rays, median_seconds)
    return {"rows": rows, "dense rays before 50 boxes": _dense(_bodies("boxes", np.random.default_rng(seed)), camera)}


def _bodies(kind: str, rng: np.random.Generator) -> list[Body]:
    """Return a table and bodies that stand on it and hang above it, none in another by intention."""
    table = Body.box((3.0, 3.0, 0.05), pose=_at((2.0, 0.0, -0.025)), albedo=0.4)
    bodies = [table]
    while len(bodies) < _BODIES:
        size = rng.uniform(0.03, 0.12)
        pose = trimesh.transformations.random_rotation_matrix(rng.random(3))
        pose[:3, 3] = rng.uniform((0.8, -1.0, 0.1), (3.0, 1.0, 1.0))
        albedo = float(rng.uniform(0.2, 0.9))
        which = len(bodies) % 3 if kind == "mixed" else 0
        if which == 0:
            bodies.append(Body.box(size * rng.uniform(0.6, 2.0, 3), pose=pose, albedo=albedo))
        elif which == 1:
            bodies.append(Body.sphere(0.7 * size, pose=pose, albedo=albedo))
        else:
            bodies.append(Body.capsule(0.5 * size, size, pose=pose, albedo=albedo))
    return bodies


def _at(place_m: tuple[float, float, float]) -> NDArray[np.float64]:
    return np.asarray(trimesh.transformations.translation_matrix(place_m))


def _placed(body: Body) -> trimesh.Trimesh:
    """Return the mesh of a body where it stands."""
    return trimesh.Trimesh(body.mesh.vertices, body.mesh.faces, process=False).apply_transform(body.pose)


def _timed(
    what: str, bodies: list[Body], sensor: Sensor, rays: int | None, median_seconds: Callable[..., float]
) -> list[dict[str, Any]]:
    """Time frames of a camera that moves, then of one body and of all bodies that move too."""
    renderer = SceneRenderer(Scene(bodies), sensor, rays=rays)
    cameras = np.repeat(_at((-0.3, 0.0, 0.5))[None], _FRAMES, axis=0)
    cameras[:, 1, 3] = np.linspace(-0.2, 0.2, _FRAMES)
    still = np.repeat(renderer.scene.poses[None], _FRAMES, axis=0)
    one, every = still.copy(), still.copy()
    one[:, 5, 2, 3] += np.linspace(0.0, 0.1, _FRAMES)
    every[:, 1:, 0, 3] += np.linspace(0.0, 0.1, _FRAMES)[:, None]
    rows = []
    for moving, poses in (("none", None), ("one", one), ("all", every)):
        seconds = median_seconds(lambda poses=poses: renderer.render(cameras, poses, workers=2)) / _FRAMES
        rows.append(
            {"scene": what, "moving": moving, "ms a frame": round(1e3 * seconds, 2), "frames/s": round(1 / seconds)}
        )
    return rows


def _dense(bodies: list[Body], sensor: Sensor) -> str:
    """Compare n × n rays a pixel of Embree with the exact frame: errors and times, one thread."""
    camera = _at((-0.3, 0.0, 0.5))
    exact = SceneRenderer(Scene(bodies), sensor).phasors(camera).phasor[0]
    surface: Any = trimesh.util.concatenate([_placed(body) for body in bodies])
    albedo = np.concatenate([np.broadcast_to(body.albedo, len(body.mesh.faces)) for body in bodies])
    plane_m = np.einsum("ij,ij->i", surface.face_normals, surface.triangles[:, 0])
    caster = make_intersector(surface.vertices, surface.faces)
    tangent, found = math.tan(math.radians(sensor.half_angle_h_deg)), []
    for n in _DENSE:
        at = (np.arange(sensor.cols * n) + 0.5) / n
        y, z = np.meshgrid(tangent * (1 - 2 * at / sensor.cols), tangent * (1 - 2 * at / sensor.rows))
        rays = np.stack([np.ones_like(y), y, z], axis=-1).reshape(-1, 3)
        begun = time.perf_counter()
        face = caster.first_face(np.tile(camera[:3, 3], (len(rays), 1)).astype(np.float32), rays.astype(np.float32))
        met = np.maximum(face, 0)
        facing = np.einsum("ij,ij->i", surface.face_normals[met], rays)
        along = (plane_m[met] - surface.face_normals[met] @ camera[:3, 3]) / facing
        length = np.linalg.norm(rays, axis=1)
        amplitude = np.where(face < 0, 0, albedo[met] * np.abs(facing) / length / (along * length) ** 2)
        light = amplitude * np.exp(1j * along * length / sensor.metres_per_radian)
        phasor = light.reshape(sensor.rows, n, sensor.cols, n).mean(axis=(1, 3))
        seconds = time.perf_counter() - begun
        error = np.sqrt((np.abs(phasor - exact) ** 2).mean()) / np.abs(exact).max()
        found.append(f"{sensor.cols * n}² rays: r.m.s. {error:.1e} of the brightest, {1e3 * seconds:.0f} ms")
    return "; ".join(found)
