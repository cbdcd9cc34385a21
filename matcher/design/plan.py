"""Plan of a design: camera, working range, limits and effort, as a TOML file or in code."""

from __future__ import annotations

import math
import os
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from phasemark import UsageError
from phasemark.data import BankPlan
from phasemark.data.plans.bank_plan import PlanModel, factored_refusal, read_plan, sensor_in_folder
from phasemark.render import Sensor

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_AtLeastZero = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class LimitsPlan(PlanModel):
    """Limits that every landmark has to keep.

    Parameters
    ----------
    extents_m : (x, y, z)
        Largest extents of the whole landmark, metres.
    fit : {"axis", "whole"}
        Where a landmark has to fit the field of view at the near end. ``axis``: in the plane of its axis (PHYSICS
        section 5). ``whole``: at every point, nearest corners included.
    least_lower_px : int
        Least number of pixels on the box, at the far end, that one frame measures to 0.1 rad.
    least_upper_px : int
        Least number of pixels on the part above the box, at the far end, that one frame measures to 0.1 rad.
    least_box_edge_px : float
        Least width of the box's narrowest side, in pixels at the far end.
    least_upper_edge_px : float
        Least width and height of the part above the box, in pixels at the far end.
    most_phase_std_rad : float
        Largest phase noise of one frame at the far end on a surface that slants by 60°, radians.
    least_class_distance : float
        Least noncentrality d between two classes over the working range.
    least_turn_distance : float
        Least noncentrality d between a box that is not square and the same box a quarter-turn on.
    """

    extents_m: tuple[_Positive, _Positive, _Positive] = (0.30, 0.30, 0.30)
    fit: Literal["axis", "whole"] = "axis"
    least_lower_px: Annotated[int, Field(ge=1)] = 9
    least_upper_px: Annotated[int, Field(ge=1)] = 4
    least_box_edge_px: _Positive = 2.0
    least_upper_edge_px: _Positive = 1.0
    most_phase_std_rad: _Positive = 0.1
    least_class_distance: _AtLeastZero = 6.0
    least_turn_distance: _AtLeastZero = 6.0


class SamplingPlan(PlanModel):
    """Views at which bounds are computed.

    Parameters
    ----------
    distances : int
        Number of distances, evenly over the working range, both ends included.
    delta_step_deg : float
        Step in δ, degrees, over half of the box's period: the other half is its mirror image.
    """

    distances: Annotated[int, Field(ge=2, le=200)] = 7
    delta_step_deg: Annotated[float, Field(gt=0, le=15)] = 2.0


class SearchPlan(PlanModel):
    """Effort of the search.

    Parameters
    ----------
    boxes : int
        Number of boxes that are tried before the best are refined.
    uppers : int
        Number of parts above the box that are tried before the best are refined.
    step_mm : float
        Millimetres: all dimensions are multiples of this.
    """

    boxes: Annotated[int, Field(ge=8, le=10_000)] = 128
    uppers: Annotated[int, Field(ge=8, le=2_000)] = 160
    step_mm: Annotated[float, Field(gt=0, le=50)] = 1.0


