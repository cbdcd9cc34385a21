"""Reports as one HTML page that loads nothing: the frame all of them share, pictures inside it, numbers in tables."""

from __future__ import annotations

import base64
import math
import re
from typing import TYPE_CHECKING

import jinja2
from markupsafe import Markup

from phasemark.render import png

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def page_template(package: str, name: str) -> jinja2.Template:
    """Return a template of a package; it may extend ``base.html.j2``, which has the style, a title and a content block.

    Its filter ``number`` is :func:`short_number`, and ``anchor`` makes the name of a heading that links lead to.
    ``macros.html.j2`` has the parts that pages share.
    """
    loader = jinja2.ChoiceLoader([jinja2.PackageLoader(one, ".") for one in (package, "phasemark.data.pages")])
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters["number"] = short_number
    environment.filters["anchor"] = _anchor
    return environment.get_template(name)


def figure_png(figure: Figure) -> bytes:
    """Return a figure as PNG, 110 dots an inch; its layout is computed once, and stays."""
    engine = figure.get_layout_engine()
    dpi = 110
    if engine is not None:
        figure.set_dpi(dpi)
        engine.execute(figure)
        figure.set_layout_engine(None)  # or saving computes it once more in vain
    return png.figure_png(figure, dpi=dpi)


def embedded_png(png: bytes, alternative: str) -> Markup:
    """Return an image element that holds a PNG; `alternative` says in words what it shows."""
    return Markup('<img alt="{}" src="data:image/png;base64,{}">').format(alternative, base64.b64encode(png).decode())


def _anchor(title: str) -> str:
    """Return a title as the name of an anchor."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def short_number(value: float) -> str:
    """Write a number with as many digits as it deserves in a table."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"
