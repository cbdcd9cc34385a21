"""Mesh files: every format comes back as it was written, and damage is one clear line."""

import struct
import sys
import warnings

import numpy as np
import pytest
import trimesh

from phasemark import InputFileError, UsageError
from phasemark.landmarks import build_mesh, catalog, check_mesh, export_mesh, read_mesh
from phasemark.landmarks.mesh_files import MeshWarning

BOX = trimesh.creation.box((0.2, 0.1, 0.3))
FORMATS = ("stl", "ply", "obj", "off")
ASCII_STL = trimesh.exchange.stl.export_stl_ascii(BOX).encode()
ASCII_PLY = trimesh.exchange.ply.export_ply(BOX, encoding="ascii")
CONTENT = {**{kind: export_mesh(BOX, kind) for kind in FORMATS}, "ascii stl": ASCII_STL, "ascii ply": ASCII_PLY}


@pytest.mark.parametrize("kind", list(CONTENT))
def test_a_mesh_comes_back_as_it_was(kind):
    mesh = read_mesh(CONTENT[kind], unit="m", file_type=kind.split()[-1])
    assert len(mesh.vertices) == 8  # STL has 36: those at one point are merged
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(0.2 * 0.1 * 0.3, rel=1e-6)  # float32 in STL and PLY


def test_export_gives_the_same_bytes_each_time():
    for kind in FORMATS:
        assert export_mesh(build_mesh(catalog()["cone"]), kind) == export_mesh(build_mesh(catalog()["cone"]), kind)


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("inch", 0.0254)])
def test_coordinates_become_metres(unit, metres):
    mesh = read_mesh(export_mesh(BOX.copy().apply_scale(1 / metres), "off"), unit=unit, file_type="off")
    np.testing.assert_allclose(mesh.extents, [0.2, 0.1, 0.3], rtol=1e-6)


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_the_axis_that_points_up_in_the_file_becomes_z(up):
    axis = "xyz".index(up[-1])
    tip = np.zeros(3)
    tip[axis] = -1.0 if up.startswith("-") else 1.0
    corners = np.vstack([np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3]] * 0.3, -np.eye(3)[[(axis + 1) % 3]] * 0.3, [tip]])
    pyramid = trimesh.Trimesh(corners, [[0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 2, 1]])
    if pyramid.volume < 0:
        pyramid.invert()
    mesh = read_mesh(export_mesh(pyramid, "off"), unit="m", file_type="off", up=up)
    assert mesh.vertices[:, 2].max() == pytest.approx(1.0)
    assert mesh.volume == pytest.approx(pyramid.volume)  # a rotation, not a reflection


def test_the_origin_is_where_it_is_asked_for():
    moved = export_mesh(BOX.copy().apply_translation([1, 2, 3]), "off")
    bounds = {o: read_mesh(moved, unit="m", file_type="off", origin=o).bounds for o in ("file", "base", "center")}
    np.testing.assert_allclose(bounds["file"][0], [0.9, 1.95, 2.85])
    np.testing.assert_allclose(bounds["base"][0], [-0.1, -0.05, 0.0], atol=1e-9)
    np.testing.assert_allclose(bounds["center"][0], [-0.1, -0.05, -0.15], atol=1e-9)


def test_a_missing_unit_is_answered_with_the_extents_in_each():
    with pytest.raises(UsageError, match=r"mm: 0\.0002 × 0\.0001 × 0\.0003 m"):
        read_mesh(CONTENT["stl"], unit=None, file_type="stl")


@pytest.mark.parametrize("option", [{"unit": "mile"}, {"unit": "m", "up": "w"}, {"unit": "m", "origin": "here"}])
def test_wrong_options_are_refused(option):
    with pytest.raises(UsageError, match="must be one of"):
        read_mesh(CONTENT["stl"], file_type="stl", **option)


def _binary_stl(vertex):
    return bytes(80) + struct.pack("<I12fH", 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, *vertex, 0)


def _off(vertices, faces):
    lines = ["OFF", f"{len(vertices)} {len(faces)} 0"]
    lines += [" ".join(map(str, row)) for row in vertices] + ["3 " + " ".join(map(str, face)) for face in faces]
    return "\n".join(lines).encode() + b"\n"


CORNERS = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]


