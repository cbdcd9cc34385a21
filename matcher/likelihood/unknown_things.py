"""The last fit where unknown things stand in view: without the pixels at their borders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.estimate.fits import Fits, distinct_of_frames, least_of_frame, with_refined
from phasemark.matcher.likelihood.images import ImageModel
from phasemark.matcher.likelihood.refine import refine
from phasemark.matcher.likelihood.residuals import STRANGE_SIGMA, Evidence, range_residuals, range_slopes
from phasemark.matcher.likelihood.scenes import Scene
from phasemark.matcher.likelihood.setup import Setup
from phasemark.matcher.pixel_agreement import beside

__all__ = ["fit_without_borders"]


def fit_without_borders(scene: Scene, evidence: Evidence, fits: Fits) -> Fits:
    """Fit the best views again without the pixels beside one that sees something else.

    They may see a little of it too, at the sides of the landmark, where a wrong range turns the view most. Views of
    one frame are compared on the same pixels: those that are beside something else in none of them. How pixels scatter
    among unknown things is known less well than otherwise: covariances grow with the χ² found. Where none are expected,
    and of zones, which show one surface each, fits are left as they are.
    """
    setup = scene.setup
    if not setup.unknown or setup.reports_one_surface:
        return fits
    policy, model = setup.policy, scene.final
    least = least_of_frame(fits, len(evidence.weight))
    close = np.isfinite(fits.cost) & (fits.cost < least[fits.frame] + policy.margin_cost)
    close &= fits.explained >= setup.rules.fewest_explained
    modes = distinct_of_frames(fits, np.flatnonzero(close), setup.rules.symmetry)
    some = fits[modes]
    kept = np.ones_like(evidence.seen.returned)
    np.logical_and.at(kept, some.frame, _inside(setup, model, evidence, some))
    inside_evidence = replace(evidence, weight=evidence.weight * kept)
    again = refine(model, inside_evidence, some, scene.settings())
    again = again.with_scale(_scatter_of_columns(setup, model, inside_evidence, again))
    # fits that are not refined again cost less by as much as the best of their frame: its pixels were left out
    return with_refined(fits, modes, again, len(least))


def _inside(setup: Setup, model: ImageModel, evidence: Evidence, fits: Fits) -> NDArray[np.bool_]:
    """Return which pixels are not beside one that sees something else than some views, (m, pixels)."""
    frame = fits.frame
    phasor = model.of_frames(frame).images(fits.class_index, np.ascontiguousarray(fits.view), ()).phasor
    size = np.sqrt(evidence.weight[frame]) * np.abs(range_residuals(phasor, evidence, frame))
    returned = evidence.seen.returned[frame]
    other = returned & ((phasor == 0) | (size > STRANGE_SIGMA))
    shape = (-1, evidence.sensor.rows, evidence.sensor.cols)
    kept = np.ones(other.shape, np.bool_)
    for strange in (other, other | ~returned):  # beside pixels without a return too, where enough are left
        inside = ~beside(strange.reshape(shape)).reshape(other.shape) | other
        enough = (inside & returned & ~other).sum(axis=1) >= setup.rules.fewest_explained
        kept[enough] = inside[enough]
    return kept


def _scatter_of_columns(setup: Setup, model: ImageModel, evidence: Evidence, fits: Fits) -> NDArray[np.float64]:
    """Return by how much covariances of views are too small, (m,): from χ², and from leaving out columns of pixels.

    Errors at the sides of a landmark are common to a column of pixels. The view changes by δθ_c without column c;
    the jackknife's covariance (C − 1) / C · Σ δθ_c δθ_cᵀ over C columns is compared with that of independent noise.
    """
    rows, cols = evidence.sensor.rows, evidence.sensor.cols
    m, p = len(fits), len(setup.free)
    model = model.of_frames(fits.frame)
    image = model.images(fits.class_index, np.ascontiguousarray(fits.view), setup.free)
    slope = range_slopes(image.phasor, image.slope, evidence.sensor)
    residual = range_residuals(image.phasor, evidence, fits.frame)
    weight = np.where(image.phasor != 0, evidence.weight[fits.frame], 0.0)
    weight = np.where(weight * residual**2 > STRANGE_SIGMA**2, 0.0, weight)
    by_column = (m, p, rows, cols)
    weighted = (slope * weight[:, None]).reshape(by_column)
    gradient = np.einsum("mprc,mrc->mcp", weighted, residual.reshape(m, rows, cols))
    information = np.einsum("mprc,mqrc->mcpq", weighted, slope.reshape(by_column))
    whole = information.sum(axis=1)
    used = (weight.reshape(m, rows, cols) > 0).any(axis=1)
    shift = np.einsum("mcpq,mcq->mcp", np.linalg.pinv(whole[:, None] - information, hermitian=True), gradient)
    n = np.maximum(used.sum(axis=1), 2)
    jackknife = np.einsum("mcp,mcq,mc->mpq", shift, shift, used) * ((n - 1) / n)[:, None, None]
    by_columns = np.einsum("mpq,mqp->m", whole, jackknife) / p
    by_chi2 = fits.tested / np.maximum(fits.dof, 1)
    return np.asarray(np.maximum(1.0, np.maximum(by_columns, by_chi2)))
