"""The commands as a user types them: what they write, and one line for every mistake, with its exit code."""

import json
import math
import re
import shutil
import subprocess
import sys

import h5py
import numpy as np
import pytest

from phasemark.cli import main
from phasemark.inputs import verify_checksum
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Renderer, capture, preset

SENSOR = preset("pmd-16x16")
SMALL = ["--distance", "0.96:1.04:0.02", "--delta", "0:180:10"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a bank and frames of a cone 1 m away, turned by 40°, a wall at 3 m behind."""
    folder = tmp_path_factory.mktemp("commands")
    assert main(["bank", "build", *SMALL, "-o", str(folder / "bank.h5")]) == 0
    image = Renderer(build_mesh(catalog()["cone"]), SENSOR).render(
        1.0, math.radians(40), background=Background(wall_m=3.0)
    )
    frames = capture(image, SENSOR, rng=np.random.default_rng(4), n_frames=20)
    np.savetxt(folder / "frames.csv", frames.range_m[0].reshape(20, -1), delimiter=",", fmt="%.5f")
    np.savez(folder / "frames.npz", range=np.repeat(frames.range_m, 2, axis=0))
    return folder


MATCH = ["--unit", "m", "--quantity", "range", "--wall", "3"]
NEAREST = ["--method", "nearest"]


def test_a_frame_is_matched_and_the_robot_placed(run, folder):
    code, out, _ = run(
        "match", folder / "bank.h5", folder / "frames.csv", *MATCH, *NEAREST, "--landmark-xy", 2.0, 1.0, "--pan", 0,
        "--json",
    )  # fmt: skip
    assert code == 0
    (match,) = json.loads(out)["matches"]
    assert (match["class"], match["accepted"]) == ("cone", True)
    assert match["distance_m"] == pytest.approx(1.0)
    assert match["delta_deg"] == pytest.approx(40.0)
    # equation (11), and the mirrored solution
    here = [2 - math.cos(math.radians(40)), 1 - math.sin(math.radians(40))]
    there = [4 - here[0], 2 - here[1]]
    np.testing.assert_allclose(sorted([pose["x_m"], pose["y_m"]] for pose in match["poses"]), sorted([here, there]))


def test_a_prior_puts_the_pose_it_fits_first(run, folder):
    for x, y, heading in ((1.2, 0.4, 40), (2.8, 1.6, -140)):
        _, out, _ = run(
            "match", folder / "bank.h5", folder / "frames.csv", *MATCH, "--landmark-xy", 2, 1, "--prior", x, y, heading,
            "--json",
        )  # fmt: skip
        first = json.loads(out)["matches"][0]["poses"][0]
        assert math.hypot(first["x_m"] - x, first["y_m"] - y) < 0.1


def test_the_table_has_a_line_a_position(run, folder, tmp_path):
    code, out, _ = run("match", folder / "bank.h5", folder / "frames.npz", *MATCH, "--plot", tmp_path / "m.png")
    assert code == 0
    assert sum("cone" in line for line in out.splitlines()) == 2
    assert {path.name for path in tmp_path.iterdir()} == {"m-0.png", "m-1.png"}


def test_no_landmark_is_an_answer(run, folder, tmp_path):
    np.savetxt(tmp_path / "wall.csv", np.full((5, 256), 3.0) + np.linspace(0, 1e-3, 5)[:, None], delimiter=",")
    command = ["match", folder / "bank.h5", tmp_path / "wall.csv", "--unit", "m", "--quantity", "z"]
    code, out, _ = run(*command, *NEAREST, "--no-diagnosis")
    assert code == 0
    assert "no landmark" in out


def test_the_mean_phasor_is_the_other_filter(run, folder):
    code, out, _ = run("match", folder / "bank.h5", folder / "frames.csv", *MATCH, "--filter", "phasor-mean", "--json")
    assert code == 0
    assert json.loads(out)["matches"][0]["class"] == "cone"


def test_render_writes_picture_and_phasors(run, tmp_path):
    code, out, _ = run(
        "render", "--class", "cylinder", "--distance", 1.0, "--delta", 30, "--wall", 4, "-o", tmp_path / "f.png"
    )
    assert code == 0
    assert out.split() == [str(tmp_path / "f.png"), str(tmp_path / "f.npz")]
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")
    expected = Renderer(build_mesh(catalog()["cylinder"]), SENSOR).render(
        1.0, math.radians(30), background=Background(wall_m=4.0)
    )
    with np.load(tmp_path / "f.npz", allow_pickle=False) as data:
        np.testing.assert_array_equal(data["phasor"], expected.phasor[0])
        np.testing.assert_array_equal(data["coverage"], expected.coverage[0])


WRAPS = "is beyond c / 2f = 14.99 m, where ranges wrap: it shows at about"
FAR_FRAMES = """
views = 4
sensor = "vl53l5cx-8x8"
variants = ["mixed"]
wall_m = { normal = [3.8, 0.1], within = [3.0, 4.1] }
"""
FAR_HISTOGRAMS = FAR_FRAMES.replace("4.1", "4.9")
FAR_SWEEP = """
name = "far"
bank_distance_m = [15.0, 17.0]
axes = { distance_m = [16.0], wall_m = [0.0, 18.0] }
"""


NO_RANGE = "'wall_m' at 4.1 m is beyond the sensor's 'max_range_m' = 4 m: the sensor reports no range from there"
BUILD = "frames build plan.toml --dry-run -o f.h5"


@pytest.mark.parametrize(
    ("text", "command", "notes"),
    [
        (None, "render --class cone --distance 20 -o x.png", [f"--distance at 20 m {WRAPS} 5.01 m"]),
        (None, "render --class cone --wall 16 -o x.png", [f"--wall at 16 m {WRAPS} 1.01 m"]),
        (None, "render --class cone --wall 14.9 -o x.png", []),
        (None, "bank build --distance 14:20:2 --dry-run -o b.h5", [f"'distance_m' at 20 m {WRAPS} 5.01 m"]),
        (FAR_FRAMES + "histograms = false\n", BUILD, [NO_RANGE]),
        (FAR_FRAMES, BUILD, []),  # targets of histograms are found as far as their bins reach, 128 of 3.75 cm
        (FAR_HISTOGRAMS, "plan check plan.toml", ["'wall_m' at 4.9 m is beyond the histograms, which end at 4.8 m"]),
        (FAR_SWEEP, "plan check plan.toml", ["axes.distance_m", "axes.wall_m", "bank_distance_m"]),
    ],
)
def test_distances_that_wrap_or_return_nothing_are_noted(run, tmp_path, monkeypatch, text, command, notes):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plan.toml").write_text(text or "", encoding="utf-8")
    code, _, err = run(*command.split())
    assert code == 0
    lines = err.splitlines()
    assert len(lines) == len(notes)
    for line, note in zip(lines, notes, strict=True):
        assert line.startswith("note: ")
        assert note in line


VGA = """
sensor = "pmd-16x16"
sensor_overrides = { rows = 480, cols = 640 }
layout = "full"
"""


@pytest.mark.parametrize(
    ("text", "command", "words"),
    [
        # 4 classes, 141 distances, 180 sides; a phasor, an intensity and a coverage of 4 bytes a number
        (VGA, "bank build", ["101520 images, 499 GB", "2 GB", "--max-size 549GB"]),
        (VGA, "bank build --shard 1/1000 --max-size 498MB", ["101 images"]),
        (VGA, "bank build --distance 1:9:0.0001 --delta 0:9:1e-4", ["TB"]),
        ("views = 1000000000", "frames build", ["1000000000 views, 1000000000 frames, 6.49 TB", "'views'"]),
        ("views = 1", "frames build --max-size 6kB", ["6.49 kB", "6 kB"]),
        ("views = 1", "frames build --max-size 20apples", ["such as 20GB"]),
    ],
)
def test_a_file_that_would_be_too_large_is_refused_before_it_is_begun(run, tmp_path, monkeypatch, text, command, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plan.toml").write_text(text, encoding="utf-8")
    code, out, err = run(*command.split(), "plan.toml", "-o", "x.h5")
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert all(word in err for word in words), err
    assert [path.name for path in tmp_path.iterdir()] == ["plan.toml"]


def test_a_dry_run_states_a_size_that_would_be_refused(run, tmp_path):
    (tmp_path / "plan.toml").write_text(VGA, encoding="utf-8")
    command = ["bank", "build", tmp_path / "plan.toml", "--dry-run", "-o", tmp_path / "x.h5"]
    code, out, err = run(*command, "--json")
    assert (code, err) == (0, "")
    assert json.loads(out) == {"images": 101520, "bytes": 101520 * 640 * 480 * 16, "seconds": None}
    assert "not tried" in run(*command)[1]


def test_a_large_file_that_is_allowed_is_announced(run, tmp_path, monkeypatch):
    monkeypatch.setattr("phasemark.data.commands.build.NOTED_BYTES", 100_000)
    command = ["bank", "build", "--class", "cone", *SMALL, "-o", tmp_path / "b.h5", "--max-size"]
    assert run(*command, "0.19MB")[0] == 2
    code, _, err = run(*command, "0.2 MB")
    assert code == 0
    # 5 distances from 18 sides of the lower half, and from one of the upper half, of 8 · 16 pixels of 16 bytes
    announced = rf"note: {re.escape(str(tmp_path / 'b.h5'))}: 95 images, 195 kB; about \d+ s on \d+ processors here\n"
    assert re.fullmatch(announced, err)
    code, _, err = run(*command, "0.2 MB")
    assert code == 4
    assert err.startswith("error: ")  # without a trial


def test_a_hard_render_has_no_mixed_pixel(run, tmp_path):
    run("render", "--class", "cone", "--distance", 1.0, "--variant", "hard", "-o", tmp_path / "f.png")
    with np.load(tmp_path / "f.npz") as data:
        assert set(np.unique(data["coverage"])) == {0.0, 1.0}


def test_refinement_tells_standard_deviations_and_fixes_or_frees_the_bearing(run, folder):
    refine = ["match", folder / "bank.h5", folder / "frames.csv", *MATCH, "--method", "refine", "--json"]
    code, out, _ = run(*refine, "--fix", "bearing")
    assert code == 0
    (match,) = json.loads(out)["matches"]
    assert match["class"] == "cone"
    assert match["distance_m"] == pytest.approx(1.0, abs=1e-3)  # ten standard deviations before a wall
    assert match["delta_deg"] == pytest.approx(40.0, abs=0.5)
    assert np.array(match["covariance"]).shape == (2, 2)
    for bearing in ([], ["--free", "bearing"]):
        code, out, _ = run(*refine, *bearing)
        (match,) = json.loads(out)["matches"]
        assert match["free"] == ["distance_m", "delta_deg", "bearing_deg"]
        assert np.array(match["covariance"]).shape == (3, 3)
        assert match["bearing_deg"] == pytest.approx(0.0, abs=0.3)
    auto = ["--unit", "m", "--quantity", "range", "--auto-background", "--method", "refine"]
    code, out, _ = run("match", folder / "bank.h5", folder / "frames.csv", *auto)
    assert code == 0
    assert "±" in out


def test_what_render_writes_match_reads(run, folder, tmp_path):
    run("render", "--class", "cone", "--distance", 1.0, "--delta", 40, "--wall", 3, "-o", tmp_path / "f.png")
    code, out, _ = run("match", folder / "bank.h5", tmp_path / "f.npz", "--wall", 3, "--json")
    assert code == 0
    assert json.loads(out)["matches"][0]["class"] == "cone"


def test_a_bank_is_written_with_its_checksum_and_described(run, folder):
    verify_checksum(folder / "bank.h5")
    code, out, _ = run("bank", "info", folder / "bank.h5", "--json")
    info = json.loads(out)
    assert code == 0
    assert info["classes"] == ["cylinder", "cone", "sphere", "post"]
    assert (info["n_distance"], info["n_delta"], info["layout"]) == (5, 18, "factored")
    code, out, _ = run("bank", "info", folder / "bank.h5")
    assert code == 0
    assert "0.96:1.04:0.02" in out


def test_the_same_command_writes_the_same_bytes(run, folder, tmp_path):
    assert run("bank", "build", *SMALL, "--workers", 2, "-o", tmp_path / "bank.h5")[0] == 0
    assert (tmp_path / "bank.h5").read_bytes() == (folder / "bank.h5").read_bytes()


def test_a_mesh_file_becomes_a_class(run, tmp_path):
    assert run("landmark", "export", "post", "-o", tmp_path / "post.stl")[0] == 0
    code, _, _ = run(
        "bank", "build", "--mesh", f"mine={tmp_path / 'post.stl'}", "--unit", "m", "--symmetry", 2,
        "--distance", "0.9:1.1:0.1", "--delta", "0:180:30", "-o", tmp_path / "b.h5",
    )  # fmt: skip
    assert code == 0
    with h5py.File(tmp_path / "b.h5") as file:
        assert file["full/landmark_class"].asstr()[...].tolist() == ["mine"]
        assert file["full/delta"][...].tolist() == [0, 30, 60, 90, 120, 150]


def test_a_planar_bank_sees_no_mixed_pixels(run, tmp_path):
    code, _, _ = run("bank", "build", "--model", "planar", "--class", "cone", *SMALL, "-o", tmp_path / "b.h5")
    assert code == 0
    with h5py.File(tmp_path / "b.h5") as file:
        assert set(np.unique(file["lower/coverage"])) == {0.0, 1.0}


def test_a_plan_is_overridden_by_options(run, tmp_path):
    (tmp_path / "plan.toml").write_text('classes = ["cone"]\ndistance_m = "0.9:1.1:0.1"\ndelta_deg = "0:180:90"\n')
    code, _, _ = run("bank", "build", tmp_path / "plan.toml", "--delta", "0:180:45", "-o", tmp_path / "b.h5")
    assert code == 0
    info = json.loads(run("bank", "info", tmp_path / "b.h5", "--json")[1])
    assert (info["classes"], info["n_distance"], info["n_delta"]) == (["cone"], 3, 4)


def test_landmarks_are_listed_shown_exported_and_checked(run, tmp_path):
    code, out, _ = run("landmark", "list", "--json")
    assert (code, [spec["name"] for spec in json.loads(out)]) == (0, ["cylinder", "cone", "sphere", "post"])
    assert "180°" in run("landmark", "list")[1]
    assert run("landmark", "show", "cone", "-o", tmp_path / "new" / "pictures")[0] == 0
    assert {path.name for path in (tmp_path / "new" / "pictures").iterdir()} == {"cone.png", "cone.html"}
    for kind in ("stl", "ply", "obj", "off"):
        assert run("landmark", "export", "cone", "-o", tmp_path / f"cone.{kind}")[0] == 0
        code, out, err = run("landmark", "check", tmp_path / f"cone.{kind}", "--unit", "m", "--json")
        report = json.loads(out)
        assert (code, err) == (0, "")
        assert (report["watertight"], report["outward"], report["warnings"]) == (True, True, [])
        assert report["extents_m"] == pytest.approx([0.24, 0.16, 0.30], abs=1e-6)  # float32 in STL and PLY


def _case(code, *arguments, contains):
    return pytest.param(code, arguments, contains, id=" ".join(map(str, arguments))[:60])


MISTAKES = [
    _case(2, "match", "bank.h5", "frames.csv", *MATCH, "--auto-background", contains="leave --wall"),
    _case(2, "match", "bank.h5", "frames.csv", *MATCH, "--free", "yaw", contains="bearing, height, pitch or roll"),
    _case(2, "match", "bank.h5", "frames.csv", *MATCH, *NEAREST, "--free", "bearing", contains="--method refine"),
    _case(2, "match", "part.STL", "frames.csv", *MATCH, contains="does not say which sensor took it: give --sensor"),
    _case(3, "match", "cut.h5", "frames.csv", *MATCH, contains="cut.h5"),
    _case(2, "match", "bank.h5", "frames.csv", "--quantity", "range", contains="--unit"),
    _case(2, "match", "bank.h5", "frames.csv", "--unit", "m", contains="--quantity"),
    _case(2, "match", "bank.h5", "frames.csv", "--unit", "yard", "--quantity", "range", contains="yard"),
    _case(2, "match", "bank.h5", "frames.csv", *MATCH, "--prior", 1, 2, 3, contains="--landmark-xy"),
    _case(2, "match", "bank.h5", "frames.csv", *MATCH[:4], "--wall", -1, contains="wall_m"),
    _case(4, "match", "bank.h5", "frames.csv", *MATCH, "--plot", "taken.png", contains="--force"),
    _case(4, "match", "bank.h5", "frames.npz", *MATCH, "--plot", "two.png", contains="two-1.png"),
    _case(2, "match", "bank.h5", "frames.csv", *MATCH, "--plot", "m.jpg", contains=".png"),
    _case(2, "match", "bank.h5", "frames.csv", *MATCH, "--plot", "no/such/folder/m.png", contains="folder"),
    _case(2, "match", "bank.h5", "frames.csv", *MATCH, "--landmark-xy", "nan", 1, contains="--landmark-xy"),
    _case(2, "match", "bank.h5", "frames.csv", *MATCH, "--landmark-xy", 2, 1, "--pan", "inf", contains="--pan"),
    _case(2, "match", "bank.h5", "frames.csv", *MATCH, "--landmark-yaw", "nan", contains="--landmark-yaw"),
    _case(2, "match", "bank.h5", "frames.csv", *MATCH, "--rotate", 45, contains="270"),
    _case(3, "match", "bank.h5", "long.csv", *MATCH, contains="long.csv"),
    _case(3, "match", "bank.h5", "giant.h5", *MATCH, contains="declares far more"),
    _case(3, "match", "bank.h5", "bank.h5", *MATCH, contains="phasemark-bank"),
    _case(3, "match", "bank.h5", ".", *MATCH, contains="cannot be read"),
    _case(2, "bank", "build", "--class", "pyramid", "-o", "x.h5", contains="pyramid"),
    _case(2, "bank", "build", *SMALL, "--symmetry", 3, "--up", "y", "-o", "x.h5", contains="--up, --symmetry: only"),
    _case(2, "bank", "build", "--distance", "1:2:0", "-o", "x.h5", contains="1:2:0"),
    _case(2, "bank", "build", "--mesh", "part", "--unit", "mm", "-o", "x.h5", contains="NAME=FILE"),
    _case(3, "bank", "build", "--mesh", "part=cut.stl", "--unit", "m", "-o", "x.h5", contains="cut.stl"),
    _case(2, "bank", "build", "bad.toml", "-o", "x.h5", contains="distanz"),
    _case(3, "bank", "build", "nested.toml", "-o", "x.h5", contains="nested.toml"),
    _case(2, "bank", "build", *SMALL, "-o", "", contains="not a file name"),
    _case(2, "bank", "build", *SMALL, "--workers", 0, "-o", "x.h5", contains="--workers"),
    _case(2, "bank", "build", *SMALL, "--class", "cone", "--class", "cone", "-o", "x.h5", contains="two landmarks"),
    _case(2, "bank", "build", *SMALL, "--mesh", "none=box.stl", "--unit", "m", "-o", "x.h5", contains="no landmark"),
    _case(4, "bank", "build", *SMALL, "-o", "bank.h5", contains="bank.h5"),
    _case(3, "bank", "info", "none.h5", contains="none.h5"),
    _case(2, "render", "--distance", 1, "-o", "x.png", contains="--class"),
    _case(2, "render", "--class", "cone", "--distance", 0.1, "-o", "x.png", contains="distance_m"),
    _case(2, "render", "--class", "cone", "--distance", 1, "-o", "x.jpg", contains=".png"),
    _case(2, "render", "--class", "cone", "--origin", "base", "-o", "x.png", contains="--origin: only with --mesh"),
    _case(
        2,
        "calibrate",
        "x.npz",
        "--rig",
        "r.toml",
        *"--poses p.csv -o x.toml --moving".split(),
        contains="--moving: not",
    ),
    _case(2, "locate", "m.toml", "r.toml", "x.npz", "-o", "x.csv", "--start-std", 1, contains="only with --start or"),
    _case(4, "render", "--class", "cone", "--distance", 1, "-o", "taken.png", contains="taken.png"),
    _case(2, "landmark", "export", "cone", "-o", "x.step", contains="stl"),
    _case(2, "landmark", "check", "box.stl", contains="inch"),
    _case(2, "landmark", "check", "box.stl", "--unit", "m", "--up", "w", contains="'--up': 'w' is not one of 'x', 'y'"),
    _case(3, "landmark", "check", "cut.stl", "--unit", "m", contains="cut off"),
    _case(2, "landmark", "show", "cone", "-o", "box.stl", contains="is not a folder"),
    _case(2, "landmark", "export", "box.stl", "-o", "x.stl", contains="catalogue"),
    _case(2, "demo", "-o", "new", "--seed", 2**64, contains="--seed"),
    _case(2, "demo", "-o", "box.stl/new", contains="folder"),
]


@pytest.fixture(scope="module")
def bad_files(folder):
    (folder / "part.STL").write_bytes(b"solid")
    (folder / "cut.h5").write_bytes((folder / "bank.h5").read_bytes()[:5000])
    main(["landmark", "export", "post", "-o", str(folder / "box.stl")])
    (folder / "cut.stl").write_bytes((folder / "box.stl").read_bytes()[:-100])
    (folder / "bad.toml").write_text('distanz = "1:2:0.1"\n')
    (folder / "taken.png").write_bytes(b"mine")
    (folder / "two-1.png").write_bytes(b"mine")
    (folder / "nested.toml").write_text("a = " + "[" * 5000)
    (folder / "long.csv").write_text("1" * 200_000 + ",1" * 255)  # one cell longer than Python's csv reads
    with h5py.File(folder / "giant.h5", "w") as file:  # 1 PB, none of it written
        file.create_dataset("range", shape=(10**12, 16, 16), dtype="f4", chunks=(1, 16, 16))
    return folder


@pytest.mark.parametrize(("code", "arguments", "contains"), MISTAKES)
def test_a_mistake_is_one_line_and_leaves_nothing_behind(run, bad_files, monkeypatch, code, arguments, contains):
    monkeypatch.chdir(bad_files)
    before = {path.name: path.stat().st_mtime_ns for path in bad_files.iterdir()}
    found, out, err = run(*arguments)
    assert (found, out) == (code, "")
    assert len(err.splitlines()) == 1
    assert err.startswith("error: ")
    assert contains in err
    assert {path.name: path.stat().st_mtime_ns for path in bad_files.iterdir()} == before


def test_a_warning_is_one_note_and_no_error(run, folder, tmp_path):
    # a landmark of 0.3 mm is read all the same, but its unit is doubted, once
    assert run("landmark", "export", "post", "-o", tmp_path / "post.stl")[0] == 0
    code, _, err = run("landmark", "check", tmp_path / "post.stl", "--unit", "mm")
    assert code == 0
    assert err.splitlines() == [f"note: {tmp_path / 'post.stl'}: it is 0.0003 m large: is the unit right?"]
    frames = np.loadtxt(folder / "frames.csv", delimiter=",")
    frames[3, 7] = -1.0
    np.savetxt(tmp_path / "frames.csv", frames, delimiter=",")
    code, out, err = run("match", folder / "bank.h5", tmp_path / "frames.csv", *MATCH, *NEAREST, "--json")
    assert code == 0
    assert json.loads(out)["matches"][0]["class"] == "cone"
    assert len(err.splitlines()) == 1
    assert err.startswith("note: ")
    assert "frame 3, row 0, column 7" in err


def test_what_the_mesh_library_logs_stays_off_the_screen(tmp_path):
    # In a process of its own: under pytest the root logger has handlers, and logging's last resort is never asked.
    facet = "facet normal x y z\nouter loop\nvertex {}\nvertex {}\nvertex {}\nendloop\nendfacet\n"
    corners = ["0 0 0", "0.1 0 0", "0 0.1 0", "0 0 0.1"]
    faces = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]
    text = "".join(facet.format(*(corners[k] for k in face)) for face in faces)
    (tmp_path / "a.stl").write_text(f"solid a\n{text}endsolid a\n")
    program = "import sys; from phasemark.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "landmark", "check", str(tmp_path / "a.stl"), "--unit", "m"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "arguments",
    [
        ["bank", "build", "--class", "cone", *SMALL, "-o", "x.h5"],
        ["render", "--class", "cone", "--distance", "1", "-o", "x.png"],
        ["landmark", "export", "sphere", "-o", "x.obj"],
        ["landmark", "show", "cone"],
        ["landmark", "show", "cone", "-o", "new/pictures"],
    ],
    ids=lambda arguments: " ".join(arguments),
)
def test_a_full_disk_exits_with_5_and_leaves_nothing(run, tmp_path, monkeypatch, arguments):
    resource = pytest.importorskip("resource")  # POSIX
    monkeypatch.chdir(tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, hard))  # Python ignores SIGXFSZ: writing fails with EFBIG
    try:
        code, out, err = run(*arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (code, out) == (5, "")
    assert len(err.splitlines()) == 1
    assert "File too large" in err
    assert list(tmp_path.iterdir()) == []


def test_a_bank_of_another_sensor_than_the_frames_is_refused(run, folder, tmp_path):
    (tmp_path / "cam.toml").write_text("rows = 8\ncols = 8\nhalf_angle_h_deg = 11\nhalf_angle_v_deg = 11\n")
    grid = ["--class", "cone", "--distance", "0.9:1.1:0.1", "--delta", "0:180:90"]
    assert run("bank", "build", *grid, "--sensor", tmp_path / "cam.toml", "-o", tmp_path / "b.h5")[0] == 0
    code, out, err = run("match", tmp_path / "b.h5", folder / "frames.csv", *MATCH)
    assert (code, out) == (3, "")
    assert "64" in err


def test_force_replaces_an_output(run, folder, tmp_path):
    target = tmp_path / "bank.h5"
    shutil.copy(folder / "frames.csv", target)
    assert run("bank", "build", "--class", "cone", *SMALL, "-o", target)[0] == 4
    assert run("bank", "build", "--class", "cone", *SMALL, "-o", target, "--force")[0] == 0
    assert run("bank", "info", target)[0] == 0


@pytest.mark.parametrize(
    ("module", "extra", "arguments"),
    [
        ("rosbags.typesys", "ros", ["frames", "export", "f.h5", "--to", "rosbag", "-o", "bag"]),
        ("distributed", "dask", ["frames", "build", "plan.toml", "--scheduler", "tcp://localhost:1", "-o", "g.h5"]),
    ],
)
def test_a_missing_package_is_installed_from_the_clone(run, tmp_path, monkeypatch, module, extra, arguments):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plan.toml").write_text("views = 1", encoding="utf-8")
    assert run("frames", "build", "plan.toml", "-o", "f.h5")[0] == 0
    monkeypatch.setitem(sys.modules, module, None)
    code, _, err = run(*arguments)
    assert code == 2
    assert err.endswith(f": pip install -e '.[{extra}]' in the clone of phasemark\n")
