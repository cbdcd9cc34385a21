"""Model images rendered where they are needed, from the meshes of a bank: any view, and anything behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.matcher.frequencies import renderer_of
from phasemark.matcher.likelihood.images import VIEW, ModelImages
from phasemark.matcher.likelihood.view_cache import ViewCache
from phasemark.render import Background, PhasorImages, Renderer, Sensor, Views

STEP = 1e-5
"""Width of a difference, metres or radians: see :meth:`~phasemark.render.Renderer.jacobian`."""
_BEFORE_LENS_M, _BEFORE_WALL_M = 5e-3, 1e-3
"""Smallest gaps between the circle around a landmark and the lens, and the wall."""
_BEYOND_BANK = 1.25
"""Without a wall a view may be this many times as far as the bank's last distance."""


class RenderedModel:
    """Model images rendered where they are needed, from the meshes of a bank.

    Parameters
    ----------
    bank : Bank
    background : Background, optional
        What stands behind the landmark.
    cache_bytes : int
        Room for images that other frames may start from too.
    splits_light : bool
        Whether images know what of their phasors comes from the background, which takes a second rendering of each:
        it depends on the bearing and the tilt of the view.
    """

    slopes_are_cheap = False

    def __init__(
        self, bank: Bank, background: Background | None = None, cache_bytes: int = 0, *, splits_light: bool = False
    ) -> None:
        self._splits_light = splits_light
        self.sensor: Sensor = bank.sensor
        self.background = background
        self.cache = ViewCache(cache_bytes)
        self._renderers = []
        self._factored = bank.lower is not None
        self._radius_m = 0.0
        for name in bank.classes:
            mesh = bank.mesh(name)
            self._renderers.append(renderer_of(bank, mesh, float(mesh.metadata["albedo"])))
            self._radius_m = max(self._radius_m, float(np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]).max()))
        self._bank_end_m = float(bank.distance_m[-1])
        self._limits = self._limits_before(background)

    def _limits_before(self, background: Background | None) -> tuple[float, float]:
        """Return the limits of distance: the lens outside the landmark, and the landmark before the wall."""
        wall = None if background is None else background.wall_m
        far = _BEYOND_BANK * self._bank_end_m if wall is None else wall - self._radius_m - _BEFORE_WALL_M
        return self._radius_m + _BEFORE_LENS_M, far

    def renderer(self, class_index: int) -> Renderer:
        """Return what renders one class of the bank."""
        return self._renderers[class_index]

    def with_background(self, background: Background | None) -> RenderedModel:
        """Return the same model before another background."""
        other = object.__new__(RenderedModel)
        other.__dict__.update(self.__dict__)
        other.background = background
        other._limits = self._limits_before(background)
        return other

    @property
    def alone(self) -> RenderedModel | None:
        """The same model without a background, over the same distances, where the light is split; None elsewhere."""
        if not self._splits_light or self.background is None:
            return None
        other = self.with_background(None)
        other._limits = self._limits
        return other

    def limits(self) -> tuple[float, float]:
        """Return how near the lens may come, and how far the landmark may be."""
        return self._limits

    def images(self, class_index: NDArray[np.int64], view: NDArray[np.float64], free: Sequence[str]) -> ModelImages:
        """Render the views, and with them how they change.

        Height has one-sided slopes at 0, where the top of the lower part appears: it is differenced over 1e-5 m.
        """
        m, pixels, p = len(view), self.sensor.rows * self.sensor.cols, len(free)
        phasor, slope = np.empty((m, pixels), np.complex128), np.zeros((m, p, pixels), np.complex128)
        intensity, coverage = np.empty((m, pixels)), np.empty((m, pixels))
        smooth = [name for name in free if name != "height_m"]
        for c in np.unique(class_index):
            of = np.flatnonzero(class_index == c)
            image, slopes = (
                self._render_with_slopes(c, view[of], smooth) if smooth else (self._render(c, view[of]), None)
            )
            phasor[of] = image.phasor.reshape(len(of), -1)
            intensity[of] = image.intensity.reshape(len(of), -1)
            coverage[of] = image.coverage.reshape(len(of), -1)
            for k, name in enumerate(free):
                if slopes is not None and name in smooth:
                    slope[of, k] = slopes[:, smooth.index(name)].reshape(len(of), -1)
                    continue
                moved = view[of]
                moved[:, VIEW.index(name)] += STEP
                width = (moved - view[of])[:, VIEW.index(name)]
                there = self._render(c, moved).phasor.reshape(len(of), -1)
                slope[of, k] = (there - phasor[of]) / width[:, None]
        if self._factored and "delta_rad" in free:  # a body of revolution looks the same from every side
            level, first = ~view[:, 3:].any(axis=1), self.sensor.lower_rows[0] * self.sensor.cols
            slope[level, list(free).index("delta_rad"), :first] = 0
        alone = self.alone
        if alone is None:
            return ModelImages(phasor, slope, intensity, coverage)
        landmark = alone.images(class_index, view, free)
        return ModelImages(phasor, slope, intensity, coverage, phasor - landmark.phasor, slope - landmark.slope)

    def first_images(
        self, class_index: NDArray[np.int64], view: NDArray[np.float64], free: Sequence[str]
    ) -> ModelImages:
        """Return images as :meth:`images` does, rendered only where no frame before has asked for them."""
        keys = [(int(c), one.tobytes(), tuple(free), self.background) for c, one in zip(class_index, view, strict=True)]
        place = {key: k for k, key in enumerate(keys)}  # of one that asks for it
        found = {key: self.cache.get(key) for key in place}
        missing = [k for key, k in place.items() if found[key] is None]
        new = self.images(class_index[missing], np.ascontiguousarray(view[missing]), free)
        held = [values for values in new.arrays() if values is not None]
        for k, *arrays in zip(missing, *held, strict=True):
            own = tuple(values.copy() for values in arrays)  # no view of the whole batch, which would stay too
            found[keys[k]] = own
            self.cache.put(keys[k], own)
        rows = [row for row in map(found.get, keys) if row is not None]
        if not rows:
            return new
        return ModelImages(*(np.stack([cast(Any, row[part]) for row in rows]) for part in range(len(rows[0]))))

    def turned(self, class_index: NDArray[np.int64], view: NDArray[np.float64], like: ModelImages) -> ModelImages:
        """Render the rows that δ changes."""
        phasor, intensity, coverage = like.phasor.copy(), like.intensity.copy(), like.coverage.copy()
        rows, first = self._changing_rows("delta_rad", view)
        for c in np.unique(class_index):
            of = np.flatnonzero(class_index == c)
            image = self._render(c, view[of], rows)
            for values, new in ((phasor, image.phasor), (intensity, image.intensity), (coverage, image.coverage)):
                values[of, first:] = new.reshape(len(of), -1)
        alone = self.alone
        if alone is None or like.behind is None:
            return ModelImages(phasor, like.slope, intensity, coverage)
        landmark = alone.turned(class_index, view, replace(like, phasor=like.phasor - like.behind)).phasor
        return ModelImages(phasor, like.slope, intensity, coverage, phasor - landmark, like.behind_slope)

    def wide_slopes(
        self,
        class_index: NDArray[np.int64],
        view: NDArray[np.float64],
        free: Sequence[str],
        step: NDArray[np.float64],
    ) -> NDArray[np.complex128]:
        """Render both ends."""
        slope = np.zeros((len(view), len(free), self.sensor.rows * self.sensor.cols), np.complex128)
        for c in np.unique(class_index):
            of = np.flatnonzero(class_index == c)
            for k, name in enumerate(free):
                rows, first = self._changing_rows(name, view[of])
                axis = VIEW.index(name)
                ends = []
                for side in (1.0, -1.0):
                    moved = view[of]
                    moved[:, axis] += side * np.maximum(step[of, k], STEP)
                    moved[:, 0] = np.clip(moved[:, 0], *self._limits)
                    ends.append((moved[:, axis], self._render(c, moved, rows).phasor.reshape(len(of), -1)))
                width = np.maximum(ends[0][0] - ends[1][0], STEP)
                slope[of, k, first:] = (ends[0][1] - ends[1][1]) / width[:, None]
        return slope

    def differences(
        self, class_index: NDArray[np.int64], view: NDArray[np.float64], moves: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """Render both ends."""
        m, k = moves.shape[:2]
        ends = np.concatenate([view[:, None] + moves, view[:, None] - moves], axis=1)
        ends[..., 0] = np.clip(ends[..., 0], *self._limits)
        phasor = np.empty((m, 2 * k, self.sensor.rows * self.sensor.cols), np.complex128)
        for c in np.unique(class_index):
            of = np.flatnonzero(class_index == c)
            image = self._render(c, ends[of].reshape(-1, len(VIEW)))
            phasor[of] = image.phasor.reshape(len(of), 2 * k, -1)
        return np.asarray((phasor[:, :k] - phasor[:, k:]) / 2)

    def _changing_rows(self, name: str, view: NDArray[np.float64]) -> tuple[tuple[int, int] | None, int]:
        """Return the rows that a parameter changes, None for all, and their first pixel.

        A body of revolution looks the same from every side.
        """
        if self._factored and name == "delta_rad" and not view[:, 3:].any():
            return self.sensor.lower_rows, self.sensor.lower_rows[0] * self.sensor.cols
        return None, 0

    def trusted(self, class_index: NDArray[np.int64], view: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return that every pixel may be relied on."""
        return np.ones((len(view), self.sensor.rows * self.sensor.cols), np.bool_)

    def reach(
        self,
        class_index: NDArray[np.int64],
        view: NDArray[np.float64],
        free: Sequence[str],
        std: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the least and greatest coverage three standard deviations away along each parameter."""
        low = np.full((len(view), self.sensor.rows * self.sensor.cols), np.inf)
        high = np.zeros(low.shape)
        for k, name in enumerate(free):
            for side in (-3.0, 3.0):
                moved = view.copy()
                moved[:, VIEW.index(name)] += side * std[:, k]
                moved[:, 0] = np.clip(moved[:, 0], *self._limits)
                for c in np.unique(class_index):
                    of = np.flatnonzero(class_index == c)
                    coverage = self._render(c, moved[of]).coverage.reshape(len(of), -1)
                    low[of], high[of] = np.minimum(low[of], coverage), np.maximum(high[of], coverage)
        return low, high

    def _render_with_slopes(
        self, class_index: int, view: NDArray[np.float64], free: Sequence[str]
    ) -> tuple[PhasorImages, NDArray[np.complex128]]:
        renderer, parts, slopes = self._renderers[class_index], [], []
        for which, background in self._backgrounds_of(class_index, view):
            views = Views(*np.ascontiguousarray(view[which].T))
            image, slope = renderer.render_with_slopes(views, free, background=background)
            parts.append((which, image))
            slopes.append(slope)
        order = np.argsort(np.concatenate([which for which, _ in parts]), kind="stable")
        return _joined(parts), np.concatenate(slopes)[order]

    def _render(self, class_index: int, view: NDArray[np.float64], rows: tuple[int, int] | None = None) -> PhasorImages:
        renderer, parts = self._renderers[class_index], []
        for which, background in self._backgrounds_of(class_index, view):
            views = Views(*np.ascontiguousarray(view[which].T))
            parts.append((which, renderer.render_views(views, background=background, rows=rows)))
        return _joined(parts)

    def _backgrounds_of(
        self, class_index: int, view: NDArray[np.float64]
    ) -> list[tuple[NDArray[np.intp], Background | None]]:
        """Return groups of views with the background of each.

        A floor is lowered to where the landmark ends: floors are estimated, and heights are tried.
        """
        everything = np.arange(len(view))
        if self.background is None or self.background.floor_m is None:
            return [(everything, self.background)]
        lowest_m = float(self._renderers[class_index].topology.vertices[:, 2].min())
        height_m = Views(*np.ascontiguousarray(view.T)).in_camera(self.sensor).height_m
        floor_m = np.maximum(self.background.floor_m, -(lowest_m + height_m))
        return [
            (np.flatnonzero(floor_m == own), replace(self.background, floor_m=float(own))) for own in np.unique(floor_m)
        ] or [(everything, self.background)]


def _joined(parts: list[tuple[NDArray[np.intp], PhasorImages]]) -> PhasorImages:
    """Return images of groups of views in the order of the views."""
    if len(parts) == 1:
        return parts[0][1]
    order = np.argsort(np.concatenate([which for which, _ in parts]), kind="stable")
    images = [image for _, image in parts]

    def of(name: str) -> Any:
        return np.concatenate([getattr(image, name) for image in images])[order]

    return PhasorImages(
        phasor=of("phasor"),
        intensity=of("intensity"),
        coverage=of("coverage"),
        sensor=images[0].sensor,
        views=Views(*(np.concatenate([getattr(image.views, name) for image in images])[order] for name in VIEW)),
    )
