"""Pictures of a landmark: a PNG that shows its outline, and a page that holds the mesh and loads nothing."""

import base64
import io
import json
import re
import struct
import zlib
from html.parser import HTMLParser

import matplotlib.image
import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from matplotlib.text import Annotation

from phasemark.landmarks import build_mesh, catalog, mesh_figure
from phasemark.landmarks.figures import _draw_directions, mesh_html

VOID = {"meta", "link", "br", "img", "hr", "input"}
BOX = trimesh.creation.box((0.2, 0.1, 0.3))
OPEN_BOX = trimesh.Trimesh(BOX.vertices, BOX.faces[2:], process=False)
TITLES = ["</title><script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "$faces ${x}"]


@pytest.fixture(params=["cone", "open box"])
def mesh(request):
    return OPEN_BOX if request.param == "open box" else build_mesh(catalog()[request.param])


class Tags(HTMLParser):
    """Notes every tag, and whether each is closed in its place."""

    def __init__(self):
        super().__init__()
        self.open, self.seen, self.stray = [], [], []

    def handle_starttag(self, tag, attributes):
        self.seen.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.stray.append(tag)


def parse(page):
    tags = Tags()
    tags.feed(page)
    tags.close()
    return tags


def chunk_kinds(png):
    """Return the kinds of a PNG's chunks, their checksums verified."""
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    kinds, at = [], 8
    while at < len(png):
        (length,) = struct.unpack_from(">I", png, at)
        kind, content = png[at + 4 : at + 8], png[at + 8 : at + 8 + length]
        assert struct.unpack_from(">I", png, at + 8 + length) == (zlib.crc32(kind + content),)
        kinds.append(kind)
        at += 12 + length
    return kinds


def blue(png):
    """Tell which pixels have the mesh's colour: more blue than red, as neither paper, ink nor grid has."""
    image = matplotlib.image.imread(io.BytesIO(png))[..., :3]
    return image[..., 2] > 1.2 * image[..., 0]


def arrays_of(page):
    """Return vertices, faces and the corners' normals as the page's script decodes them."""
    names = {"vertices": "<f4", "faces": "<u4", "normals": "<f4"}
    found = {name: re.search(rf'{name} = decode\("([^"]*)"', page) for name in names}
    return (np.frombuffer(base64.b64decode(found[name][1]), kind).reshape(-1, 3) for name, kind in names.items())


def test_the_picture_is_a_whole_png_and_the_same_each_time(mesh):
    picture = mesh_figure(mesh)
    kinds = chunk_kinds(picture)
    assert (kinds[0], kinds[-1]) == (b"IHDR", b"IEND")
    assert picture == mesh_figure(mesh)


def test_the_picture_shows_the_mesh_from_where_it_is_asked():
    # a box 0.3 m tall is 0.2 m wide from the front, 0.1 m from the end
    for azimuth_deg, ratio in ((-90.0, 1.5), (0.0, 3.0)):
        rows, cols = np.nonzero(blue(mesh_figure(BOX, azimuth_deg=azimuth_deg, elevation_deg=0.0)))
        # perspective enlarges the near face in both directions alike; the ink of the outline costs a pixel or two
        assert np.ptp(rows) / np.ptp(cols) == pytest.approx(ratio, rel=0.05)


def test_directions_are_drawn_from_where_the_camera_looks(mesh):
    axes = Figure().add_subplot()
    _draw_directions(axes, mesh)
    arrows = [one for one in axes.texts if isinstance(one, Annotation) and one.arrow_patch is not None]
    labels = [one for one in axes.texts if not isinstance(one, Annotation)]
    assert [one.get_text() for one in labels] == ["δ = 0", *(f"{delta_deg}°" for delta_deg in range(45, 360, 45))]
    reach_cm = 100 * np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]).max()
    for k, (arrow, label) in enumerate(zip(arrows, labels, strict=True)):
        looks = np.array([np.cos(k * np.pi / 4), np.sin(k * np.pi / 4)])
        tail, head, beside = (np.array(place) @ looks for place in (arrow.xyann, arrow.xy, label.get_position()))
        assert beside < tail < head < -reach_cm  # the lens is at −D (cos δ, sin δ), and looks at the axis (section 1)
        np.testing.assert_allclose(label.get_position(), beside * looks, atol=1e-9)
    drawn = matplotlib.image.imread(io.BytesIO(mesh_figure(mesh, directions=True)))
    assert drawn.shape[1] == 2 * matplotlib.image.imread(io.BytesIO(mesh_figure(mesh))).shape[1]


