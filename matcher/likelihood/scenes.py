"""Scenes of a matcher: before each background the images of landmarks, and the cells of the bank that are searched."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.frequencies import background_of, layers_of
from phasemark.matcher.likelihood.bank_images import BankModel
from phasemark.matcher.likelihood.images import VIEW, ImageModel
from phasemark.matcher.likelihood.problem import DescentSettings
from phasemark.matcher.likelihood.rendered_images import RenderedModel
from phasemark.matcher.likelihood.setup import Setup
from phasemark.matcher.likelihood.strip_images import StripModel
from phasemark.matcher.nearest.bank_minima import Search, Upward
from phasemark.matcher.nearest.cells import WIDE_PIXEL_RAD, CellBounds, Turned
from phasemark.matcher.nearest.grid import CELL_M, CELL_RAD, first_step
from phasemark.matcher.pixel_agreement import PERHAPS, counts
from phasemark.render import Background, PhasorImages, Renderer, Views

__all__ = ["Scene", "Scenes"]

_FINE_GRID, _COARSE_GRID = (0.011, math.radians(1.1)), (0.022, math.radians(2.2))
"""Widest steps of a bank, metres and radians, on which interpolated images may be the answer, and on which they lead to
it."""
_ALBEDO_RATIOS = 1 / 8, 8.0
"""Factors on a landmark's brightness beside the background's between which it is looked for where it is free."""
_SHARES_OF_COLUMN = -0.5, -0.25, 0.25, 0.5


@dataclass(frozen=True, eq=False)
class Scene:
    """Background of some frames with the image models and searches that include it.

    Parameters
    ----------
    setup : Setup
    behind : PhasorImages, optional
        Image of the background without a landmark, one for all frames, or one for each; None: nothing is there.
    final : ImageModel
        What the answer is taken from.
    scout : ImageModel, optional
        What finds the way to it where that is slow.
    search : Search
        Minima of the bank.
    closed_search : callable, optional
        Returns the search of one frame, by its number, before what stands behind the landmark there, where that of all
        leaves it open, in some rows of cells at least, (class, D); None where it does not.
    """

    setup: Setup
    behind: PhasorImages | None
    final: ImageModel
    scout: ImageModel | None
    search: Search
    closed_search: Callable[[int, NDArray[np.bool_]], Search] | None = None

    @property
    def strips(self) -> StripModel | None:
        """The scout, if it is made of strips."""
        return self.scout if isinstance(self.scout, StripModel) else None

    def settings(self) -> DescentSettings:
        """Return how a descent runs before these backgrounds."""
        setup, phasor, returns = self.setup, None, None
        if (behind := self.behind) is not None:
            shape = len(behind.phasor), -1
            phasor = behind.phasor.reshape(shape)
            returns = counts(behind.phasor, behind.intensity, behind.sensor, PERHAPS).reshape(shape)
        return DescentSettings(
            setup.free,
            setup.used,
            setup.huber,
            phasor,
            prior_std=setup.prior_std,
            unknown_around=setup.unknown,
            boards=setup.boards if setup.unknown else (),
            returns_behind=returns,
            around=None if setup.reports_one_surface else self.strips,
            albedo_std=0.0 if behind is None else setup.albedo_std,
            policy=setup.policy,
        )


class Scenes:
    """Scenes of a matcher, before the background that is stated and before others.

    Parameters
    ----------
    setup : Setup
    workers : int
        Threads that make the cells of a bank.
    like : Scenes, optional
        Of the same bank with another prior: their cells and renderers are used.

    Attributes
    ----------
    rendered : RenderedModel
        What renders the landmarks of the bank, made when it is first needed.
    stated : Scene
        Before the background that is stated, or nothing.
    search, open_search : Search
        Its search, and one that leaves open what stands behind the landmark where this is estimated.

    Raises
    ------
    UsageError
        The bank has no distances at which views are rendered, or a landmark reaches below the floor.
    """

    def __init__(self, setup: Setup, workers: int, like: Scenes | None = None) -> None:
        self._setup, self._bank, self._workers, self._like = setup, setup.bank, workers, like
        behind = background_of(setup.bank, setup.stated) if setup.stated is not None else None
        cells = self.cells(behind, workers=workers) if like is None else like.search.cells
        self.search: Search = self._search_in(cells)
        self.open_search: Search = self.search
        if setup.auto:
            open_cells = self.cells(None, open_edges=True) if like is None else like.open_search.cells
            self.open_search = self.search.before(open_cells)
        interpolated, self._scout = self._bank_models(behind)
        self.interpolates = interpolated is not None
        final, scout = (interpolated, None) if interpolated else (self.rendered, self._scout)
        self.stated = Scene(setup, behind, final, scout, self.search)
        if setup.auto or interpolated is None:
            self._check_distances()
        if setup.stated is not None and setup.stated.floor_m is not None and "height_m" not in setup.free:
            self._check_floor(setup.stated.floor_m)

    def before(self, backgrounds: Sequence[Background]) -> Scene:
        """Return the scene of the backgrounds of some frames, whose search leaves out what sees the background.

        Parameters
        ----------
        backgrounds : sequence of Background
            One for each frame; empty: nothing is behind the landmark.
        """
        if not backgrounds:
            return self.stated
        behind = background_of(self._bank, *backgrounds)

        def closed_search(k: int, only: NDArray[np.bool_]) -> Search:
            return self.search.before(self.cells(background_of(self._bank, backgrounds[k]), only=only))

        return replace(
            self.stated,
            behind=behind,
            final=self.rendered.with_background(*backgrounds),
            scout=self._scout.before(behind) if isinstance(self._scout, BankModel) else None,
            search=self.open_search,
            closed_search=closed_search if self._bank.is_open else None,
        )

    def whole_before(self, backgrounds: Sequence[Background]) -> Scene:
        """Return one whose search compares all pixels, since what was taken for background may be landmark.

        Images of the bank are made before each background.
        """
        search = self.search.before(*(self.cells(background_of(self._bank, own)) for own in backgrounds))
        return replace(self.before(backgrounds), search=search, closed_search=None)

    def on_rendered(self) -> Scene:
        """Return the scene that is stated, with answers from rendered images."""
        return replace(self.stated, final=self.rendered, scout=self._scout)

    def open(self) -> Scene:
        """Return the scene without a background whose search leaves open whether there is one."""
        return replace(self.stated, search=self.open_search, closed_search=lambda *_: self.search)

    def tilted(self, tilt_rad: NDArray[np.float64] | None = None) -> Scene:
        """Return the scene of tilted frames, whose views are rendered: those of a bank are level.

        Parameters
        ----------
        tilt_rad : (n, 2) float64, optional
            Pitch and roll of frames that are searched.
        """
        search = self.search if tilt_rad is None else self._search_of_tilted.tilted(tilt_rad)
        return replace(self.stated, final=self.rendered, scout=None, search=search)

    @cached_property
    def rendered(self) -> RenderedModel:
        """What renders the landmarks of the bank, made when it is first needed."""
        if self._like is not None:
            return self._like.rendered
        fits_albedo = self._setup.on == "phasors" or self._setup.albedo_std > 0
        splits = fits_albedo and (self._setup.auto or self._setup.stated is not None)
        return RenderedModel(
            self._bank,
            self._setup.stated,
            self._setup.policy.cache_bytes,
            splits_light=splits,
            reported=self._setup.reports_one_surface,
        )

    @cached_property
    def _turned(self) -> Turned | None:
        """What renders views of the bank at bearings within half a column, where pixels are wide.

        Before backgrounds that are estimated cells are made for every frame: then the views are kept.
        """
        if self._like is not None:
            return self._like._turned
        if self._bank.sensor.pixel_rad <= WIDE_PIXEL_RAD:
            return None
        known: dict[tuple[int, float, int], list[PhasorImages]] = {}
        if self._setup.reports_one_surface:  # as the bank has them
            meshes = [self._bank.mesh(name) for name in self._bank.classes]
            light = [Renderer(mesh, self._bank.sensor, albedo=float(mesh.metadata["albedo"])) for mesh in meshes]
        else:
            light = [self.rendered.renderer(c) for c in range(len(self._bank.classes))]

        def turned(class_index: int, distance_m: float, delta_rad: NDArray[np.float64]) -> list[PhasorImages]:
            key = class_index, distance_m, len(delta_rad)
            if key in known:
                return known[key]
            renderer, width_rad = light[class_index], self._bank.sensor.pixel_rad
            images = [renderer.render(distance_m, delta_rad, share * width_rad) for share in _SHARES_OF_COLUMN]
            if self._setup.auto:
                known[key] = images
            return images

        return turned

    def _bank_models(self, behind: PhasorImages | None) -> tuple[BankModel | None, BankModel | StripModel | None]:
        """Return interpolated images that an answer may be taken from, and those of a scout; None where unfit."""
        setup = self._setup
        fixed = setup.free == VIEW[:2]
        alone = setup.on == "ranges" and self._setup.stated is None
        chip = setup.reports_one_surface  # its ranges jump between the nodes of a bank, and its strips need no tilt
        fine = fixed and alone and not chip and BankModel.grid_is_fine_enough(self._bank, *_FINE_GRID)
        interpolates = fine and not (setup.auto or setup.huber is not None)
        level = setup.free in (VIEW[:2], VIEW[:3]) or (chip and "height_m" not in setup.free)
        has_strips = alone and level and not (interpolates or (fine and setup.auto))  # strips have no background
        if has_strips and StripModel.suits(self._bank, self.search.widest_columns):
            return None, StripModel(self._bank, self.search.widest_columns)
        scouts = fixed and BankModel.grid_is_fine_enough(self._bank, *_COARSE_GRID)
        if not (interpolates or scouts):
            return None, None
        model = BankModel(self._bank)
        return model if interpolates else None, model.smooth(behind) if scouts else None

    def check_tilted(self) -> None:
        """Check that tilted frames can be matched."""
        if self._setup.auto or self._setup.stated is not None:
            raise UsageError(
                "frames with a tilt take no wall or floor: leave 'background' out, or give background=\"unknown\""
            )
        self._check_distances()

    def _check_distances(self) -> None:
        """Check that the bank has distances at which views are rendered."""
        nearest, (step_m, step_rad) = self.rendered.limits(self._bank.delta_rad)[0].min(), _FINE_GRID
        if self._bank.distance_m[-1] < nearest:
            raise UsageError(
                f"the bank ends at {self._bank.distance_m[-1]:g} m, and views nearer than {nearest:.3g} m, where the"
                " lens is in the landmark, are not rendered: build it in steps of at most"
                f" {step_m:g} m and {math.degrees(step_rad):.2g}°, and free"
                " distance_m and delta_rad alone without a background"
            )

    def _check_floor(self, floor_m: float) -> None:
        """Check that the landmarks of the bank do not reach below a floor that was stated."""
        view = Views.broadcast(float(self._bank.distance_m[-1])).in_camera(self._bank.sensor)
        for c in range(len(self._setup.rules.names)):
            Background(floor_m=floor_m).check_behind(self.rendered.renderer(c).footprint, view)

    def cells(
        self,
        behind: PhasorImages | None,
        *,
        open_edges: bool = False,
        tilted: bool = False,
        only: NDArray[np.bool_] | None = None,
        workers: int = 1,
    ) -> CellBounds:
        """Return the cells of the bank before some background, for level or for tilted frames."""
        setup, bank = self._setup, self._bank
        return CellBounds(
            bank,
            (max(1, round(CELL_M / first_step(bank.distance_m))), max(1, round(CELL_RAD / first_step(bank.delta_rad)))),
            behind,
            aside=setup.bearing_is_free or tilted,
            upward=not setup.height_and_tilt_are_known or tilted,
            open_edges=open_edges,
            turned=self._turned if setup.bearing_is_free or tilted else None,
            only=only,
            ratios=_ALBEDO_RATIOS if setup.albedo_std > 0 and behind is not None else (),
            workers=workers,
        )

    @cached_property
    def _search_of_tilted(self) -> Search:
        """The search in frames whose tilt is known, made when it is first needed."""
        if self._like is not None:
            return self._search_in(self._like._search_of_tilted.cells)
        return self._search_in(self.cells(None, tilted=True, workers=self._workers))

    def _search_in(self, cells: CellBounds) -> Search:
        """Return a search in some cells, over all bearings that are looked for where they are free."""
        setup, layers = self._setup, layers_of(self._bank)
        return Search(
            cells,
            self._bank.sensor if layers is None else layers.camera,
            layers,
            setup.widest_rad if setup.bearing_is_free else 0.0,
            Upward(setup.prior_std_of("height_m"), setup.prior_std_of("pitch_rad"), setup.policy.prior_sigma),
            setup.prior_std_of("bearing_rad") or math.inf,
        )
