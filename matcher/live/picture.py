"""Picture of a session: zones, residuals and pose, as plain numbers that terminal and page show."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.matcher.live.updates import Update, plain_rows
from phasemark.matcher.position.robot_pose import PRIOR_STD
from phasemark.render import Renderer, Views
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.view import VIEW_FIELDS

__all__ = ["Pictures"]
_MOST_M = PRIOR_STD[0]
"""Residuals beyond this show something else than the landmark."""


class Pictures:
    """Makes pictures of updates.

    Parameters
    ----------
    bank : Bank or None
        Has the landmarks that are rendered beside what was measured; None of a rig among walls.
    """

    def __init__(self, bank: Bank | None) -> None:
        self._bank = bank
        self._renderers: dict[str, Renderer] = {}

    def of(self, update: Update) -> dict[str, Any]:
        """Return zones and residuals, rows from the top, None where there is none, and the pose as JSON has it."""
        found: dict[str, Any] = {
            **update.as_dict(),
            "range_m": plain_rows(update.zones_m.round(4)),
            "residual_mm": None,
        }
        found["poses"] = [[round(share, 4), *pose.round(4).tolist()] for share, pose in update.located.estimate.poses]
        if not update.reason:
            found["std"] = np.sqrt(np.diag(found["covariance"])).tolist()
        match, frames, bank = update.located.match, update.located.filtered, self._bank
        if bank and frames and match and match.class_name is not None and math.isfinite(match.distance_m):
            residual_m = wrap_difference_m(frames.range_m[0] - self._model(bank, match), bank.sensor)
            residual_m = np.where(np.abs(residual_m) > _MOST_M, np.nan, residual_m)
            found["residual_mm"] = plain_rows((1e3 * (residual_m - bank.camera.range_offset_m)).round(4))
            found["class"] = match.class_name
        return found

    def _model(self, bank: Bank, match: Any) -> NDArray[np.float64]:
        """Return the range image of a match's view."""
        name = match.class_name
        if name not in self._renderers:
            mesh = bank.mesh(name)
            self._renderers[name] = Renderer(mesh, bank.sensor, albedo=float(mesh.metadata["albedo"]))
        views = Views.broadcast(*(getattr(match, field) for field in VIEW_FIELDS))
        return np.asarray(self._renderers[name].render_views(views, background=match.background).range_m[0])