def test_an_open_mesh_shows_its_inside():
    # without its lid one sees the far walls through the opening: no less surface than the lid had
    assert blue(mesh_figure(OPEN_BOX)).sum() > 0.8 * blue(mesh_figure(BOX)).sum()


def test_the_page_is_whole_and_loads_nothing(mesh):
    page = mesh_html(mesh, "part")
    tags = parse(page)
    assert page.startswith("<!doctype html>")
    assert (tags.open, tags.stray) == ([], [])
    assert not [attributes for _, attributes in tags.seen if {"src", "href", "srcset", "data"} & attributes.keys()]
    code = re.sub(r'decode\("[^"]*"', "", page)  # base64 spells anything
    assert not re.search(r"https?:|url\(|@import|\bfetch\(|XMLHttpRequest|import\(", code)
    assert not re.search(r"\$\{?[a-z]", code)  # every placeholder is filled


def test_axes_and_the_line_of_sight_at_delta_0_start_where_the_landmark_has_its_origin():
    """The page scales the mesh into a ball about the middle of its bounding box; (0, 0, 0) goes with it."""
    moved = BOX.copy()
    moved.apply_translation((0.3, -0.1, 0.15))
    page = mesh_html(moved, "part")
    origin = np.array(json.loads(re.search(r"const origin = (\[.*?\])", page)[1]))
    vertices = next(arrays_of(page))
    radius = 0.5 * np.linalg.norm(moved.extents)
    assert np.linalg.norm(vertices, axis=1).max() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(origin, -np.array([0.3, -0.1, 0.15]) / radius, atol=1e-6)
    for name in ("x′", "y′", "z′", "δ = 0"):
        assert f'"{name}"' in page
    # the camera stands on the side of −x' (PHYSICS section 8), and looks along x'
    assert "[origin[0] - 1.5, origin[1], origin[2]], [origin[0] - 0.75, origin[1], origin[2]]" in page


@pytest.mark.parametrize("title", TITLES)
def test_a_title_stays_text(title):
    plain, named = parse(mesh_html(BOX, "part")), parse(mesh_html(BOX, title))
    assert [tag for tag, _ in named.seen] == [tag for tag, _ in plain.seen]
    assert [attributes.keys() for _, attributes in named.seen] == [attributes.keys() for _, attributes in plain.seen]


def test_the_page_holds_the_mesh_centred_and_scaled_to_a_unit_ball():
    mesh = build_mesh(catalog()["cylinder"])
    vertices, faces, normals = arrays_of(mesh_html(mesh, "cylinder"))
    assert faces.max() < len(vertices)
    assert len(normals) == 3 * len(faces)  # one for each corner
    assert np.linalg.norm(vertices, axis=1).max() == pytest.approx(1.0, abs=1e-6)  # float32
    radius = np.linalg.norm(mesh.vertices - mesh.bounds.mean(axis=0), axis=1).max()
    shown = trimesh.Trimesh(vertices.astype(float), faces.astype(np.int64), process=False)
    assert shown.area * radius**2 == pytest.approx(mesh.area, rel=1e-5)  # float32
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)


def test_edges_stay_sharp_in_the_page():
    vertices, faces, normals = arrays_of(mesh_html(BOX, "box"))
    flat = trimesh.Trimesh(vertices.astype(float), faces.astype(np.int64), process=False).face_normals
    np.testing.assert_allclose(normals, np.repeat(flat, 3, axis=0), atol=1e-6)  # float32; every edge is a crease


def test_round_surfaces_are_shaded_smoothly_in_the_page():
    # on the sphere of radius 75 mm around z' = 75 mm the normal of a corner is its direction from the centre
    mesh = build_mesh(catalog()["sphere"], part="upper", tolerance_m=1e-5)
    vertices, faces, normals = arrays_of(mesh_html(mesh, "sphere"))
    outward = vertices[faces.ravel()] / np.linalg.norm(vertices[faces.ravel()], axis=1, keepdims=True)
    # means over the faces around a vertex, whose sections turn by some degrees: off by a fraction of one section
    assert np.einsum("ij,ij->i", normals, outward).min() > np.cos(np.radians(5))
