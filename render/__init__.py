"""How the camera sees the landmark: from a mesh and a sensor to phasor images, and from those to noisy frames."""

from phasemark.render.background import Background
from phasemark.render.frames import Flag, Frames
from phasemark.render.phasor import PhasorImages, phasor_to_range_m
from phasemark.render.renderer import Renderer
from phasemark.render.sensor import Sensor, preset, preset_names
from phasemark.render.view import Views

__all__ = [
    "Background",
    "Flag",
    "Frames",
    "PhasorImages",
    "Renderer",
    "Sensor",
    "Views",
    "phasor_to_range_m",
    "preset",
    "preset_names",
]
