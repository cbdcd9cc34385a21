"""A region of a camera's pixels, read block by block: what a large sensor's images are cut down to.

A block of n × n pixels adds up what they collect. The phasor of a block is the sum of its pixels' phasors, so a camera
that is read in blocks is itself a camera with fewer, larger pixels: renderer and matcher need know nothing of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError

if TYPE_CHECKING:
    from phasemark.render.sensor.lens_fields import Lens
    from phasemark.render.sensor.sensor import Sensor

MOST_BINNING = 64


class Region(NamedTuple):
    """A rectangle of pixels, and how many of them become one.

    Parameters
    ----------
    first_row, stop_row, first_col, stop_col : int
        The rectangle; the stops are one past the last.
    binning : int
        Pixels along each side of a block that becomes one pixel.
    """

    first_row: int
    stop_row: int
    first_col: int
    stop_col: int
    binning: int = 1

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns that are read."""
        return (self.stop_row - self.first_row) // self.binning, (self.stop_col - self.first_col) // self.binning

    def check(self, sensor: Sensor) -> None:
        """Refuse a region that the camera cannot be read in.

        Parameters
        ----------
        sensor : Sensor

        Raises
        ------
        UsageError
            It does not lie in the image, does not hold whole blocks, belongs to a direct sensor, or adds up pixels with
            gaps between them.
        """
        if sensor.kind == "direct":
            raise UsageError("'region' and 'binning' belong to phase cameras: the zones of a direct sensor overlap")
        n = self.binning
        if not 1 <= n <= MOST_BINNING:
            raise UsageError(f"'binning' must be a whole number from 1 to {MOST_BINNING}, got {n!r}")
        if n > 1 and tuple(sensor.fill_factor) != (1.0, 1.0):
            raise UsageError(f"'binning' takes pixels without gaps, got a 'fill_factor' of {tuple(sensor.fill_factor)}")
        sides = (
            ("rows", self.first_row, self.stop_row, sensor.rows),
            ("columns", self.first_col, self.stop_col, sensor.cols),
        )
        for name, first, stop, size in sides:
            if not 0 <= first < stop <= size:
                raise UsageError(f"the region's {name} must lie in 0 … {size}, got {first} … {stop}")
            if (stop - first) % n:
                whole = first + (stop - first) // n * n
                raise UsageError(
                    f"the region's {name} {first} … {stop} do not make whole blocks of {n}: end it at {whole or n}"
                )

    def camera(self, sensor: Sensor) -> Sensor:
        """Return the camera that reads this region of another one.

        A block collects the electrons of its pixels, their noise and their full wells. A converter's rounding becomes
        read noise. Patterns (PRNU, DSNU, offsets) average as those of independent pixels do, and a block with a dead
        or hot pixel is dead or hot.

        Parameters
        ----------
        sensor : Sensor

        Returns
        -------
        Sensor

        Raises
        ------
        UsageError
            As :meth:`check`.
        """
        self.check(sensor)
        rows, cols = self.shape
        changes: dict[str, Any] = {
            "rows": rows,
            "cols": cols,
            "whole_image_px": self._whole_image(sensor),
            "dead_pixels": self._moved(sensor.dead_pixels),
            "hot_pixels": self._moved(sensor.hot_pixels),
        }
        changes |= self._ideal_geometry(sensor) if sensor.lens is None else {"lens": self._of_lens(sensor.lens)}
        there = sensor.with_(**changes, **(_added_up(sensor, self.binning) if self.binning > 1 else {}))
        if not sensor.calibration_fields:
            return there
        rate = np.array([_rate(sensor, there, name, self.binning) for name in sensor.calibration_fields])
        covariance = sensor.calibration_matrix * np.outer(rate, rate)
        return there.with_(calibration_covariance=tuple(tuple(row) for row in covariance.tolist()))

    def blocks(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the pixels of each block of images (…, rows, cols) along the last axis, (…, rows, cols, binning²)."""
        n, (rows, cols) = self.binning, self.shape
        cut = values[..., self.first_row : self.stop_row, self.first_col : self.stop_col]
        parts = cut.reshape(*values.shape[:-2], rows, n, cols, n)
        return np.moveaxis(parts, -3, -2).reshape(*values.shape[:-2], rows, cols, n * n)

    def _whole_image(self, sensor: Sensor) -> tuple[float, float] | None:
        """Return the size of the whole image in blocks, None where the blocks are all of it."""
        width, height = sensor.whole_image_px or (sensor.cols, sensor.rows)
        whole, (rows, cols) = (width / self.binning, height / self.binning), self.shape
        return None if whole == (cols, rows) else whole

    def _ideal_geometry(self, sensor: Sensor) -> dict[str, Any]:
        """Return half angles and principal point of a camera without distortion that reads this region."""
        (rows, cols), n = self.shape, self.binning
        (tan_h, tan_v), (u0, v0) = sensor.tan_half_angles, sensor.centre_px
        centre = (u0 - self.first_col) / n, (v0 - self.first_row) / n
        return {
            "half_angle_h_deg": math.degrees(math.atan(tan_h * (cols * n / sensor.cols))),
            "half_angle_v_deg": math.degrees(math.atan(tan_v * (rows * n / sensor.rows))),
            "principal_point_px": None if centre == (cols / 2, rows / 2) else centre,
        }

    def _of_lens(self, lens: Lens) -> dict[str, Any]:
        """Return the intrinsics of a lens before this region."""
        n = self.binning
        centres = (lens.cx + 0.5 - self.first_col) / n - 0.5, (lens.cy + 0.5 - self.first_row) / n - 0.5
        return {**lens.model_dump(), "fx": lens.fx / n, "fy": lens.fy / n, "cx": centres[0], "cy": centres[1]}

    def _moved(self, pixels: Sequence[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
        """Return the blocks that some pixels lie in."""
        inside = {
            ((row - self.first_row) // self.binning, (col - self.first_col) // self.binning)
            for row, col in pixels
            if self.first_row <= row < self.stop_row and self.first_col <= col < self.stop_col
        }
        return tuple(sorted(inside))


def _rate(sensor: Sensor, there: Sensor, name: str, binning: int) -> float:
    """Return how much a field of a camera that reads a region changes with that of the whole camera."""
    if name in ("lens.fx", "lens.fy", "lens.cx", "lens.cy"):
        return 1 / binning
    if name in ("half_angle_h_deg", "half_angle_v_deg") and sensor.lens is None:
        # tan α' = tan α · share
        whole, part = (math.radians(getattr(one, name)) for one in (sensor, there))
        return math.sin(2 * part) / math.sin(2 * whole)
    return 1.0


def _added_up(sensor: Sensor, n: int) -> dict[str, Any]:
    """Return the changed fields of a camera whose pixels are n × n pixels of another one."""
    area = n * n
    well = sensor.saturation_e
    return {
        "signal_e": sensor.signal_e * area,
        "ambient_e": sensor.ambient_e * area,
        "dark_e": sensor.dark_e * area,
        "dsnu_e": sensor.dsnu_e * n,
        "prnu": sensor.prnu / n,
        "read_noise_e": n * math.sqrt(sensor.read_variance_e2 / 2),
        "full_well_e": well * area if math.isfinite(well) else None,
        "adc_bits": None,
        "gain": 1.0,
        "black_level": 0.0,
        "phase_offset_std_rad": sensor.phase_offset_std_rad / n,
        "tap_phase_offset_std_rad": sensor.tap_phase_offset_std_rad / n,
        "blur_px": sensor.blur_px / n,
        "veil_px": sensor.veil_px / n,
        "dead_share": 1 - (1 - sensor.dead_share) ** area,
        "hot_share": 1 - (1 - sensor.hot_share) ** area,
        "min_amplitude_e": sensor.min_amplitude_e * area,
    }
