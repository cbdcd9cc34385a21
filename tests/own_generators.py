"""Generators of scenes as users write them, some of them bad, for the tests of frame sets."""

import math
import os
import signal

import numpy as np

from phasemark.data.plans import GeneratedScene
from phasemark.render import Background, Body, Scene

NOT_CALLABLE = 1
WALL = Body.box((0.1, 6.0, 6.0), name="wall")
BALL = Body.sphere(0.1, name="ball 1")
OTHER_BALL = BALL.named("ball 2")


def at(x, y=0.0, z=0.0):
    """A pose without a turn."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def room(index, rng, nearest=1.0):
    """A wall with a ball or two before it, or nothing; its front and the number of balls are the labels."""
    n = index % 3
    if index % 4 == 3:
        return GeneratedScene(None, np.eye(4), {"front_m": math.nan, "what": "nothing"})
    front = rng.uniform(nearest, 1.5)
    bodies = [WALL, BALL, OTHER_BALL][: 1 + n]
    poses = [at(front + 0.05), at(0.7, 0.05), at(0.6, -0.05)][: 1 + n]
    return GeneratedScene(Scene(bodies), np.eye(4), {"front_m": front, "what": f"{n} bälle"}, np.array(poses))


def drive(index, rng):
    """Three steps towards a wall that stands at 2 m, with a ball that rolls across."""
    way = 0.1 * np.arange(3)
    balls = [at(1.0, y) for y in rng.uniform(-0.1, 0.1) + way]
    cameras = np.array([at(x) for x in way])
    return GeneratedScene(
        Scene([WALL, BALL]), cameras, {"way_m": way, "towards": "wall"}, {"wall": at(2.05), "ball 1": balls}
    )


def background_alone(index, rng):
    return GeneratedScene(None, at(0, 0, 0.5), {}, background=Background(wall_m=1.25))


def one_wall(index, rng, **labels):
    return GeneratedScene(Scene([WALL]), np.eye(4), labels, at(1.0)[None])


def raises_at_3(index, rng):
    if index == 3:
        raise ZeroDivisionError("no luck")
    return one_wall(index, rng)


def returns_a_scene(index, rng):
    return Scene([WALL])


def returns_none(index, rng):
    return None


def nan_pose(index, rng):
    return GeneratedScene(Scene([WALL]), np.full((4, 4), np.nan))


def nan_body(index, rng):
    return GeneratedScene(Scene([WALL]), np.eye(4), {}, np.full((1, 4, 4), np.nan))


def other_labels_at_2(index, rng):
    return one_wall(index, rng, **({"count": 1} if index < 2 else {"number": 1}))


def text_at_2(index, rng):
    return one_wall(index, rng, count=1 if index < 2 else "two")


def a_lamp(index, rng):
    return GeneratedScene(Scene([WALL, BALL.named("lamp")]), np.eye(4), {}, np.array([at(1.0), at(0.7)]))


def two_steps(index, rng):
    return GeneratedScene(Scene([WALL]), np.array([np.eye(4), np.eye(4)]), {}, at(1.0)[None])


def inside_the_wall(index, rng):
    return GeneratedScene(Scene([WALL]), np.eye(4), {}, at(0.0)[None])


_CALLS = np.random.default_rng(0)


def draws_elsewhere(index, rng):
    return one_wall(index, rng, number=_CALLS.random())


BLOCK = Body.box((2.0, 6.0, 6.0), name="block")


def changes_a_mesh(index, rng):
    """The same mesh, another size each time: a bad habit, and noticed."""
    BLOCK.mesh.vertices = BLOCK.mesh.vertices * ((1.0 + 0.1 * index) / BLOCK.mesh.vertices[:, 0].max())
    return GeneratedScene(Scene([BLOCK]), np.eye(4), {}, at(3.0)[None])


def brighter(index, rng):
    """A wall of one mesh that sends back more from scene to scene."""
    wall = Body(WALL.mesh, 0.5, "wall", retroreflecting=float(index))
    return GeneratedScene(Scene([wall]), np.eye(4), {"index": index}, at(1.0)[None])


def no_labels(index, rng):
    return GeneratedScene(Scene([WALL]), np.eye(4), None, at(1.0)[None])


def half_a_letter(index, rng):
    return one_wall(index, rng, what="\ud800")


def too_large(index, rng):
    return one_wall(index, rng, count=10**400)


def text_of_two_lines(index, rng):
    return one_wall(index, rng, what="a b\n1,2,3 split=test")


def is_terminated(index, rng):
    os.kill(os.getpid(), signal.SIGTERM)
    return one_wall(index, rng)
