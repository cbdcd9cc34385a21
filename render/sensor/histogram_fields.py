"""Histogram fields of a direct sensor: bins, response, zones, pile-up and the on-chip estimator (PHYSICS 11)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field, model_validator

from phasemark import UsageError
from phasemark.inputs.field_table import FieldTable

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

_Number = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
_NonNegative = Annotated[float, Field(ge=0, le=1e12, allow_inf_nan=False)]
_Row = tuple[_Number, ...]

MOST_TARGETS = 4


class Histogram(FieldTable):
    """Histograms of a direct sensor's zones, and the estimator of its chip (PHYSICS section 11).

    The expected counts of bin j are cycles · [photons · h ∗ p + ambient + dark] + crosstalk, where h is the zone's
    transient and p the instrument response; pile-up then takes what the first photon of a cycle leaves. Tangents are
    those of rays (1, left, up) in the camera frame.

    Parameters
    ----------
    bins : int
        Bins of a histogram.
    bin_width_m : float
        Width of a bin as range, metres: half the time of flight times the speed of light.
    start_m : float
        Range of the lower edge of bin 0, metres; negative where the range zero lies inside the histogram.
    cycles : float
        Laser pulses of a frame times the detectors of a zone: how many first photons there can be.
    photons : float
        Signal photons per cycle in a zone of `zone_gain` 1 for intensity 1 (albedo 1 facing the camera at 1 m).
    ambient : float
        Photons of ambient light, per cycle and bin.
    dark : float
        Dark counts, per cycle and bin.
    irf_std_m : float, optional
        Standard deviation of a Gaussian instrument response, metres; the other choice is `irf`.
    irf : tuple of rows of float
        Samples of the instrument response, any unit: one row for all zones, or one row for each zone in image order.
    irf_start_m : float
        Delay of the first sample, metres.
    irf_step_m : float
        Distance of samples, metres.
    crosstalk : float
        Counts per frame that the cover glass returns to each zone.
    crosstalk_range_m : float
        Range of their peak.
    pile_up : bool
        Whether only the first photon of a cycle is counted.
    zone_scale : (width, height)
        Size of a zone over the pitch of the zones; above 1 zones overlap.
    zone_blur : float
        Softness of a zone's border: its profile falls as an error function, this is the 1/e half width as a tangent.
    light_width : float, optional
        Standard deviation of a Gaussian light distribution as a tangent; None: even light.
    light_centre : (left, up)
        Direction of the brightest light, tangents.
    stray : float
        Share of the mean light of all zones that every zone counts beside its own.
    zone_gain : tuple of rows of float
        Relative sensitivity of each zone, rows × cols; empty: 1.
    zone_bin_scale : tuple of rows of float
        Bin width of each zone over `bin_width_m`, rows × cols; empty: 1. Zones that share a time converter share it.
    zone_order : tuple of int
        Where each zone of a log stands in the image, row · cols + col counted from the top left. Empty: as logged.
    time_converters : tuple of int
        Time converter of each zone in the order of the log; zones of one converter share a bin width. Empty: one for
        all.
    reference_gain : float
        How far histograms shift, in bins, when the peak of the reference histogram shifts by one bin.
    reference_peak : float, optional
        Where the centroid of the reference histogram stood when the offsets were measured, bins.
    estimator : {"centroid", "parabola"}
        How the chip finds a peak between bins.
    estimator_bins : int
        Bins on either side of the highest bin that the centroid takes in.
    max_targets : int
        Targets that the chip reports for a zone, at most 4.
    threshold : float
        Least height of a peak above the ambient level, in standard deviations of that level.
    min_separation_m : float
        Least distance of two targets of one zone.
    reports : {"range", "z"}
        Whether the chip reports ranges along the ray or converts them to z.
    error_scale : float
        Scatter of histograms over what noise and the tolerance of a fit expect. 0: no errors are stated.
    error_zone_m : float
        Standard deviation of what each histogram errs for itself, as a displacement of an object, each component; the
        next ones too.
    error_pose_m, error_pose_deg : float
        Of the pose that an arm states, each for itself.
    error_side_m, error_side_deg : float
        Of what poses share that look from one side.
    error_side_reach_deg : float
        Angle between directions over which that changes.
    error_hand_m, error_hand_deg : float
        Of the hand-eye transform.
    error_object_m, error_object_deg : float
        Of an object's mesh: dimensions and place.

    Raises
    ------
    UsageError
        A value is out of range, or two contradict each other.
    """

    bins: Annotated[int, Field(ge=8, le=4096)]
    bin_width_m: Annotated[float, Field(ge=1e-4, le=10, allow_inf_nan=False)]
    start_m: _Number = 0.0
    cycles: Annotated[float, Field(gt=0, le=1e12)]
    photons: Annotated[float, Field(gt=0, le=1e6)]
    ambient: _NonNegative = 0.0
    dark: _NonNegative = 0.0
    irf_std_m: Annotated[float, Field(gt=0, le=10)] | None = None
    irf: tuple[tuple[_NonNegative, ...], ...] = ()
    irf_start_m: _Number = 0.0
    irf_step_m: Annotated[float, Field(gt=0, le=1)] | None = None
    crosstalk: _NonNegative = 0.0
    crosstalk_range_m: _Number = 0.0
    pile_up: bool = True
    zone_scale: tuple[Annotated[float, Field(gt=0, le=8)], Annotated[float, Field(gt=0, le=8)]] = (1.0, 1.0)
    zone_blur: Annotated[float, Field(ge=0, le=1)] = 0.0
    light_width: Annotated[float, Field(gt=0, le=10)] | None = None
    light_centre: tuple[_Number, _Number] = (0.0, 0.0)
    stray: Annotated[float, Field(ge=0, lt=1)] = 0.0
    zone_gain: tuple[tuple[_NonNegative, ...], ...] = ()
    zone_bin_scale: tuple[tuple[Annotated[float, Field(ge=0.5, le=2)], ...], ...] = ()
    zone_order: tuple[Annotated[int, Field(ge=0)], ...] = ()
    time_converters: tuple[Annotated[int, Field(ge=0, le=255)], ...] = ()
    reference_gain: _Number = 0.0
    reference_peak: _Number | None = None
    estimator: Literal["centroid", "parabola"] = "centroid"
    estimator_bins: Annotated[int, Field(ge=1, le=64)] = 2
    max_targets: Annotated[int, Field(ge=1, le=MOST_TARGETS)] = 1
    threshold: Annotated[float, Field(gt=0, le=1e6)] = 5.0
    min_separation_m: _NonNegative = 0.0
    reports: Literal["range", "z"] = "range"
    error_scale: _NonNegative = 0.0
    error_zone_m: _NonNegative = 0.0
    error_pose_m: _NonNegative = 0.0
    error_pose_deg: _NonNegative = 0.0
    error_side_m: _NonNegative = 0.0
    error_side_deg: _NonNegative = 0.0
    error_side_reach_deg: Annotated[float, Field(gt=0, le=180)] = 30.0
    error_hand_m: _NonNegative = 0.0
    error_hand_deg: _NonNegative = 0.0
    error_object_m: _NonNegative = 0.0
    error_object_deg: _NonNegative = 0.0

    @classmethod
    def _refusal(cls, first: ErrorDetails) -> UsageError:
        if first["type"] == "extra_forbidden":
            return UsageError(f"'{first['loc'][0]}' is no key of [histogram]")
        return super()._refusal(first)

    @model_validator(mode="after")
    def _fields_agree(self) -> Self:
        if (self.irf_std_m is None) == (not self.irf):
            got = "both" if self.irf else "neither"
            raise ValueError(f"'irf_std_m' or 'irf' must be given, one of the two, got {got}")
        if self.irf:
            self._check_samples()
        elif self.irf_step_m is not None:
            raise ValueError("'irf_step_m' must be left out for a Gaussian response, it belongs to 'irf'")
        length_m = self.bins * self.bin_width_m
        width_m = 6 * self.irf_std_m if self.irf_std_m is not None else (len(self.irf[0]) - 1) * (self.irf_step_m or 0)
        if width_m > length_m:
            name = "'irf'" if self.irf else "'irf_std_m'"
            raise ValueError(
                f"{name} must describe a response narrower than the histogram of {self.bins} x {self.bin_width_m:g} m"
                f" = {length_m:.4g} m, got {width_m:.4g} m"
            )
        return self

    def _check_samples(self) -> None:
        """Refuse samples of a response that are no response."""
        if self.irf_step_m is None:
            raise ValueError("'irf_step_m' must be given with 'irf': the distance of its samples, metres")
        lengths = {len(row) for row in self.irf}
        least_irf_samples = 3
        if len(lengths) > 1 or min(lengths) < least_irf_samples:
            raise ValueError(
                f"'irf' must have rows of one length, at least {least_irf_samples} samples, got rows of"
                f" {' and '.join(map(str, sorted(lengths)))}"
            )
        for k, row in enumerate(self.irf):
            if not sum(row) > 0:
                raise ValueError(f"'irf' must have light in every row, got row {k} of zeros")

    def check_zones(self, rows: int, cols: int) -> None:
        """Refuse tables that do not belong to an image of rows × cols zones.

        Raises
        ------
        ValueError
        """
        for name in ("zone_gain", "zone_bin_scale"):
            table = getattr(self, name)
            if table and (len(table) != rows or {len(row) for row in table} != {cols}):
                got = f"{len(table)} rows of {' or '.join(sorted({str(len(row)) for row in table}))}"
                raise ValueError(f"'histogram.{name}' must have {rows} rows of {cols} numbers, got {got}")
        n = rows * cols
        if self.irf and len(self.irf) not in (1, n):
            raise ValueError(f"'histogram.irf' must have 1 row or {n}, one for each zone, got {len(self.irf)}")
        if self.time_converters and len(self.time_converters) != n:
            raise ValueError(
                f"'histogram.time_converters' must name the converter of each of {n} zones, got"
                f" {len(self.time_converters)}"
            )
        if self.zone_order and sorted(self.zone_order) != list(range(n)):
            raise ValueError(f"'histogram.zone_order' must hold each number from 0 to {n - 1} once")

    @property
    def length_m(self) -> float:
        """Length of the histogram as range, metres."""
        return self.bins * self.bin_width_m

    @property
    def irf_reach_m(self) -> tuple[float, float]:
        """Delays between which the instrument response lies, metres."""
        if self.irf_std_m is not None:
            return -6 * self.irf_std_m, 6 * self.irf_std_m
        return self.irf_start_m, self.irf_start_m + (len(self.irf[0]) - 1) * (self.irf_step_m or math.nan)
