"""Figures as PNG."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # matplotlib takes half a second to load
    from matplotlib.figure import Figure


def figure_png(figure: Figure, *, dpi: float = 90) -> bytes:
    """Return a figure as a PNG.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    dpi : float
        Pixels an inch.

    Returns
    -------
    bytes
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()