class DesignPlan(PlanModel):
    """A set of landmarks to be designed (section 4.1 of the paper).

    Parameters
    ----------
    sensor : str
        A preset's name, or a sensor file (with a ``/`` or ending in ``.toml``).
    sensor_overrides : mapping
        Fields of the sensor that replace those of `sensor`.
    distance_m : (near, far)
        Ends of the working range, metres.
    n_classes : int
        Number of landmarks of the set, each a class of its own.
    n_frames : int
        Number of frames that are averaged for one measurement.
    albedo : float
        Share of light that the landmarks return.
    symmetry : {"any", 2, 4}
        From how many sides the box may look the same; 4 is a square box.
    seed : int
        Root of all random numbers.
    limits : LimitsPlan
        Limits that every landmark has to keep.
    sampling : SamplingPlan
        Views at which bounds are computed.
    search : SearchPlan
        Effort of the search.

    Raises
    ------
    UsageError
        With one line that names the key, its value and what would be right.

    Examples
    --------
    >>> DesignPlan(n_classes=2).distance_m
    (0.8, 2.0)
    """

    sensor: str = "pmd-16x16"
    sensor_overrides: dict[str, Any] = Field(default_factory=dict)
    distance_m: tuple[_Positive, _Positive] = (0.8, 2.0)
    n_classes: Annotated[int, Field(ge=1, le=12)] = 4
    n_frames: Annotated[int, Field(ge=1, le=10_000)] = 50
    albedo: Annotated[float, Field(gt=0, le=1)] = 0.8
    symmetry: Literal["any", 2, 4] = "any"
    seed: Annotated[int, Field(ge=0, lt=2**64)] = 2005
    limits: LimitsPlan = LimitsPlan()
    sampling: SamplingPlan = SamplingPlan()
    search: SearchPlan = SearchPlan()

    @model_validator(mode="after")
    def _lengths_are_plausible(self) -> Self:
        near, far = self.distance_m
        if near >= far:
            raise UsageError(f"'distance_m' must be (near, far), got {self.distance_m}")
        if max(self.limits.extents_m) > far:
            shown = " × ".join(f"{value:g}" for value in self.limits.extents_m)
            as_mm = " × ".join(f"{value / 1000:g}" for value in self.limits.extents_m)
            raise UsageError(
                f"'limits.extents_m' must not exceed the far end of 'distance_m', {far:g} m, got {shown} m;"
                f" if that was in millimetres, write {as_mm}"
            )
        if self.search.step_mm > 50 * min(self.limits.extents_m):
            raise UsageError(
                f"'search.step_mm' must be at most a twentieth of the least extent,"
                f" {50 * min(self.limits.extents_m):g} mm, got {self.search.step_mm:g}"
            )
        return self

    def in_folder(self, folder: Path) -> Self:
        """Return the plan of a file in a folder: the name of a sensor file is relative to it."""
        return self.model_copy(update={"sensor": sensor_in_folder(self.sensor, folder)})

    def build_sensor(self) -> Sensor:
        """Return the sensor, overrides applied.

        Raises
        ------
        UsageError
            The sensor is unknown, a field is wrong, or its image does not split into lower and upper pixels.
        InputFileError
            The sensor file cannot be read.
        """
        bank = BankPlan(classes=("cylinder",), sensor=self.sensor, sensor_overrides=self.sensor_overrides).resolve()
        sensor = bank.build_sensor()
        if sensor.kind == "direct":
            raise UsageError(f"'sensor' must measure phases, got '{self.sensor}', a direct time-of-flight device")
        reason = factored_refusal(bank)
        if reason is not None:
            raise UsageError(f"'sensor' must show the box on its lower and the upper part on its upper rows: {reason}")
        return sensor

    @property
    def sampled_distance_m(self) -> NDArray[np.float64]:
        """Distances at which bounds are taken."""
        return np.linspace(*self.distance_m, self.sampling.distances)

    def sampled_delta_rad(self, symmetry: int) -> NDArray[np.float64]:
        """Return the sides at which bounds are computed, half a period of a box."""
        half = math.pi / symmetry
        return np.linspace(0.0, half, math.ceil(math.degrees(half) / self.sampling.delta_step_deg - 1e-9) + 1)


def read_design_plan(path: str | os.PathLike[str]) -> DesignPlan:
    """Read the plan of a design from a TOML file; a sensor file it names is relative to its folder.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    DesignPlan

    Raises
    ------
    InputFileError
        The file cannot be read or is not TOML.
    UsageError
        With one line that names the file, the key, the value and what would be right.
    """
    return read_plan(path, DesignPlan)


def example_design() -> str:
    """Return the text of the shipped plan."""
    return (files("phasemark.matcher.design") / "plan.toml").read_text(encoding="utf-8")


def default_design() -> DesignPlan:
    """Return the shipped plan."""
    return DesignPlan(**tomllib.loads(example_design()))
