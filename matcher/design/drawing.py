"""A landmark as a drawing for the workshop: one page of SVG, front, side and top view to scale, with dimensions.

Views in first-angle projection: what is seen from the left stands on the right, what is seen from above stands below.
The front is the view of a camera at δ = 0, which looks along x'.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark.landmarks import LandmarkSpec
from phasemark.landmarks.spec import Sphere
from phasemark.matcher.design.rules import upper_outline, upper_size

PAGE_MM = (297.0, 210.0)
"""A4, landscape."""

SCALES = (2.0, 1.0, 0.5, 0.4, 0.25, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005)
"""Preferred scales (ISO 5455, with 1 : 2.5 and 1 : 4)."""

_VIEWS_MM = (118.0, 134.0)
"""What front and side view together may be wide, and front and top view high; the rest is dimensions and title."""
_MARGIN_MM, _GAP_MM, _STEP_MM = 12.0, 22.0, 8.0
_TEXT_X_MM = 205.0

_STYLE = """
text { font-family: "DejaVu Sans", Arial, sans-serif; font-size: 3.2px; fill: #1a1a1a }
.title { font-size: 6.4px; font-weight: bold } .small { font-size: 2.7px }
.caption { font-size: 2.7px; text-anchor: middle }
.outline { fill: #eef2f7; stroke: #1a1a1a; stroke-width: 0.5; stroke-linejoin: round }
.hidden { fill: none; stroke: #1a1a1a; stroke-width: 0.25; stroke-dasharray: 2 1 }
.axis { stroke: #7a7a7a; stroke-width: 0.18; stroke-dasharray: 6 1 1 1; fill: none }
.dim { stroke: #2a5a8a; stroke-width: 0.18; fill: none }
.arrow { fill: #2a5a8a; stroke: none } .value { fill: #2a5a8a; text-anchor: middle }
.frame { fill: none; stroke: #1a1a1a; stroke-width: 0.35 }
"""


@dataclass
class _Page:
    """SVG elements in millimetres of paper, y down."""

    elements: list[str]

    def line(self, kind: str, x0: float, y0: float, x1: float, y1: float) -> None:
        self.elements.append(f'<path class="{kind}" d="M{x0:.3f} {y0:.3f}L{x1:.3f} {y1:.3f}"/>')

    def polygon(self, kind: str, points: NDArray[np.float64], name: str = "") -> None:
        path = "L".join(f"{x:.3f} {y:.3f}" for x, y in points)
        label = f' id="{name}"' if name else ""
        self.elements.append(f'<path class="{kind}"{label} d="M{path}Z"/>')

    def circle(self, kind: str, x: float, y: float, r: float) -> None:
        self.elements.append(f'<circle class="{kind}" cx="{x:.3f}" cy="{y:.3f}" r="{r:.3f}"/>')

    def text(self, x: float, y: float, words: str, kind: str = "", turned: bool = False) -> None:
        turn = f' transform="rotate(-90 {x:.3f} {y:.3f})"' if turned else ""
        name = f' class="{kind}"' if kind else ""
        self.elements.append(f'<text{name} x="{x:.3f}" y="{y:.3f}"{turn}>{html.escape(words)}</text>')

    def across(self, x0: float, x1: float, y: float, from_y: float, words: str) -> None:
        """Draw a horizontal dimension at y, its extension lines from `from_y`."""
        for x in (x0, x1):
            self.line("dim", x, from_y, x, y + math.copysign(1.5, y - from_y))
        self._arrows((x0, y), (x1, y))
        self.text((x0 + x1) / 2, y - 1, words, "value")

    def upright(self, y0: float, y1: float, x: float, from_x: float, words: str) -> None:
        """Draw a vertical dimension at x, its extension lines from `from_x`."""
        for y in (y0, y1):
            self.line("dim", from_x, y, x + math.copysign(1.5, x - from_x), y)
        self._arrows((x, y0), (x, y1))
        self.text(x - 1, (y0 + y1) / 2, words, "value", turned=True)

    def _arrows(self, a: tuple[float, float], b: tuple[float, float]) -> None:
        self.line("dim", *a, *b)
        size = math.dist(a, b)
        if size == 0:
            return
        along = ((b[0] - a[0]) / size, (b[1] - a[1]) / size)
        inside = 1.0 if size > 6 else -1.0  # short dimensions are pointed at from outside
        for (x, y), sign in ((a, inside), (b, -inside)):
            dx, dy = 2.2 * sign * along[0], 2.2 * sign * along[1]
            points = np.array([[x, y], [x + dx - 0.2 * dy, y + dy + 0.2 * dx], [x + dx + 0.2 * dy, y + dy - 0.2 * dx]])
            self.polygon("arrow", points)


def drawing_svg(spec: LandmarkSpec, notes: Sequence[str] = ()) -> str:
    """Draw a landmark on one A4 page, to scale.

    Parameters
    ----------
    spec : LandmarkSpec
        With an upper part.
    notes : sequence of str
        Further lines of the title block.

    Returns
    -------
    str
        SVG, one unit one millimetre of paper.
    """
    assert spec.upper is not None
    box = spec.box
    radius, height = upper_size(spec.upper)
    length, width = (max(1000 * side, 2000 * radius) for side in (box.length_m, box.width_m))
    total = 1000 * (box.height_m + height)
    need = (width + length, total + length)
    scale = next((s for s in SCALES if all(s * n <= f for n, f in zip(need, _VIEWS_MM, strict=True))), SCALES[-1])

    page = _Page([])
    front_x = _MARGIN_MM + 16 + scale * width / 2
    side_x = front_x + scale * (width + length) / 2 + _GAP_MM + 8
    interface_y = _MARGIN_MM + 14 + scale * 1000 * height
    top_y = interface_y + scale * (1000 * box.height_m + length / 2) + _GAP_MM + 4
    _elevation(page, spec, front_x, interface_y, scale, 1000 * box.width_m, "front")
    _elevation(page, spec, side_x, interface_y, scale, 1000 * box.length_m, "side")
    _plan_view(page, spec, front_x, top_y, scale)
    _front_dimensions(page, spec, front_x, interface_y, scale)
    foot_y = interface_y + scale * 1000 * box.height_m
    half = scale * 500 * box.length_m
    page.across(side_x - half, side_x + half, foot_y + _STEP_MM, foot_y, _mm(box.length_m))
    for x, y, words in (
        (front_x, _MARGIN_MM + 5, "front: as seen at δ = 0, along x'"),
        (side_x, _MARGIN_MM + 5, "side: along y'"),
        (front_x, top_y - scale * length / 2 - 4, "from above: x' up, y' to the left"),
    ):
        page.text(x, y, words, "caption")
    _title_block(page, spec, scale, notes)
    w, h = PAGE_MM
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{w:g}mm" height="{h:g}mm" viewBox="0 0 {w:g} {h:g}">\n'
        f"<title>{html.escape(spec.name)}</title>\n<style>{_STYLE}</style>\n"
        f'<rect width="{w:g}" height="{h:g}" fill="white"/>\n' + "\n".join(page.elements) + "\n</svg>\n"
    )


def scale_words(scale: float) -> str:
    """Write a scale as it stands on drawings."""
    return f"{scale:g} : 1" if scale >= 1 else f"1 : {1 / scale:g}"


def _mm(value_m: float) -> str:
    return f"{1000 * value_m:.4g}"


def _diameters(spec: LandmarkSpec) -> list[tuple[float, float]]:
    """Return height and diameter wherever the profile has a corner, metres; for a sphere its equator."""
    assert spec.upper is not None
    if isinstance(spec.upper, Sphere):
        return [(spec.upper.radius_m, 2 * spec.upper.radius_m)]
    return [(float(z), 2 * float(r)) for r, z in upper_outline(spec.upper)]


def _elevation(
    page: _Page, spec: LandmarkSpec, x: float, interface_y: float, scale: float, side_mm: float, name: str
) -> None:
    """Draw the outline of box and upper part seen from a side."""
    assert spec.upper is not None
    half, depth = scale * side_mm / 2, scale * 1000 * spec.box.height_m
    corners = [[x - half, interface_y], [x + half, interface_y], [x + half, interface_y + depth]]
    page.polygon("outline", np.array([*corners, [x - half, interface_y + depth]]), f"{name}-box")
    profile = 1000 * scale * upper_outline(spec.upper)
    right = np.c_[x + profile[:, 0], interface_y - profile[:, 1]]
    left = np.c_[x - profile[::-1, 0], interface_y - profile[::-1, 1]]
    page.polygon("outline", np.vstack([right, left]), f"{name}-upper")
    for r, z in profile[1:-1] if not isinstance(spec.upper, Sphere) else ():
        page.line("hidden", x - r, interface_y - z, x + r, interface_y - z)
    top = interface_y - profile[:, 1].max()
    page.line("axis", x, top - 4, x, interface_y + depth + 4)
    page.line("axis", x - half - 5, interface_y, x + half + 5, interface_y)


def _plan_view(page: _Page, spec: LandmarkSpec, x: float, y: float, scale: float) -> None:
    """Draw the landmark from above."""
    assert spec.upper is not None
    across, along = scale * 500 * spec.box.width_m, scale * 500 * spec.box.length_m
    corners = [[x - across, y - along], [x + across, y - along], [x + across, y + along], [x - across, y + along]]
    page.polygon("outline", np.array(corners), "top-box")
    radius, _ = upper_size(spec.upper)
    page.circle("outline", x, y, 1000 * scale * radius)
    widest_so_far = 0.0
    for _, diameter in reversed(_diameters(spec)):  # from the top down: what is narrower than all above is hidden
        if 0 < diameter < 2 * radius:
            page.circle("dim" if diameter > widest_so_far else "hidden", x, y, 500 * scale * diameter)
        widest_so_far = max(widest_so_far, diameter)
    page.line("axis", x - across - 5, y, x + across + 5, y)
    page.line("axis", x, y - along - 3, x, y + along + 5)
    page.upright(y - along, y + along, x + across + _STEP_MM + 3, x + across, _mm(spec.box.length_m))


def _front_dimensions(page: _Page, spec: LandmarkSpec, x: float, interface_y: float, scale: float) -> None:
    """Put the heights on the left of the front view, the width below and the diameters on the right."""
    assert spec.upper is not None
    box = spec.box
    half = scale * 500 * box.width_m
    top = interface_y - scale * 1000 * upper_size(spec.upper)[1]
    foot = interface_y + scale * 1000 * box.height_m
    left = x - half
    page.upright(interface_y, foot, left - _STEP_MM, left, _mm(box.height_m))
    page.upright(top, interface_y, left - _STEP_MM, left, _mm(upper_size(spec.upper)[1]))
    page.upright(top, foot, left - 2 * _STEP_MM, left - _STEP_MM, _mm(box.height_m + upper_size(spec.upper)[1]))
    page.across(left, x + half, foot + _STEP_MM, foot, _mm(box.width_m))
    for z, diameter in _diameters(spec):
        y, r = interface_y - 1000 * scale * z, 500 * scale * diameter
        page.line("dim", x + r, y, x + half + 3, y)
        page.text(x + half + 4, y - 0.6, f"⌀ {_mm(diameter)}" if diameter else "tip")
        page.text(x + half + 4, y + 2.6, f"at {_mm(z)}", "small")


def _title_block(page: _Page, spec: LandmarkSpec, scale: float, notes: Sequence[str]) -> None:
    assert spec.upper is not None
    w, h = PAGE_MM
    page.elements.append(f'<rect class="frame" x="5" y="5" width="{w - 10:g}" height="{h - 10:g}"/>')
    page.line("frame", _TEXT_X_MM - 5, 5, _TEXT_X_MM - 5, h - 5)
    y = 18.0
    page.text(_TEXT_X_MM, y, spec.name, "title")
    radius, height = upper_size(spec.upper)
    extents = (max(spec.box.length_m, 2 * radius), max(spec.box.width_m, 2 * radius), spec.box.height_m + height)
    lines = [
        f"scale {scale_words(scale)}, dimensions in millimetres",
        f"extents x' × y' × z': {' × '.join(map(_mm, extents))}",
        "",
        f"lower part: box {_mm(spec.box.length_m)} × {_mm(spec.box.width_m)} × {_mm(spec.box.height_m)}",
        f"upper part: {spec.upper.kind}, turned about z',",
        "   centred on the box" + (", touching it in one point" if isinstance(spec.upper, Sphere) else ""),
        "",
        "height above the box → diameter",
        *(f"   {_mm(z)} → {_mm(diameter)}" for z, diameter in _diameters(spec)),
        "",
        f"looks the same every {360 / spec.symmetry:g}° about z'",
        "",
        "surface: matt and diffuse, no gloss, one coat,",
        f"   albedo {spec.albedo:g} or more at the camera's wavelength",
        "edges sharp, radius at most 1 mm",
        "mount with the joint of both parts (z' = 0)",
        "   level with the camera's lens",
        "",
        *notes,
    ]
    for words in lines:
        y += 5.2 if words else 2.6
        text = words.lstrip()
        page.text(_TEXT_X_MM + 1.5 * (len(words) - len(text)), y, text)
    page.text(_TEXT_X_MM, h - 9, "first-angle projection; dash-dotted: axis and joint", "small")
