"""Sensors: parameters, presets, files, correlation and range noise."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.render.sensor.camera_unit import CameraUnit
    from phasemark.render.sensor.correlation import Harmonic, pulse_harmonics, square_harmonics
    from phasemark.render.sensor.histogram_fields import Histogram
    from phasemark.render.sensor.lens_fields import Lens
    from phasemark.render.sensor.range_noise import measured_range_std, predicted_range_std
    from phasemark.render.sensor.sensor import Sensor
    from phasemark.render.sensor.shipped_sensors import preset, preset_names
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "CameraUnit",
    "Harmonic",
    "Histogram",
    "Lens",
    "Sensor",
    "measured_range_std",
    "predicted_range_std",
    "preset",
    "preset_names",
    "pulse_harmonics",
    "square_harmonics",
]
