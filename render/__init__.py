"""Rendering: from a mesh and a sensor to phasor images, and from those to noisy frames."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use
from phasemark.render import compile_cache  # noqa: F401 - first, for the modules below compile functions
from phasemark.render.background import Background
from phasemark.render.frames import Flag, Frames
from phasemark.render.phasor_images import PhasorImages, phasor_to_range_m
from phasemark.render.renderer import Renderer, background_image
from phasemark.render.sensor.range_noise import measured_range_std, predicted_range_std
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.shipped_sensors import preset, preset_names
from phasemark.render.unwrapping import unwrap_ranges, unwrapping_error_probability
from phasemark.render.view import Views

if TYPE_CHECKING:
    import matplotlib.figure
    import numpy as np
    import numpy.typing

    from phasemark.render.bench.data_sheet.characterise import characterise
    from phasemark.render.direct.capture import capture
    from phasemark.render.scene.body import Body
    from phasemark.render.scene.depth_zones import zones_from_depth
    from phasemark.render.scene.scene import Scene
    from phasemark.render.scene.scene_renderer import SceneRenderer
    from phasemark.render.sensor.camera_unit import camera_unit
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)  # what takes time to import, and few need


__all__ = [
    "Background",
    "Body",
    "Flag",
    "Frames",
    "PhasorImages",
    "Renderer",
    "Scene",
    "SceneRenderer",
    "Sensor",
    "Views",
    "background_image",
    "camera_unit",
    "capture",
    "characterise",
    "measured_range_std",
    "phasor_to_range_m",
    "predicted_range_std",
    "preset",
    "preset_names",
    "unwrap_ranges",
    "unwrapping_error_probability",
    "zones_from_depth",
]


def _figure_of_frame(
    frames: Frames, index: int, frame: int, coverage: "numpy.typing.NDArray[np.float64] | None"
) -> "matplotlib.figure.Figure":
    """Draw range, amplitude and flags of one frame."""
    from phasemark.render.figures import frame_figure

    return frame_figure(frames, index, frame, coverage=coverage)


def _figure_of_image(images: PhasorImages, index: int) -> "matplotlib.figure.Figure":
    """Draw range, amplitude and coverage of one view."""
    from phasemark.render.figures import phasor_figure

    return phasor_figure(images, index)


Frames.figure = staticmethod(_figure_of_frame)
PhasorImages.figure = staticmethod(_figure_of_image)
