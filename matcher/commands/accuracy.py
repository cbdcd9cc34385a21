"""The command ``phasemark accuracy``: what a landmark before a camera gives, in one line."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
from typing import Annotated

from phasemark.data.commands.command import Shown
from phasemark.data.commands.console import echo, echo_json, tell
from phasemark.data.commands.inputs import (
    ClassOrMesh,
    background_of,
    class_renderers,
    note_too_far,
    of_any_albedo,
    read_sensor,
)
from phasemark.data.commands.options import BouncesOfLight, Count, Degrees, Floor, Json, Metres, SensorName, Wall


def accuracy_line(
    *,
    distance: Metres,
    delta: Degrees | None = None,
    landmark: ClassOrMesh,
    sensor: SensorName = "pmd-16x16",
    wall: Wall = None,
    floor: Floor = None,
    bounces: BouncesOfLight = "0",
    n_frames: Annotated[Count, Shown("--frames")] = 50,
    as_json: Json = False,
) -> None:
    """Print in one line how accurate a measurement can be, from the Cramér–Rao bound.

    1 σ of distance, angle and position with the bearing free, what limits it, and how often another class of the
    catalogue explains a frame better.

    Parameters
    ----------
    distance
        Distance D to the landmark's axis.
    delta
        Side δ from which the landmark is seen; all sides unless stated.
    n_frames
        Frames averaged for one measurement.
    """
    from phasemark.landmarks import catalog
    from phasemark.matcher.accuracy.expected_accuracy import accuracy_card, sides_of
    from phasemark.render import Renderer, Views
    from phasemark.render.view import delta_period_rad

    landmark.check("judge")
    name, mesh = landmark.read()
    camera = read_sensor(sensor)
    note_too_far(camera, {"--distance": distance, "--wall": wall})
    if camera.histogram is not None:
        tell("note: of ranges that are means over their zones; peaks of a histogram tell less of δ and bearing")
    renderer = Renderer(mesh, camera, albedo=mesh.metadata.get("albedo", 0.8))
    views = Views.broadcast(distance, math.radians(delta or 0.0))
    renderer.check_in_view(views)
    if delta is None:  # a mesh is seen from all around
        symmetry = 1 if landmark.class_name is None else catalog()[landmark.class_name].symmetry
        views = sides_of(distance, delta_period_rad(symmetry))
    others = {other: one for other, one in class_renderers(camera).items() if other != landmark.class_name}
    background = of_any_albedo(background_of(wall, floor, bounces))
    card = accuracy_card(renderer, views, others=others, n_frames=n_frames, background=background)
    if as_json:
        return echo_json({"landmark": name, "sensor": sensor, "wall_m": wall, "floor_m": floor, **card.as_dict()})
    echo(f"{name} {card.line()}")