@pytest.mark.parametrize(
    ("content", "kind", "message"),
    [
        (b"", "stl", "cut off"),
        (b"", "ply", "not PLY"),
        (b"", "obj", "no faces"),
        (b"", "off", "not OFF"),
        (bytes(84), "stl", "no faces"),
        (CONTENT["stl"][:-30], "stl", "cut off"),
        (ASCII_STL[: len(ASCII_STL) // 2], "stl", "cut off"),
        (CONTENT["ply"][:-20], "ply", "damaged"),
        (CONTENT["ply"][:60], "ply", "cut off"),
        (ASCII_PLY[:-20], "ply", "cut off"),
        (CONTENT["off"][: len(CONTENT["off"]) // 2], "off", "cut off"),
        (_binary_stl((0, float("nan"), 0)), "stl", "not finite"),
        (_binary_stl((0, float("inf"), 0)), "stl", "not finite"),
        (_off([*CORNERS[:2], (0, "nan", 0)], [(0, 1, 2)]), "off", "not finite|damaged"),
        (_off(CORNERS, [(0, 1, 3)]), "off", "names vertex 3|damaged"),
        (_off(CORNERS, [(0, 1, -1)]), "off", "names vertex -1|damaged"),
        (_off(CORNERS, [(0, 1, 1)]), "off", "no extent|no faces"),
        (_off([(0, 0, 0)] * 3, [(0, 1, 2)]), "off", "no extent|no faces"),
        (_off([(0, 0, 0), (1, 1, 1), (2, 2, 2)], [(0, 1, 2)]), "off", "no extent"),
        (b"OFF\n3 2000001 0\n", "off", "at most 2000000"),
        (bytes(80) + struct.pack("<I", 2_000_001), "stl", "at most 2000000"),
        (b"ply\nformat ascii 1.0\nelement vertex 3\nelement face 2000001\nend_header\n", "ply", "at most 2000000"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "obj", "names vertex|damaged"),
        (b"solid nothing\nendsolid\n", "stl", "no faces"),
        (b"\x00\xff" * 300, "ply", "not PLY"),
        (b"\x00\xff" * 300, "obj", "no faces"),
        (CONTENT["stl"], "step", "unknown mesh format"),
    ],
)
def test_damage_is_one_line(content, kind, message):
    with pytest.raises(InputFileError, match=message) as caught:
        read_mesh(content, unit="m", file_type=kind)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputFileError, match=r"none\.stl"):
        read_mesh(tmp_path / "none.stl", unit="m")


def test_materials_named_by_an_obj_are_never_opened(tmp_path):
    canary = tmp_path / "canary.mtl"
    canary.write_text("newmtl red\nKd 1 0 0\n")
    (tmp_path / "part.obj").write_bytes(f"mtllib {canary}\nusemtl red\n".encode() + CONTENT["obj"])
    opened = []
    listening = [True]  # an audit hook cannot be removed, so it is told when to stop

    def hook(event, arguments):
        if listening[0] and event == "open":
            opened.append(str(arguments[0]))

    sys.addaudithook(hook)
    try:
        mesh = read_mesh(tmp_path / "part.obj", unit="m")
    finally:
        listening[0] = False
    assert mesh.is_watertight
    assert any(path.endswith("part.obj") for path in opened)
    assert not any("canary" in path for path in opened)


OPEN = trimesh.Trimesh(BOX.vertices, BOX.faces[2:], process=False)
INSIDE_OUT = trimesh.Trimesh(BOX.vertices, BOX.faces[:, ::-1], process=False)
HUGE = BOX.copy().apply_scale(1000)


@pytest.mark.parametrize(
    ("mesh", "warning"),
    [(OPEN, "open"), (INSIDE_OUT, "inside out"), (BOX.copy().apply_scale(1000), "is the unit right")],
)
def test_a_doubtful_mesh_is_read_as_it_is_with_a_warning(mesh, warning):
    with pytest.warns(MeshWarning, match=warning):
        found = read_mesh(export_mesh(mesh, "off"), unit="m", file_type="off")
    assert found.volume == pytest.approx(mesh.volume)
    report = check_mesh(found)
    assert (report.watertight, report.volume_m3 is None) == (mesh is not OPEN, mesh is OPEN)


def test_a_sound_mesh_raises_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        report = check_mesh(read_mesh(CONTENT["ply"], unit="m", file_type="ply"))
    assert (report.faces, report.vertices, report.bodies, report.outward) == (12, 8, 1, True)
    assert report.volume_m3 == pytest.approx(0.006, rel=1e-6)


def _damaged(content, rng):
    """Cut, flip, splice or repeat a part of a file."""
    data = bytearray(content)
    start, stop = sorted(rng.integers(len(data), size=2))
    match rng.integers(4):
        case 0:
            del data[start:]
        case 1:
            for at in rng.integers(min(len(data), 400), size=3):  # counts and formats stand in front
                data[at] = rng.integers(256)
        case 2:
            del data[start:stop]
        case _:
            data[start:start] = rng.choice([b"nan", b"-1", b"1e400", b"9" * 30, b"\n\n", b"\x00\xff"])
    return bytes(data)


@pytest.mark.parametrize("kind", list(CONTENT))
@pytest.mark.filterwarnings("ignore::phasemark.landmarks.mesh_files.MeshWarning")
def test_damage_anywhere_is_one_line_or_leaves_a_mesh_that_can_be_rendered(kind):
    rng = np.random.default_rng(2005)
    refusals = []
    for _ in range(150):
        try:
            mesh = read_mesh(_damaged(CONTENT[kind], rng), unit="m", file_type=kind.split()[-1])
        except InputFileError as error:
            refusals.append(str(error))
        else:
            assert np.isfinite(mesh.vertices).all()
            assert 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)
    assert not [line for line in refusals if "\n" in line]
    assert len(refusals) > 50  # a third at the least: or the damage is none
