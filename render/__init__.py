"""How the camera sees the landmark: from a mesh and a sensor to phasor images, and from those to noisy frames."""

from typing import TYPE_CHECKING

from phasemark.render import compile_cache  # noqa: F401 - first, for the modules below compile functions
from phasemark.render.background import Background
from phasemark.render.bench.data_sheet.characterise import characterise
from phasemark.render.bench.data_sheet.results import Characterisation, Comparison, SheetQuantity
from phasemark.render.bench.fit.fit_sensor import fit_sensor
from phasemark.render.bench.fit.fitted_sensor import FittedField, SensorFit
from phasemark.render.exposure.ablation import Ablation, ablate
from phasemark.render.exposure.capture import capture, capture_moving
from phasemark.render.exposure.motion import Motion, render_moving
from phasemark.render.frames import Flag, Frames
from phasemark.render.phasor_images import PhasorImages, phasor_to_range_m, wrap_difference_m, wrap_range_m
from phasemark.render.planar import PlanarLandmark, planar_images
from phasemark.render.renderer import Renderer, background_image
from phasemark.render.sensor.camera_unit import CameraUnit, camera_unit
from phasemark.render.sensor.correlation import Harmonic, pulse_harmonics, square_harmonics
from phasemark.render.sensor.range_noise import measured_range_std, predicted_range_std
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.shipped_sensors import preset, preset_names
from phasemark.render.view import Views, delta_period_rad, wrap_delta_difference_rad, wrap_delta_rad

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from phasemark.render.figures import PAPER_CMAP, range_figure, terminal_figure

__all__ = [
    "PAPER_CMAP",
    "Ablation",
    "Background",
    "CameraUnit",
    "Characterisation",
    "Comparison",
    "FittedField",
    "Flag",
    "Frames",
    "Harmonic",
    "Motion",
    "PhasorImages",
    "PlanarLandmark",
    "Renderer",
    "Sensor",
    "SensorFit",
    "SheetQuantity",
    "Views",
    "ablate",
    "background_image",
    "camera_unit",
    "capture",
    "capture_moving",
    "characterise",
    "delta_period_rad",
    "fit_sensor",
    "measured_range_std",
    "phasor_to_range_m",
    "planar_images",
    "predicted_range_std",
    "preset",
    "preset_names",
    "pulse_harmonics",
    "range_figure",
    "render_moving",
    "square_harmonics",
    "terminal_figure",
    "wrap_delta_difference_rad",
    "wrap_delta_rad",
    "wrap_difference_m",
    "wrap_range_m",
]

_FIGURES = ("PAPER_CMAP", "range_figure", "terminal_figure")


def _figure_of_frame(frames: Frames, index: int, frame: int) -> "Figure":
    """Draw range, amplitude and flags of one frame."""
    from phasemark.render.figures import frame_figure

    return frame_figure(frames, index, frame)


def _figure_of_image(images: PhasorImages, index: int) -> "Figure":
    """Draw range, amplitude and coverage of one view."""
    from phasemark.render.figures import phasor_figure

    return phasor_figure(images, index)


Frames.figure = staticmethod(_figure_of_frame)
PhasorImages.figure = staticmethod(_figure_of_image)


def __getattr__(name: str) -> object:
    """Import pictures when they are asked for: matplotlib takes half a second to load."""
    if name in _FIGURES:
        from phasemark.render import figures

        return getattr(figures, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
