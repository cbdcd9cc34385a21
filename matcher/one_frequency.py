"""Cameras of several modulation frequencies as matchers see them: as a camera of one frequency (PHYSICS section 10).

Two cameras of one frequency stand for one camera of m frequencies f_j.

*Stacked*, for phases: m images above one another, with every phase as if it were one at the first frequency. A phase's
residual is wrapped and weighed with its own noise, so that nothing has to be unwrapped. The upper halves of all images
come first, then the lower halves: what belongs to the upper part of a landmark is the upper half again.

*Combined*, for unwrapped ranges: the image itself at the greatest common divisor g, whose phase wraps where the
unwrapped range does. With Σ (f_j / g)² as many electrons the noise law of that camera is the combined variance
1 / Σ σ_j⁻².
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.render import PhasorImages, Renderer, Sensor, Views, unwrap_ranges
from phasemark.render.renderer import SplitImages
from phasemark.render.sensor.frequencies import common_divisor_hz
from phasemark.render.sensor.lens_fields import DERIVED

Way = Literal["stacked", "combined"]


class OneFrequency:
    """Conversion of a camera of several frequencies to a camera of one frequency.

    Parameters
    ----------
    camera : Sensor
        With m > 1 modulation frequencies.
    way : {"stacked", "combined"}

    Attributes
    ----------
    sensor : Sensor
        The camera that stands for it: m · rows × cols pixels at the first frequency, or its own pixels at the common
        divisor.
    """

    def __init__(self, camera: Sensor, way: Way) -> None:
        self.camera, self.way = camera, way
        self.stacked = way == "stacked"
        self._m = len(camera.frequencies_hz)
        self._metres = np.array([one.metres_per_radian for one in camera.by_frequency])
        self.sensor = self._stacked_sensor() if self.stacked else self._combined_sensor()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, OneFrequency) and (self.camera, self.way) == (other.camera, other.way)

    def __hash__(self) -> int:
        return hash((self.camera, self.way))

    def _stacked_sensor(self) -> Sensor:
        fields = self.camera.by_frequency[0].model_dump()
        optics = {"rows": self._m * self.camera.rows, "principal_point_px": None, "dead_pixels": (), "hot_pixels": ()}
        return Sensor(**{**{name: value for name, value in fields.items() if name != "lens"}, **optics})

    def _combined_sensor(self) -> Sensor:
        camera, hz = self.camera, common_divisor_hz(self.camera.frequencies_hz)
        more = self._more_electrons
        limit = camera.max_phase_std_rad
        return camera.with_(
            modulation_hz=hz,
            phase_interval_s=None,
            modulation="sine",
            harmonics=(),
            emitted_pulse=(),
            reference_pulse=(),
            signal_e=camera.signal_e * more,
            ambient_e=camera.ambient_e * more,
            dark_e=camera.dark_e * more,
            dsnu_e=camera.dsnu_e * more,
            read_noise_e=math.sqrt(camera.read_variance_e2 / 2 * more),
            full_well_e=None,
            adc_bits=None,
            gain=1.0,
            black_level=0.0,
            min_amplitude_e=camera.min_amplitude_e * more,
            max_phase_std_rad=None if limit is None else limit / math.sqrt(more),
        )

    @property
    def _more_electrons(self) -> float:
        hz = common_divisor_hz(self.camera.frequencies_hz)
        return math.fsum((own / hz) ** 2 for own in self.camera.frequencies_hz)

    def camera_like(self, sensor: Sensor) -> Sensor:
        """Return the camera with the fields in which a sensor differs from the one that stands for the camera.

        Parameters
        ----------
        sensor : Sensor
            Of one frequency, with other optics or another calibration.
        """
        changes = {
            name: getattr(sensor, name)
            for name in type(sensor).model_fields
            if getattr(sensor, name) != getattr(self.sensor, name)
        }
        if "lens" in changes:  # the others follow from it
            changes = {name: value for name, value in changes.items() if name not in DERIVED}
        return self.camera.with_(**changes)

    def stack(self, layers: NDArray[Any]) -> NDArray[Any]:
        """Put images (…, m, rows, cols) above one another, (…, m · rows, cols): first upper halves, then lower ones.

        Images that are one half alone are put above one another as they are.
        """
        *others, m, rows, cols = layers.shape
        if rows != self.camera.rows:
            return layers.reshape(*others, m * rows, cols)
        half = rows // 2
        upper = layers[..., :half, :].reshape(*others, m * half, cols)
        lower = layers[..., half:, :].reshape(*others, m * (rows - half), cols)
        return np.concatenate([upper, lower], axis=-2)

    def layers(self, stacked: NDArray[Any]) -> NDArray[Any]:
        """Take stacked images (…, m · rows, cols) apart again, (…, m, rows, cols)."""
        *others, _, cols = stacked.shape
        half = self.camera.rows // 2
        upper, lower = np.split(stacked, [self._m * half], axis=-2)
        halves = [part.reshape(*others, self._m, -1, cols) for part in (upper, lower)]
        return np.concatenate(halves, axis=-2)

    def same_for_all(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return an image (…, rows, cols) that all frequencies share, as the camera of one frequency has it."""
        if not self.stacked:
            return image
        *others, rows, cols = image.shape
        return self.stack(np.broadcast_to(image[..., None, :, :], (*others, self._m, rows, cols)))

    def rows(self, rows: tuple[int, int] | None) -> tuple[int, int] | None:
        """Return which rows of the camera some rows of the image are; of a stacked one all of them, or a half."""
        if rows is None or not self.stacked:
            return rows
        halves = {self.sensor.upper_rows: self.camera.upper_rows, self.sensor.lower_rows: self.camera.lower_rows}
        return halves.get(rows)

    def images(self, seen: PhasorImages) -> PhasorImages:
        """Return images of the camera in the form of the camera of one frequency."""
        phasor = self.stack(seen.phasors) if self.stacked else self._combined_phasor(seen)
        upper = seen.upper_coverage
        return PhasorImages(
            phasor=phasor,
            intensity=self.same_for_all(seen.intensity),
            coverage=self.same_for_all(seen.coverage),
            upper_coverage=None if upper is None else self.same_for_all(upper),
            sensor=self.sensor,
            views=seen.views,
        )

    def slopes(self, seen: PhasorImages, slope: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return slopes (n, p, m, rows, cols) as the camera of one frequency has them, (n, p, rows', cols)."""
        if self.stacked:
            return self.stack(slope)
        s = seen.phasors[:, None]
        power = np.abs(s) ** 2
        known = (power.min(axis=2) > 0) & self._is_unmixed(seen)[:, None]
        scale = self._metres[:, None, None]
        safe = np.where(power > 0, power, 1.0)
        weight = power / scale**2
        along = scale * (s.conj() * slope).imag / safe
        total = np.where(known, weight.sum(axis=2), 1.0)
        by_range = (weight * along).sum(axis=2) / total
        brighter = (s.conj() * slope).real[:, :, 0] / safe[:, :, 0]
        turned = self._combined_phasor(seen)[:, None] * (brighter + 1j * by_range / self.sensor.metres_per_radian)
        return np.asarray(np.where(known, turned, 0.0))

    def _is_unmixed(self, seen: PhasorImages) -> NDArray[np.bool_]:
        """Return which pixels see one range at all frequencies, (n, rows, cols).

        The unwrapped range of another may run away with the smallest move, and tells nothing of the view.
        """
        ranges = np.stack([part.range_m for part in seen.by_frequency])
        # how far the phases of the frequencies may disagree, as a standard deviation, for a pixel to count as unmixed
        unmixed_rad = 0.01
        return unwrap_ranges(ranges, unmixed_rad * self._metres[:, None, None, None], self.camera).consistent

    def _combined_phasor(self, seen: PhasorImages) -> NDArray[np.complex128]:
        range_m = seen.range_m
        lit = np.isfinite(range_m)
        turn = np.exp(1j * np.where(lit, range_m, 0.0) / self.sensor.metres_per_radian)
        return np.asarray(np.where(lit, np.abs(seen.phasor) * turn, 0.0))

    def frames(self, frames: FilteredFrames) -> FilteredFrames:
        """Return the frames that the camera of one frequency would have measured.

        Raises
        ------
        UsageError
            Phases are asked of frames that hold unwrapped ranges alone.
        """
        sensor = self._of_frames(frames.sensor)
        if not self.stacked:
            more = self._more_electrons
            return replace(
                frames,
                amplitude_e=None if frames.amplitude_e is None else frames.amplitude_e * more,
                intensity_e=None if frames.intensity_e is None else frames.intensity_e * more,
                sensor=sensor,
                by_frequency=(),
            )
        parts = frames.by_frequency
        if not parts:
            raise UsageError(
                "the frames hold unwrapped ranges alone, and phases are compared at every modulation frequency: give"
                ' frames with what each of them measured, or match with method="refine" on="ranges" and no background'
            )

        as_first = (self._metres[0] / self._metres)[:, None, None]
        stacked: dict[str, Any] = {}
        for name in ("range_m", "std_m", "amplitude_e", "intensity_e", "state", "n_effective"):
            values = [getattr(part, name) for part in parts]
            if any(one is None for one in values):
                stacked[name] = None
            else:
                layers = np.stack(values, axis=1)
                stacked[name] = self.stack(layers * as_first if name in ("range_m", "std_m") else layers)
        scattered = any(part.std_from_scatter for part in parts)
        return replace(frames, **stacked, sensor=sensor, std_from_scatter=scattered, by_frequency=())

    def _of_frames(self, sensor: Sensor) -> Sensor:
        """Return the camera of one frequency with the noise and the calibration of the frames' own sensor."""
        return self.sensor if sensor == self.camera else OneFrequency(sensor, self.way).sensor


class OneFrequencyRenderer(Renderer):
    """Renders what a camera of one frequency has of a landmark; see :class:`OneFrequency`.

    Parameters
    ----------
    renderer : Renderer
        Of the camera of several frequencies.
    one : OneFrequency
    """

    def __init__(self, renderer: Renderer, one: OneFrequency) -> None:
        self.__dict__.update(renderer.__dict__)
        self._renderer, self._one = renderer, one
        self.sensor = one.sensor

    def seen_by(self, sensor: Sensor) -> Renderer:
        """Return a renderer for a camera that differs in optics from the one that stands for the camera."""
        camera = self._one.camera_like(sensor)
        return OneFrequencyRenderer(self._renderer.seen_by(camera), OneFrequency(camera, self._one.way))

    def render_views(self, views: Views, *, rows: tuple[int, int] | None = None, **options: Any) -> PhasorImages:
        """Render a batch of views; `rows` are all, or a half of the image."""
        return self._one.images(self._renderer.render_views(views, rows=self._one.rows(rows), **options))

    def render(self, *view: Any, **options: Any) -> PhasorImages:
        """Render views; see :meth:`~phasemark.render.Renderer.render`."""
        return self._one.images(self._renderer.render(*view, **options))

    def render_with_slopes(
        self, views: Views, *parameters: Any, **options: Any
    ) -> tuple[PhasorImages, NDArray[np.complex128]]:
        """Render views and their slopes."""
        seen, slope = self._renderer.render_with_slopes(views, *parameters, **options)
        return self._one.images(seen), self._one.slopes(seen, slope)

    def render_split(
        self, views: Views, *parameters: Any, rows: tuple[int, int] | None = None, **options: Any
    ) -> SplitImages:
        """Render views and their slopes, and those of the landmark alone; `rows` are all, or a half of the image."""
        lit = self._one.rows(rows)
        seen, slope, alone, own = self._renderer.render_split(views, *parameters, rows=lit, **options)
        one = self._one
        return one.images(seen), one.slopes(seen, slope), one.images(alone), one.slopes(alone, own)

    def jacobian(self, *view: Any, **options: Any) -> NDArray[np.complex128]:
        """Return slopes by differences."""
        drawn = {name: value for name, value in options.items() if name != "parameters"}
        return self._one.slopes(self._renderer.render(*view, **drawn), self._renderer.jacobian(*view, **options))


def phases_of(renderer: Renderer) -> Renderer:
    """Return a renderer of the phases of all frequencies, stacked; of one frequency the renderer itself."""
    if len(renderer.sensor.frequencies_hz) == 1:
        return renderer
    return OneFrequencyRenderer(renderer, OneFrequency(renderer.sensor, "stacked"))
