"""Result of a sensor fit: every field of the camera with its standard error and its origin."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from phasemark.render.integral.rounding import error_text
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.sensor_file import sensor_toml

AmplitudeUnit = Literal["electrons", "arbitrary"]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class FittedField:
    """One field of a fitted sensor.

    Parameters
    ----------
    value : float
        Fitted value.
    std_error : float or None
        None where the number was not measured.
    note : str
        From what it was measured, or that it is assumed, and why.
    """

    value: float
    std_error: float | None
    note: str

    @property
    def comment(self) -> str:
        """The note with its standard error, as it stands in a sensor file."""
        if self.std_error is None:
            return f"assumed: {self.note}"
        error = f", ± {error_text(self.std_error)} (standard error)" if self.std_error > 0 else ""
        return f"measured{error}: {self.note}"


@dataclass
class Findings:
    """Numbers found so far: fields of the sensor, their estimates, and notes."""

    fields: dict[str, Any] = field(default_factory=dict)
    estimates: dict[str, FittedField] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, name: str, value: float, std_error: float | None, note: str) -> None:
        """Add a measured field; one without standard error is assumed and stays as it is."""
        self.estimates[name] = FittedField(float(value), None if std_error is None else float(std_error), note)
        if std_error is not None:
            self.fields[name] = float(value)


@dataclass(frozen=True, eq=False)
class SensorFit:
    """Camera fitted to measured flat fields.

    Parameters
    ----------
    sensor : Sensor
        The fitted camera.
    estimates : dict of str to FittedField
        By the name of the sensor's field, in the order of its fields.
    notes : tuple of str
        Sentences on numbers that could not be distinguished, and on odd findings.
    pixel_offset_m : (rows, cols) float64
        Range offset of each pixel beside the global one; NaN for pixels left out.
    pixel_offset_std_error_m : (rows, cols) float64
        Its standard error, from noise in time and from the boards' distances.
    range_std_m : (distances, rows, cols) float64
        Measured σ of one frame.
    frame_correlation, frame_correlation_std_error : float
        Correlation of a pixel's noise from one frame to the next.
    n_frames : tuple of int
        Frames at each distance.
    distance_std_m : tuple of float
        Standard deviation that each distance was taken to have; it is in all standard errors.
    """

    sensor: Sensor
    estimates: dict[str, FittedField]
    notes: tuple[str, ...]
    pixel_offset_m: Floats
    pixel_offset_std_error_m: Floats
    range_std_m: Floats
    frame_correlation: float
    frame_correlation_std_error: float
    n_frames: tuple[int, ...]
    distance_std_m: tuple[float, ...]

    def to_toml(self, *, base_name: str) -> str:
        """Return the sensor as a file, each number with what it was measured from, or that it is assumed.

        Parameters
        ----------
        base_name : str
            What the camera is called that gave all that was not measured.
        """
        comments = {name: estimate.comment for name, estimate in self.estimates.items()}
        if "harmonics" in comments:
            comments["modulation"] = "the harmonics were measured"
        header = ("Fitted to measured flat-field frames by phasemark sensor fit.", *self.notes)
        return sensor_toml(self.sensor, comments, header=header, otherwise=f"assumed: as in {base_name}")

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, lists and strings, for JSON; None where there is no number."""
        return {
            "sensor": self.sensor.model_dump(mode="json"),
            "estimates": {name: asdict(one) for name, one in self.estimates.items()},
            "notes": list(self.notes),
            "n_frames": list(self.n_frames),
            "distance_std_m": list(self.distance_std_m),
            "frame_correlation": self.frame_correlation,
            "frame_correlation_std_error": self.frame_correlation_std_error,
            "pixel_offset_m": [
                [float(value) if math.isfinite(value) else None for value in row] for row in self.pixel_offset_m
            ],
        }
