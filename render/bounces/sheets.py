"""A wall and the strip of floor before it, in columns and rows: few patches, small where they meet."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.render.bounces.form_factors import triangle_form_factors

_COLS, _ROWS = 20, 12
"""Columns, and rows of each of wall and strip."""
_AROUND = 1.3
"""How far the patches reach beyond the lamp's light."""
_MARGIN_M, _WIDEST_RAD = 0.3, math.radians(60.0)
_DEEPEST_M, _SHARE, _LEAST_M = 1.0, 0.6, 0.02
"""Depth of the strip: at most, as a share of the gap between landmark and wall, and at least."""
_NARROWER = 2.0
"""By how much columns in the middle, where the landmark's shadow ends, are narrower than evenly spaced ones."""
_RAYS = 4
"""Points a side of a patch at which the lamp's light is taken."""


class Sheets(NamedTuple):
    """Patches of a wall, and of the floor before it where there is one.

    Parameters
    ----------
    across : (c,) float64
        Middles of the columns, to the left as the lamp looks, m from the line to the landmark's axis.
    height : (r,) float64
        Middles of the wall's rows, above the lens.
    before : (s,) float64
        Middles of the strip's rows, m before the wall; none without a floor.
    depth_m : float
        Of the strip.
    centre, normal : (w, 3) float64
        Landmark frame; first the wall's, column by column.
    wide, tall : (w, 3) float64
        Sides of the patches.
    area : (w,) float64
    """

    across: NDArray[np.float64]
    height: NDArray[np.float64]
    before: NDArray[np.float64]
    depth_m: float
    centre: NDArray[np.float64]
    normal: NDArray[np.float64]
    wide: NDArray[np.float64]
    tall: NDArray[np.float64]
    area: NDArray[np.float64]

    @property
    def n_wall(self) -> int:
        """Number of patches of the wall, which come first."""
        return len(self.across) * len(self.height)

    @classmethod
    def behind(
        cls,
        lens: NDArray[np.float64],
        delta_rad: float,
        wall_m: float,
        floor_m: float,
        gap_m: float,
        lamp_half_angle_rad: float,
    ) -> Sheets:
        """Return the sheets of one view.

        Parameters
        ----------
        lens : (3,) float64
            Landmark frame.
        delta_rad : float
        wall_m, floor_m : float
            From the lens; 0: no floor.
        gap_m : float
            Between landmark and wall.
        lamp_half_angle_rad : float
        """
        reach = _AROUND * wall_m * math.tan(min(lamp_half_angle_rad, _WIDEST_RAD)) + _MARGIN_M
        ahead = np.array([math.cos(delta_rad), math.sin(delta_rad), 0.0])
        left, up = np.array([-ahead[1], ahead[0], 0.0]), np.array([0.0, 0.0, 1.0])
        foot = lens + wall_m * ahead
        share = np.linspace(-1.0, 1.0, _COLS + 1)
        columns = reach * share * (1 + _NARROWER * share**2) / (1 + _NARROWER)
        rise = np.linspace(0.0, 1.0, _ROWS + 1)
        low = -floor_m if floor_m else -reach
        sheets = [(low + (reach - low) * (rise**2 if floor_m else rise), foot, up, -ahead)]
        depth = float(np.clip(_SHARE * gap_m, _LEAST_M, _DEEPEST_M)) if floor_m else 0.0
        if floor_m:
            sheets.append((depth * rise**2, foot - floor_m * up, -ahead, up))
        parts = []
        for rows, origin, along, normal in sheets:
            middle = 0.5 * (rows[1:] + rows[:-1])
            y, z = (grid.ravel() for grid in np.meshgrid(0.5 * (columns[1:] + columns[:-1]), middle, indexing="ij"))
            centre = origin + y[:, None] * left + z[:, None] * along
            tall = np.tile(np.diff(rows), _COLS)[:, None] * along
            parts.append((middle, centre, np.tile(normal, (len(y), 1)), tall))
        centre, normal, tall = (np.concatenate(column) for column in list(zip(*parts, strict=True))[1:])
        width = np.tile(np.repeat(np.diff(columns), _ROWS), len(sheets))
        return cls(
            0.5 * (columns[1:] + columns[:-1]),
            parts[0][0],
            parts[1][0] if floor_m else np.empty(0),
            depth,
            centre,
            normal,
            width[:, None] * left,
            tall,
            width * np.linalg.norm(tall, axis=1),
        )

    def points(self) -> NDArray[np.float64]:
        """Return points that fill each patch evenly, (w, 16, 3)."""
        side = (np.arange(_RAYS) + 0.5) / _RAYS - 0.5
        y, z = (grid.ravel()[:, None] for grid in np.meshgrid(side, side))
        return np.asarray(self.centre[:, None] + y * self.wide[:, None] + z * self.tall[:, None])

    def between(self) -> NDArray[np.float64]:
        """Return the share of the light of each patch's hemisphere that comes from each other one, (w, w)."""
        n, w = self.n_wall, len(self.area)
        out = np.zeros((w, w))
        for receivers, senders in ((slice(0, n), slice(n, w)), (slice(n, w), slice(0, n))):
            p, q = (np.arange(w)[part] for part in (receivers, senders))
            if not (len(p) and len(q)):
                continue
            pairs = np.repeat(p, len(q)), np.tile(q, len(p))
            half = 0.5 * self.wide[pairs[1]], 0.5 * self.tall[pairs[1]]
            centre = self.centre[pairs[1]]
            corners = [centre + a * half[0] + b * half[1] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            turned = np.cross(half[0][0], half[1][0]) @ self.normal[q[0]] < 0
            corners = corners[::-1] if turned else corners
            share = np.zeros(len(pairs[0]))
            for k in (1, 2):
                triangles = np.stack([corners[0], corners[k], corners[k + 1]], axis=1)
                share += triangle_form_factors(self.centre[pairs[0]], self.normal[pairs[0]], triangles)
            out[receivers, senders] = share.reshape(len(p), len(q))
        return out

    def interpolated(
        self, values: NDArray[np.complex64], across: NDArray[np.float64], along: NDArray[np.float64], *, strip: bool
    ) -> NDArray[np.complex128]:
        """Return values at patches (w,) of wall or strip, linearly between their middles.

        Parameters
        ----------
        values : (w,) complex64
        across : (m,) float64
            To the left as the lamp looks.
        along : (m,) float64
            Above the lens, or before the wall.
        strip : bool
            The strip's, and not the wall's.
        """
        rows = self.before if strip else self.height
        own = values[self.n_wall :] if strip else values[: self.n_wall]
        grid = own.reshape(len(self.across), len(rows))
        (i, s), (j, t) = _between(self.across, across), _between(rows, along)
        low = (1 - t) * grid[i, j] + t * grid[i, j + 1]
        high = (1 - t) * grid[i + 1, j] + t * grid[i + 1, j + 1]
        return np.asarray((1 - s) * low + s * high)


def _between(grid: NDArray[np.float64], at: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return which step of a rising grid places lie in, and how far along it; beyond the ends: the last step's line."""
    low = np.clip(np.searchsorted(grid, at) - 1, 0, len(grid) - 2)
    return low, (at - grid[low]) / (grid[low + 1] - grid[low])
