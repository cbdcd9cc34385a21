"""Variance components: a linear problem with random errors of frames, and of blocks of frames.

With the residuals r linear in common parameters (slopes J) and in errors of each frame and of each block of frames
(slopes S, independent, normal, of sizes s), all whitened by the noise of pixels, r is normal with a covariance V, and
the sizes are those of the greatest restricted likelihood (Patterson & Thompson 1971),

    −2 log L = rᵀ V⁻¹ r + aᵀ P a − gᵀ H⁻¹ g + log det V + log det H − log det P ,

with H = Jᵀ V⁻¹ J + P, g = Jᵀ V⁻¹ r + P a and a prior of precision P whose mean is a away. It allows for the parameters
having been fitted to the same residuals. V falls apart into blocks, and errors are eliminated frame by frame, so that
the cost is linear in the number of frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_Float = NDArray[np.float64]


class Marginal(NamedTuple):
    """Problem of the common parameters alone, the errors of frames and blocks eliminated."""

    information: _Float
    """(P, P)."""
    gradient: _Float
    """(P,)."""
    quadratic: float
    """rᵀ V⁻¹ r."""
    log_det: float
    """Logarithm of the determinant of V, of whitened residuals."""


@dataclass(frozen=True, eq=False)
class RandomEffects:
    """Gram matrices of a linear problem with random errors, whitened by the noise of pixels.

    Parameters
    ----------
    jj : (blocks, P, P) float64
    jr : (blocks, P) float64
    js : (K, P, E) float64
    ss : (K, E, E) float64
    sr : (K, E) float64
    rr : float
    start : (blocks,) int64
        First frame of each block.
    """

    jj: _Float
    jr: _Float
    js: _Float
    ss: _Float
    sr: _Float
    rr: float
    start: NDArray[np.int64]

    @classmethod
    def of_frames(cls, j: _Float, s: _Float, r: _Float, start: NDArray[np.int64] | None = None) -> RandomEffects:
        """Take whitened slopes (K, P, R) and (K, E, R) and residuals (K, R); without `start` frames share no block."""
        first, st = np.arange(len(r)) if start is None else start, s.transpose(0, 2, 1)
        jj, jr = j @ j.transpose(0, 2, 1), np.einsum("kpr,kr->kp", j, r)
        jj, jr = (np.add.reduceat(each, first, axis=0) for each in (jj, jr))
        return cls(jj, jr, j @ st, s @ st, np.einsum("ker,kr->ke", s, r), float((r**2).sum()), first)

    def marginal(self, frame: _Float, block: _Float | None = None, keep: NDArray[np.bool_] | None = None) -> Marginal:
        """Eliminate the errors of frames and blocks.

        Parameters
        ----------
        frame, block : (E,) float64
            Sizes of the errors of frames and of blocks; None: blocks have none.
        keep : (blocks,) bool, optional
            Blocks that enter.
        """
        every = np.ones(len(self.start), bool) if keep is None else keep
        counts = self._counts
        frames = np.repeat(every, counts)
        js, ss, sr = self.js[frames], self.ss[frames], self.sr[frames]
        solved, log_det = _shrunk(ss, frame)
        js_e = js @ solved
        information = self.jj[every].sum(axis=0) - _summed(js_e, js)
        e_sr = np.einsum("kij,kj->ki", solved, sr)
        gradient = self.jr[every].sum(axis=0) - np.einsum("kpi,ki->p", js, e_sr)
        quadratic = self.rr - float(np.einsum("ki,ki->", sr, e_sr))
        if block is not None and block.any():
            start = np.concatenate([[0], np.cumsum(counts[every])[:-1]])
            of_block = np.add.reduceat(js - js_e @ ss, start, axis=0)
            solved_b, log_b, pull = self._of_blocks(ss, solved, sr - np.einsum("kij,kj->ki", ss, e_sr), start, block)
            information = information - _summed(of_block @ solved_b, of_block)
            pulled = np.einsum("bij,bj->bi", solved_b, pull)
            gradient = gradient - np.einsum("bpi,bi->p", of_block, pulled)
            quadratic -= float(np.einsum("bi,bi->", pull, pulled))
            log_det += log_b
        return Marginal(information, gradient, quadratic, log_det)

    def errors(self, step: _Float, frame: _Float, block: _Float | None = None) -> _Float:
        """Return the estimated errors of each frame, with that of its block, after a step of the parameters, (K, E)."""
        sr = self.sr - np.einsum("kpi,p->ki", self.js, step)
        solved, _ = _shrunk(self.ss, frame)
        own = np.einsum("kij,kj->ki", solved, sr)
        if block is None or not block.any():
            return np.asarray(own)
        left = sr - np.einsum("kij,kj->ki", self.ss, own)
        solved_b, _, pull = self._of_blocks(self.ss, solved, left, self.start, block)
        common = np.repeat(np.einsum("bij,bj->bi", solved_b, pull), self._counts, axis=0)
        own = np.einsum("kij,kj->ki", solved, sr - np.einsum("kij,kj->ki", self.ss, common))
        return np.asarray(own + common)

    def error_covariance(self, size: _Float) -> _Float:
        """Return the covariance of each frame's errors of some size under what its residuals tell, (K, E, E)."""
        return _shrunk(self.ss, size)[0]

    def minus_two_log(
        self, frame: _Float, block: _Float | None = None, prior: tuple[_Float, _Float] | None = None
    ) -> float:
        """Return −2 log of the restricted likelihood of some sizes, but for a constant.

        Parameters
        ----------
        frame, block
            As for :meth:`marginal`.
        prior : (precision, away), optional
            (P,) each: of the parameters, and how far its mean is from the place.
        """
        matrix, pull, quadratic, log_det = self.marginal(frame, block)
        if prior is not None:
            precision, away = prior
            matrix, pull = matrix + np.diag(precision), pull + precision * away
            quadratic += float(precision @ away**2) - float(np.log(precision).sum())
            found = np.linalg.solve(matrix, pull)
        else:
            found = np.linalg.lstsq(matrix, pull, rcond=None)[0]  # residuals may leave a direction unknown
        return float(quadratic - pull @ found + log_det + np.linalg.slogdet(matrix)[1])

    @property
    def _counts(self) -> NDArray[np.int64]:
        return np.diff(np.append(self.start, len(self.js)))

    @staticmethod
    def _of_blocks(
        ss: _Float, solved: _Float, left: _Float, start: NDArray[np.int64], size: _Float
    ) -> tuple[_Float, float, _Float]:
        """Return the result of :func:`_shrunk` for the blocks, and the pull on the error of each."""
        gram = np.add.reduceat(ss - ss @ solved @ ss, start, axis=0)
        return *_shrunk(gram, size), np.add.reduceat(left, start, axis=0)


def _summed(a: _Float, b: _Float) -> _Float:
    """Return the sum over k of a_k b_kᵀ, in products too small for a BLAS to spread them over busy processors."""
    chunk = 10  # frames in one matrix product
    n = -(-len(a) // chunk)

    def chunks(one: _Float) -> _Float:
        whole = np.zeros((n * chunk, *one.shape[1:]))  # np.pad takes as long as the products
        whole[: len(one)] = one
        shaped = whole.reshape(n, chunk, one.shape[1], one.shape[2])
        return np.ascontiguousarray(shaped.transpose(0, 2, 1, 3)).reshape(n, one.shape[1], -1)

    return np.asarray((chunks(a) @ chunks(b).transpose(0, 2, 1)).sum(axis=0))


def _shrunk(gram: _Float, size: _Float) -> tuple[_Float, float]:
    """Return L (1 + L G L)⁻¹ L for each Gram matrix G with L = diag(size), and the sum of log det(1 + L G L)."""
    middle = np.eye(len(size)) + size[:, None] * gram * size
    solved = size[:, None] * np.linalg.inv(middle) * size
    return solved, float(np.linalg.slogdet(middle)[1].sum())
