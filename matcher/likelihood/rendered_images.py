"""Model images rendered where they are needed, from the meshes of a bank: any view, and anything behind it."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.matcher.frequencies import renderer_of
from phasemark.matcher.likelihood.images import BEFORE_LENS_M, VIEW, ImageModel, ModelImages
from phasemark.matcher.likelihood.view_cache import ViewCache
from phasemark.matcher.pixel_agreement import MAY_RETURN_COVERAGE
from phasemark.render import Background, PhasorImages, Renderer, Sensor, Views
from phasemark.render.background import Backgrounds
from phasemark.render.direct.chip_renderer import ChipRenderer
from phasemark.render.renderer import SplitImages
from phasemark.render.view import Footprint

STEP = 1e-5
"""Width of a difference, metres or radians: see :meth:`~phasemark.render.Renderer.jacobian`."""
_BEFORE_WALL_M = 1e-3
"""Smallest gap between a landmark and the wall."""


class RenderedModel(ImageModel):
    """Model images rendered where they are needed, from the meshes of a bank.

    Parameters
    ----------
    bank : Bank
    background : Background, optional
        What stands behind the landmark.
    cache_bytes : int
        Room for images that other frames may start from too.
    splits_light : bool
        Whether images know what of their phasors comes from the background: it differs across a pixel, and from view to
        view.
    reported : bool
        Whether ranges are those that the chip of a direct sensor reports.
    """

    slopes_are_cheap = False

    def __init__(
        self,
        bank: Bank,
        background: Background | None = None,
        cache_bytes: int = 0,
        *,
        splits_light: bool = False,
        reported: bool = False,
    ) -> None:
        self._splits_light, self.is_of_chip = splits_light, reported
        self.sensor: Sensor = bank.sensor
        self.cache = ViewCache(cache_bytes)
        self._renderers = []
        self._factored = bank.lower is not None
        vertices = []
        for name in bank.classes:
            mesh = bank.mesh(name)
            albedo = float(mesh.metadata["albedo"])
            renderer = renderer_of(bank, mesh, albedo)
            if reported:
                renderer = ChipRenderer(mesh, bank.sensor, albedo=albedo, unsure_coverage=MAY_RETURN_COVERAGE)
            self._renderers.append(renderer)
            vertices.append(np.asarray(mesh.vertices, np.float64))
        self._footprint = Footprint.of_vertices(np.concatenate(vertices))
        self._bank_end_m = float(bank.distance_m[-1])
        self._stand_before([background])

    def _stand_before(self, backgrounds: Sequence[Background | None]) -> None:
        """Take what stands behind all frames, or each of them."""
        self._backgrounds = tuple(backgrounds)
        self._frame: NDArray[np.int64] | None = None
        self._factor: NDArray[np.float64] | None = None
        self._floors = any(background is not None and background.floor_m is not None for background in backgrounds)
        wall_m = [None if background is None else background.wall_m for background in backgrounds]
        self._wall_m = np.array([math.inf if wall is None else wall for wall in wall_m])

    def renderer(self, class_index: int) -> Renderer:
        """Return what renders one class of the bank."""
        return self._renderers[class_index]

    def with_background(self, *backgrounds: Background | None) -> RenderedModel:
        """Return the same model before another background, or before one for each frame."""
        other = copy.copy(self)
        other._stand_before(backgrounds)
        return other

    def seen_by(self, sensor: Sensor) -> RenderedModel:
        """Return the same landmarks seen by another camera, at any distance."""
        other = copy.copy(self)
        other.sensor, other.cache, other._bank_end_m = sensor, ViewCache(0), math.inf
        other._renderers = [one.seen_by(sensor) for one in self._renderers]
        return other

    def of_frames(self, frame: NDArray[np.int64]) -> RenderedModel:
        """Return the model whose views are those of some frames."""
        if len(self._backgrounds) == 1:
            return self
        other = copy.copy(self)
        other._frame = frame
        return other

    @property
    def alone(self) -> RenderedModel | None:
        """The same model without a background, over the same distances, where the light is split; None elsewhere."""
        if not self._splits_light or not any(self._backgrounds):
            return None
        other = copy.copy(self)
        other._backgrounds, other._floors = (None,) * len(self._backgrounds), False
        return other

    def lit(self, factor: NDArray[np.float64]) -> RenderedModel | None:
        """Return the model whose landmarks are brighter by some factors (m,), where light is split."""
        if self.alone is None:
            return None
        other = copy.copy(self)
        other._factor = factor
        return other

    def limits(
        self, delta_rad: NDArray[np.float64], which: NDArray[np.integer] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return from where on the lens is outside of the landmark, and up to where this is before the wall."""
        wall_m = self._wall_m[:1]
        if self._frame is not None:
            wall_m = self._wall_m[self._frame if which is None else self._frame[which]]
        beyond_bank = 1.25  # without a wall a view may be this many times as far as the bank's last distance
        before_wall = wall_m - self._footprint.reach_m(delta_rad) - _BEFORE_WALL_M
        farthest = np.where(np.isinf(wall_m), beyond_bank * self._bank_end_m, before_wall)
        return self._footprint.nearest_m(delta_rad, BEFORE_LENS_M), farthest

    def images(self, class_index: NDArray[np.int64], view: NDArray[np.float64], free: Sequence[str]) -> ModelImages:
        """Render the views, and with them how they change.

        Height has one-sided slopes at 0, where the top of the lower part appears: it is differenced over 1e-5 m.
        """
        m, pixels, p = len(view), self.sensor.rows * self.sensor.cols, len(free)
        splits = self.alone is not None
        phasor, slope = np.empty((m, pixels), np.complex128), np.zeros((m, p, pixels), np.complex128)
        own_phasor, own_slope = np.empty_like(phasor), np.zeros_like(slope)  # of the landmark alone
        intensity, coverage = np.empty((m, pixels)), np.empty((m, pixels))
        smooth = [name for name in free if name != "height_m" or self.is_of_chip]
        for c in np.unique(class_index):
            of = np.flatnonzero(class_index == c)
            image, slopes, alone, alone_slopes = self._rendered(c, view[of], of, smooth, split=splits)
            phasor[of], own_phasor[of] = (one.phasor.reshape(len(of), -1) for one in (image, alone))
            intensity[of] = image.intensity.reshape(len(of), -1)
            # a chip need not see a surface that fills a zone at a slant, or far away
            faint = np.where(image.phasor == 0, MAY_RETURN_COVERAGE, 1.0) if self.is_of_chip else 1.0
            coverage[of] = np.minimum(image.coverage, faint).reshape(len(of), -1)
            for k, name in enumerate(free):
                if name in smooth:
                    for into, values in ((slope, slopes), (own_slope, alone_slopes)):
                        into[of, k] = values[:, smooth.index(name)].reshape(len(of), -1)
                    continue
                moved = view[of]
                moved[:, VIEW.index(name)] += STEP
                width = (moved - view[of])[:, VIEW.index(name)]
                there, _, own_there, _ = self._rendered(c, moved, of, (), split=splits)
                for into, end, start in ((slope, there, phasor), (own_slope, own_there, own_phasor)):
                    into[of, k] = (end.phasor.reshape(len(of), -1) - start[of]) / width[:, None]
        if self._factored and "delta_rad" in free:  # a body of revolution looks the same from every side
            level, first = ~view[:, 3:].any(axis=1), self.sensor.lower_rows[0] * self.sensor.cols
            for values in (slope, own_slope):
                values[level, list(free).index("delta_rad"), :first] = 0
        if not splits:
            return ModelImages(phasor, slope, intensity, coverage)
        return ModelImages(phasor, slope, intensity, coverage, phasor - own_phasor, slope - own_slope)

    def first_images(
        self, class_index: NDArray[np.int64], view: NDArray[np.float64], free: Sequence[str]
    ) -> ModelImages:
        """Return images as :meth:`images` does, rendered only where no frame before has asked for them."""
        each = zip(class_index, view, self._behind(np.arange(len(view))), strict=True)
        keys = [(int(c), own.tobytes(), tuple(free), background) for c, own, background in each]
        place = {key: k for k, key in enumerate(keys)}  # of one that asks for it
        found = {key: self.cache.get(key) for key in place}
        missing = [k for key, k in place.items() if found[key] is None]
        model = self if self._frame is None else self.of_frames(self._frame[missing])
        new = model.images(class_index[missing], np.ascontiguousarray(view[missing]), free)
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
            image = self._render(c, view[of], of, rows)
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
        """Render both ends, those of all parameters that change the same rows at once.

        Of one view those of all parameters: a call costs more than rows that do not change.
        """
        slope = np.zeros((len(view), len(free), self.sensor.rows * self.sensor.cols), np.complex128)
        for c in np.unique(class_index):
            of = np.flatnonzero(class_index == c)
            together: dict[tuple[int, int] | None, list[int]] = {}
            for k, name in enumerate(free):
                together.setdefault(self._changing_rows(name, view[of])[0] if len(of) > 1 else None, []).append(k)
            for rows, own in together.items():
                ends = np.tile(view[of], (2 * len(own), 1, 1))
                axes = [VIEW.index(free[k]) for k in own]
                for j, (k, axis) in enumerate(zip(own, axes, strict=True)):
                    width = np.maximum(step[of, k], STEP)
                    ends[2 * j, :, axis] += width
                    ends[2 * j + 1, :, axis] -= width
                moved, each = ends.reshape(-1, len(VIEW)), np.tile(of, 2 * len(own))
                self.clip(moved, each)
                phasor = self._render(c, moved, each, rows).phasor.reshape(len(ends), len(of), -1)
                for j, (k, axis) in enumerate(zip(own, axes, strict=True)):
                    width = np.maximum(ends[2 * j, :, axis] - ends[2 * j + 1, :, axis], STEP)
                    first = self._changing_rows(free[k], view[of])[1]
                    there = phasor[2 * j : 2 * j + 2, :, first if rows is None else 0 :]
                    slope[of, k, first:] = (there[0] - there[1]) / width[:, None]
        return slope

    def differences(
        self, class_index: NDArray[np.int64], view: NDArray[np.float64], moves: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """Render both ends."""
        m, k = moves.shape[:2]
        ends = np.concatenate([view[:, None] + moves, view[:, None] - moves], axis=1)
        phasor = np.empty((m, 2 * k, self.sensor.rows * self.sensor.cols), np.complex128)
        for c in np.unique(class_index):
            of = np.flatnonzero(class_index == c)
            moved, each = ends[of].reshape(-1, len(VIEW)), np.repeat(of, 2 * k)
            self.clip(moved, each)
            phasor[of] = self._render(c, moved, each).phasor.reshape(len(of), 2 * k, -1)
        return np.asarray((phasor[:, :k] - phasor[:, k:]) / 2)

    def _changing_rows(self, name: str, view: NDArray[np.float64]) -> tuple[tuple[int, int] | None, int]:
        """Return the rows that a parameter changes, None for all, and their first pixel.

        A body of revolution looks the same from every side.
        """
        if self._factored and name == "delta_rad" and not view[:, 3:].any():
            return self.sensor.lower_rows, self.sensor.lower_rows[0] * self.sensor.cols
        return None, 0

    def _rendered(
        self,
        class_index: int,
        view: NDArray[np.float64],
        which: NDArray[np.integer],
        free: Sequence[str],
        *,
        split: bool,
    ) -> SplitImages:
        """Return images and their slopes, and the same of the landmark alone; twice the same unless light is split."""
        renderer, views = self._renderers[class_index], Views(*np.ascontiguousarray(view.T))
        background = self._given_way(class_index, views, which)
        if split:
            return renderer.render_split(views, free, background=background)
        if free:
            image, slope = renderer.render_with_slopes(views, free, background=background)
        else:
            image = renderer.render_views(views, background=background)
            slope = np.empty((len(view), 0, *image.phasor.shape[1:]), np.complex128)
        return image, slope, image, slope

    def _render(
        self,
        class_index: int,
        view: NDArray[np.float64],
        which: NDArray[np.integer],
        rows: tuple[int, int] | None = None,
    ) -> PhasorImages:
        renderer, views = self._renderers[class_index], Views(*np.ascontiguousarray(view.T))
        background = self._given_way(class_index, views, which)
        if self._factor is None:
            return renderer.render_views(views, background=background, rows=rows)
        image, _, alone, _ = renderer.render_split(views, (), background=background, rows=rows)
        more = (self._factor[which] - 1).reshape(-1, *[1] * (image.phasor.ndim - 1))
        return replace(image, phasor=image.phasor + more * alone.phasor)

    def _behind(self, which: NDArray[np.integer]) -> list[Background | None]:
        """Return the backgrounds of some of the views."""
        if self._frame is None:
            return [self._backgrounds[0]] * len(which)
        return [self._backgrounds[k] for k in self._frame[which]]

    def _given_way(self, class_index: int, views: Views, which: NDArray[np.integer]) -> Backgrounds:
        """Return the backgrounds of some views, walls and floors that the landmark would reach through moved back.

        Floors are estimated, and heights are tried. So are sides of a landmark whose far end then reaches a wall.
        """
        farthest_m, circle_m = views.distance_m.max(), self._footprint.radius_m
        may_be_cut = max(farthest_m, circle_m + BEFORE_LENS_M) + circle_m + _BEFORE_WALL_M > self._wall_m.min()
        if not self._floors and not may_be_cut:
            return self._backgrounds[0] if self._frame is None else self._behind(which)
        nearest, farthest = self.limits(views.delta_rad, which)
        cut = np.isfinite(self._wall_m).any() & ((nearest > farthest) | (views.distance_m > farthest))
        landmark, seen = self._renderers[class_index].footprint, views.in_camera(self.sensor)
        behind, least_m = self._behind(which), -(landmark.lowest_m + seen.height_m)
        for k, own in enumerate(behind):
            if own is not None and (cut[k] or (own.floor_m is not None and own.floor_m < least_m[k])):
                behind[k] = own.giving_way(landmark, seen[np.array([k])])
        return behind
