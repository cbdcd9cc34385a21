"""Generators of scenes: a dock with clutter, people under a ceiling, postures of a hand; build a set of one.

``python examples/scene_generators.py people --scenes 100 --out people.h5``

or, from this folder, with a plan of your own: ``phasemark frames build plan.toml --generator scene_generators:people``.
A generator is called with the number of a scene and that scene's random numbers. What it draws from them alone may
differ from scene to scene, so that every scene can be made again from its number.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark import PhasemarkError, UsageError
from phasemark.data import build_frames
from phasemark.data.plans import GeneratedScene, SceneFramesPlan
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Body, Scene

Pose = NDArray[np.float64]


def placed(x_m: float, y_m: float, z_m: float, yaw_rad: float = 0.0) -> Pose:
    """Return a pose that is turned about the vertical."""
    pose = np.eye(4)
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    pose[:3, 3] = x_m, y_m, z_m
    return pose


# --- a dock with clutter: distance and side of a landmark ------------------------------------------------------------

DOCK = Body(build_mesh(catalog()["cone"]), albedo=0.8, name="dock")
CLUTTER = (
    Body.box((0.12, 0.2, 0.3), albedo=0.4, name="clutter 1"),
    Body.sphere(0.08, albedo=0.6, name="clutter 2"),
    Body.cylinder(0.06, 0.4, albedo=0.3, name="clutter 3"),
)


def dock(index: int, rng: np.random.Generator, steps: int = 1, speed_m: float = 0.02) -> GeneratedScene:
    """Return a dock that the camera drives at among clutter, before a wall; in every tenth scene there is none.

    Labels are D, δ and bearing of each step (PHYSICS section 1), NaN without a dock.
    """
    there = rng.random() >= 0.1
    distance_m = rng.uniform(0.9, 1.6) - speed_m * np.arange(steps)
    delta_rad, bearing_rad = rng.uniform(0, 2 * math.pi), math.radians(rng.normal(0, 2))
    heading = delta_rad - bearing_rad
    lens = [(-d * math.cos(delta_rad), -d * math.sin(delta_rad)) for d in distance_m]
    cameras = np.array([placed(x, y, 0.0, heading) for x, y in lens])
    chosen = [body for body in CLUTTER if rng.random() < 0.5]
    aside = rng.choice([-1.0, 1.0], len(CLUTTER)) * rng.uniform(0.3, 0.5, len(CLUTTER))
    behind = 0.35 * np.arange(len(CLUTTER)) + rng.uniform(-0.1, 0.1, len(CLUTTER))
    # clutter stands beside the way and behind, each piece in a row of its own
    poses = {body.name: placed(0, 0, 0, delta_rad) @ placed(behind[k], aside[k], 0) for k, body in enumerate(CLUTTER)}
    bodies = [*([DOCK] if there else []), *chosen]
    return GeneratedScene(
        Scene(bodies) if bodies else None,
        cameras,
        {
            "distance_m": distance_m if there else math.nan,
            "delta_rad": delta_rad if there else math.nan,
            "bearing_rad": bearing_rad if there else math.nan,
            "there": float(there),
        },
        {body.name: poses.get(body.name, np.eye(4)) for body in bodies},
        Background(wall_m=3.0),
    )


# --- people under a ceiling sensor: how many -------------------------------------------------------------------------

CEILING_M = 2.7
FLOOR = Body.box((8.0, 8.0, 0.1), albedo=0.35, name="floor")
PERSON = trimesh.creation.capsule(height=1.2, radius=0.22, count=[16, 8])  # upright, 1.64 m tall
DOWN = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, CEILING_M], [0.0, 0.0, 0.0, 1.0]])
"""Pose of a camera under the ceiling that looks down."""


@lru_cache
def crowd(n: int) -> Scene:
    """Return the floor and n people; the same bodies whenever it is asked, so that they are analysed once."""
    return Scene([FLOOR, *(Body(PERSON, albedo=0.6, name=f"person {k}") for k in range(1, n + 1))])


def people(index: int, rng: np.random.Generator, most: int = 4, steps: int = 1, step_m: float = 0.1) -> GeneratedScene:
    """Return people who walk under the sensor, each in a lane of its own; the label is their number."""
    n = int(rng.integers(0, most + 1))
    lanes = rng.permutation(most)[:n]
    y = (lanes - 0.5 * (most - 1)) * 0.5
    way = step_m * np.arange(steps)[:, None] * rng.choice([-1.0, 1.0], n)
    x = rng.uniform(-0.6, 0.6, n) + way - way.mean(axis=0)
    floor = np.broadcast_to(placed(0, 0, -0.05), (steps, 1, 4, 4))
    walkers = np.array([[placed(x[k, i], y[i], 0.83) for i in range(n)] for k in range(steps)]).reshape(steps, n, 4, 4)
    return GeneratedScene(crowd(n), DOWN, {"count": n}, np.concatenate([floor, walkers], axis=1))


# --- a hand: which posture -------------------------------------------------------------------------------------------

POSTURES = {"open": (0, 0, 0, 0, 0), "fist": (1, 1, 1, 1, 1), "point": (1, 0, 1, 1, 1), "two": (1, 0, 0, 1, 1)}
"""Which fingers are bent, thumb first."""
THUMB_M, FINGER_M = (0.038, 0.028), (0.045, 0.028, 0.022)
"""Lengths of the bones."""
RADII_M = (0.0095, 0.0088, 0.0081)


def bones() -> list[trimesh.Trimesh]:
    """Return a capsule for each bone, thumb first, from its joint at the origin along z."""
    made = []
    for lengths in (THUMB_M, *[FINGER_M] * 4):
        for length, radius in zip(lengths, RADII_M, strict=False):
            made.append(trimesh.creation.capsule(height=length, radius=radius, count=[16, 8]))
            made[-1].apply_translation((0, 0, 0.5 * length))
    return made


PALM = trimesh.creation.box((0.03, 0.085, 0.09))
HAND = Scene([Body(mesh, albedo=0.6, name=f"hand {k}") for k, mesh in enumerate([PALM, *bones()])])


def hand(index: int, rng: np.random.Generator) -> GeneratedScene:
    """Return a hand that turns its palm to the sensor at 15 to 35 cm; in every tenth scene there is none."""
    posture = str(rng.choice(list(POSTURES)))
    wrist = before_sensor(rng)
    poses = [wrist]
    for finger, bent in enumerate(POSTURES[posture]):
        thumb = finger == 0
        joint = (0.0, 0.045, -0.02) if thumb else (0.0, 0.03 - 0.02 * (finger - 1), 0.045)
        spread = -0.9 if thumb else 0.06 * (finger - 2.5)
        turn = (1.2 if bent else 0.1) + rng.normal(0, 0.08)
        bone = wrist @ placed(*joint) @ turned("x", spread + rng.normal(0, 0.02))
        for length in THUMB_M if thumb else FINGER_M:
            bone = bone @ turned("y", -turn)
            poses.append(bone)
            bone = bone @ placed(0, 0, length)
    if rng.random() < 0.1:
        return GeneratedScene(None, np.eye(4), {"posture": "none"}, background=Background(wall_m=1.5))
    return GeneratedScene(HAND, np.eye(4), {"posture": posture}, np.array(poses), Background(wall_m=1.5))


def before_sensor(rng: np.random.Generator) -> Pose:
    """Return where a hand is that turns its palm to the sensor: x away from it, z to the tips of the fingers."""
    pose = placed(rng.uniform(0.15, 0.35), *rng.uniform(-0.02, 0.02, 2))
    return pose @ np.asarray(trimesh.transformations.euler_matrix(*rng.normal(0, math.radians(12), 3)))


def turned(axis: str, angle_rad: float) -> Pose:
    """Return a rotation about an axis."""
    way = {"x": (1, 0, 0), "y": (0, 1, 0)}[axis]
    return np.asarray(trimesh.transformations.rotation_matrix(angle_rad, way))


# --- the same with meshes: the Shadow hand of gymnasium-robotics -----------------------------------------------------

SHADOW_FINGERS = ("TH", "FF", "MF", "RF", "LF")
SHADOW_FINGER = {"J2": (0.1, 1.3), "J1": (0.1, 1.3), "J0": (0.1, 1.0)}
SHADOW_THUMB = {"J4": (0.0, 1.0), "J3": (0.0, 0.9), "J1": (0.0, -0.4), "J0": (-0.1, -1.0)}
"""Angles of joints of a straight and of a bent finger, radians."""
SHADOW_CENTRE = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.05], [0.0, 0.0, 0.0, 1.0]])
"""Middle of the palm in the model's palm: x out of the back of the hand, y to the thumb's other side, z to the tips."""


@lru_cache
def shadow() -> tuple[Any, Any, Scene]:
    """Return the model without its forearm, as MuJoCo has it and as a scene; it is read once."""
    package = importlib.util.find_spec("gymnasium_robotics")
    if package is None or package.origin is None:
        raise UsageError("the Shadow hand needs the packages mujoco and gymnasium-robotics: pip install both")
    import mujoco

    from phasemark.render.scene.mujoco_scene import seen_model

    model = mujoco.MjModel.from_xml_path(str(Path(package.origin).parent / "envs" / "assets" / "hand" / "reach.xml"))
    seen = seen_model(model, 0.6, model.body("robot0:forearm").id, (1,), smooth=True)
    return model, seen, Scene([body.named(f"hand {k}") for k, body in enumerate(seen.bodies)])


def shadow_hand(index: int, rng: np.random.Generator) -> GeneratedScene:
    """Return a robot's hand before the sensor as `hand` does; the camera moves, and the palm stays where it is."""
    model, seen, scene = shadow()
    import mujoco

    posture = str(rng.choice(list(POSTURES)))
    data = mujoco.MjData(model)
    for finger, bent in zip(SHADOW_FINGERS, POSTURES[posture], strict=True):
        for name, angles in (SHADOW_THUMB if finger == "TH" else SHADOW_FINGER).items():
            joint = f"robot0:{finger}{name}"
            angle = angles[bent] + rng.normal(0, 0.08)
            data.joint(joint).qpos[0] = np.clip(angle, *model.joint(joint).range)
    mujoco.mj_kinematics(model, data)
    palm = np.eye(4)
    palm[:3, :3], palm[:3, 3] = data.body("robot0:palm").xmat.reshape(3, 3), data.body("robot0:palm").xpos
    camera = palm @ SHADOW_CENTRE @ np.linalg.inv(before_sensor(rng))
    if rng.random() < 0.1:
        return GeneratedScene(None, camera, {"posture": "none"}, background=Background(wall_m=1.5))
    poses = seen.poses(data, camera[:3, 3])
    return GeneratedScene(scene, camera, {"posture": posture}, poses, Background(wall_m=1.5))


PLANS: dict[str, dict[str, Any]] = {
    "dock": {"sensor": "pmd-16x16", "scenes": {"classes": ["dock", "clutter"], "bodies": 4}},
    "people": {
        "sensor": "vl53l8cx-8x8", "keep": ["targets", "shares", "poses"], "variants": [],
        "scenes": {"classes": ["floor", "person"], "bodies": 5},
    },
    "hand": {"sensor": "vl53l8cx-8x8", "scenes": {"classes": ["hand"], "bodies": 15}},
    "shadow_hand": {"sensor": "vl53l8cx-8x8", "scenes": {"classes": ["hand"], "bodies": 24}},
}  # fmt: skip
"""Plans of all, without the number of scenes."""


def main() -> int:
    """Build a set, and print what it holds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("generator", choices=PLANS)
    parser.add_argument("--scenes", type=int, default=20, help="number of scenes (%(default)s)")
    parser.add_argument("--seed", type=int, default=7, help="root of all random numbers (%(default)s)")
    parser.add_argument("--workers", type=int, default=None, help="threads (as many as there are processors)")
    parser.add_argument("--out", type=Path, default=Path("scenes.h5"), help="the frame set (%(default)s)")
    arguments = parser.parse_args()
    sys.path.append(str(Path(__file__).parent))  # where the build finds the generator by its name
    about = PLANS[arguments.generator]
    scenes = {"generator": f"scene_generators:{arguments.generator}", "n": arguments.scenes, **about["scenes"]}
    try:
        plan = SceneFramesPlan(**{**about, "scenes": scenes, "seed": arguments.seed})
        with build_frames(plan, arguments.out, force=True, workers=arguments.workers) as frames:
            print(frames)
            for name in (name for name in frames.truth if name.startswith("label_")):
                values, counts = np.unique(frames.truth[name], return_counts=True)
                if len(values) <= 10:
                    print(f"{name}: " + ", ".join(f"{value} × {n}" for value, n in zip(values, counts, strict=True)))
    except (PhasemarkError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code if isinstance(error, PhasemarkError) else UsageError.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
