"""Values that no camera, plan or file should have, and names of users: one line and a code, or the right answer."""

import csv
import io
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from phasemark import UsageError
from phasemark.cli import main
from phasemark.data import BankPlan, FramePlan
from phasemark.data.files.csv_cell import as_cell
from phasemark.data.measured.csv_frames import parse_csv
from phasemark.data.partial_outputs import estimate_build
from phasemark.data.plans import planned_size
from phasemark.landmarks import build_mesh, catalog, export_mesh, read_mesh
from phasemark.landmarks.figures import mesh_html
from phasemark.render import Background, Renderer, Views, preset
from phasemark.render.integral.intersect import MOST_SCENES, EmbreeIntersector

HUGE = "9" * 5000
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "v 0 0 1\n"


@pytest.fixture
def answer(capsys, monkeypatch, tmp_path):
    """Run the command line in an empty folder; return its code and the line of its error."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        code = main(arguments)
        lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("note: ")]
        assert len(lines) == (code != 0)
        return code, "".join(lines)

    return run


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--max-size", f"{HUGE}GB"), "--max-size"),
        (("--shard", f"1/{HUGE}"), "--shard"),
        (("--scheduler", f"local:{HUGE}"), "--scheduler"),
        (("--distance", f"1:{HUGE}:1"), "distance_m"),
        (("--distance", "1:1e17:1e16"), "distance_m"),
    ],
)
def test_options_of_thousands_of_digits_are_one_line(answer, options, word):
    code, line = answer("bank", "build", "--class", "cone", "--distance", "1", "--delta", "0", *options, "-o", "b.h5")
    assert code == 2
    assert word in line
    assert len(line) < 300


@pytest.mark.parametrize(
    ("text", "code", "word"),
    [
        (f"distance_m = {HUGE}", 3, "thousands of digits"),
        (f"distance_m = {'9' * 400}", 2, "'distance_m' must hold finite numbers"),
        ('sensor = "a\\u0000b.toml"', 3, "null byte"),
        ("harmonics = [true]", 2, "'harmonics' must be a number, got true"),
        ("[sensor_overrides]\nread_noise_e = 1e300", 2, "'read_noise_e'"),
        ("[sensor_overrides]\nsignal_e = 1e-320", 2, "'signal_e'"),
        ("[sensor_overrides]\nsignal_e = true", 2, "'signal_e' must be a number, got true"),
    ],
)
def test_a_plan_with_a_value_that_cannot_be_is_one_line(answer, text, code, word):
    Path("plan.toml").write_text(text, encoding="utf-8")
    found, line = answer("plan", "check", "--kind", "bank", "plan.toml")
    assert found == code
    assert "plan.toml" in line or "null" in line
    assert word in line


@pytest.mark.parametrize("symmetry", ["", "symmetry = 1\n"])
@pytest.mark.parametrize("kind", ["bank", "frames", "sweep"])
def test_a_mesh_whose_path_holds_nul_is_refused_in_one_line(answer, kind, symmetry):
    Path("plan.toml").write_text(f'[[meshes]]\nname = "a"\npath = "a\\u0000.stl"\n{symmetry}', encoding="utf-8")
    run = {"sweep": ("sweep", "run", "plan.toml", "-o", "out")}
    for command in (
        ("plan", "check", "--kind", kind, "plan.toml"),
        run.get(kind, (kind, "build", "plan.toml", "-o", "out.h5")),
    ):
        code, line = answer(*command)
        assert code == 2
        said = "'path' must be the name of a file, which holds no NUL, got 'a\\x00.stl'"
        assert line == f"error: plan.toml: meshes.0: {said}"
    assert [str(path) for path in Path().iterdir()] == ["plan.toml"]


def test_a_build_beyond_the_limits_is_refused_before_its_size_is_noted(answer, monkeypatch):
    monkeypatch.setattr(
        "phasemark.data.partial_outputs.estimate_build", lambda *_, **__: pytest.fail("timed what cannot be built")
    )
    Path("many.toml").write_text('views = 6000000\nclasses = ["cone"]\n', encoding="utf-8")
    grid = ("--class", "cone", "--distance", "1:10:0.001", "--delta", "0:89.99:0.01")
    for command, what in (
        (("frames", "build", "many.toml", "-o", "f.h5"), "a frame set can have at most 5000000 views"),
        (("bank", "build", *grid, "--full", "-o", "b.h5"), "a bank can have at most 20000000 images"),
    ):
        code, line = answer(*command, "--max-size", "999999999TB")
        assert code == 2
        assert line.startswith(f"error: {what}")


@pytest.mark.parametrize("make", [
    lambda: Views.broadcast(1e17), lambda: Views.broadcast(1.0, height_m=-1e17), lambda: Background(wall_m=1e-320),
    lambda: Background(floor_m=1e308), lambda: FramePlan(views=1, wall_m=1e17), lambda: FramePlan(views=True),
    lambda: FramePlan(views=1, distance_m={"uniform": [True, 2.0]}), lambda: BankPlan(distance_m=1e17),
])  # fmt: skip
def test_lengths_beyond_a_thousand_kilometres_and_truth_values_are_refused(make):
    with pytest.raises(UsageError, match="must"):
        make()


def test_names_that_are_not_utf8_reach_banks_pages_and_recordings(answer):
    name = "caf\udce9"
    Path(f"{name}.stl").write_bytes(export_mesh(build_mesh(catalog()["cone"]), "stl"))
    fields = preset("ideal").model_dump()
    Path(f"{name}.toml").write_text(
        "".join(f"{key} = {fields[key]}\n" for key in ("rows", "cols", "half_angle_h_deg", "half_angle_v_deg")),
        encoding="utf-8",
    )
    sensor, mesh = ("--sensor", f"{name}.toml"), ("--mesh", f"part={name}.stl", "--unit", "m")
    assert answer("landmark", "show", f"{name}.stl", "--unit", "m", "-o", "shown") == (0, "")
    assert answer("bank", "build", *mesh, *sensor, "--distance", "1", "--delta", "0", "-o", f"{name}.h5") == (0, "")
    assert answer("bank", "verify", f"{name}.h5") == (0, "")
    assert (
        answer("bank", "build", *mesh, *sensor, "--distance", "1", "--delta", "0", "-o", f"{name}.h5", "--resume")[0]
        == 0
    )
    for suffix in ("csv", "npz", "h5"):
        assert answer("frames", "simulate", *mesh, *sensor, "--frames", "1", "-o", f"{name}-r.{suffix}") == (0, "")
    code, line = answer("sensor", "show", f"{name}.nosuch")
    assert code == 2
    assert r"caf\xe9.nosuch" in line


def test_a_plan_of_very_many_landmarks_is_refused():
    cone = catalog()["cone"].model_dump()
    many = [{**cone, "name": f"c{k}"} for k in range(257)]
    with pytest.raises(UsageError, match="at most 256 landmarks, got 257"):
        FramePlan(views=1, landmarks=many).resolve()


def test_the_ray_caster_refuses_the_scene_that_would_end_the_process(monkeypatch):
    pytest.importorskip("embreex")
    assert MOST_SCENES < 1000  # where Embree 4.4 crashes
    monkeypatch.setattr("phasemark.render.integral.intersect.MOST_SCENES", len(EmbreeIntersector._open))
    with pytest.raises(UsageError, match="landmarks can be rendered at the same time"):
        Renderer(build_mesh(catalog()["cone"]), preset("ideal"))


def test_a_dry_run_of_any_size_is_answered_from_arithmetic(answer, capsys):
    Path("many.toml").write_text('views = 1000000000\nclasses = ["cone"]\n', encoding="utf-8")
    assert main(["frames", "build", "many.toml", "--dry-run", "--max-size", "100TB", "-o", "f.h5"]) == 0
    assert "at most 5000000 views" in capsys.readouterr().out
    assert answer("frames", "build", "many.toml", "--max-size", "100TB", "-o", "f.h5")[0] == 2
    grid = ("--class", "cone", "--distance", "1:70001:1", "--delta", "0:89.999:0.001", "--max-size", "100TB")
    assert answer("bank", "build", *grid, "--dry-run", "-o", "b.h5") == (0, "")
    assert answer("bank", "build", *grid, "-o", "b.h5")[0] == 2
    assert not list(Path().glob("*.h5*"))


def test_the_time_of_a_large_plan_is_that_of_a_sample():
    plan = FramePlan(views=4_000_000, classes=["cone"], sensor="vl53l5cx-8x8", variants=[])
    found = estimate_build(plan, trial_seconds=0.0)
    assert found["views"] == 4_000_000
    assert 0 <= found["bytes"] - planned_size(plan)["bytes"] < 5e6  # header and meshes
    assert found["seconds"] > 0


@pytest.mark.parametrize("between", ["", "# a comment\n"])
def test_relative_indices_of_obj_count_back_from_their_face(between):
    base, tip = TETRAHEDRON
    relative = f"{base}f -3 -1 -2\n{between}{tip}f -4 -3 -1\nf -4 -1 -2\nf -3 -2 -1\n"
    absolute = f"{base}{tip}f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    mesh = read_mesh(relative.encode(), unit="m", file_type="obj")
    expected = read_mesh(absolute.encode(), unit="m", file_type="obj")
    assert np.array_equal(mesh.vertices[mesh.faces], expected.vertices[expected.faces])
    assert mesh.is_watertight


@pytest.mark.parametrize("text", [
    "OFF\n\n4 4 6\n\n0 0 0 \n 1 0 0\t\n\n0 1 0\n0 0 1\n3 0 2 1\n3  0 1 3\n3 0 3 2\n\n3 1 2 3\n",
    "\n  OFF  \n # solid\n 4 4 0 \n 0 0 0 \n 1 0 0 # x\n 0 1 0\n 0 0 1\n 3 0 2 1\n 3 0 1 3\n 3 0 3 2\n 3 1 2 3",
    "OFF 4 4\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n",
])  # fmt: skip
def test_off_files_may_have_blanks_and_comments_anywhere(text):
    assert read_mesh(text.encode(), unit="m", file_type="off").volume == pytest.approx(1 / 6)


@pytest.mark.parametrize("first", ['"1.0,1.1,1.2,1.3', '"1.0,1.1,1.2,1.3"'])
def test_a_first_frame_with_a_stray_quotation_mark_is_no_header(first):
    with pytest.raises(ValueError, match="line 1 has 1 values, must have 4"):
        parse_csv(f"{first}\n1.0,1.1,1.2,1.3\n".encode(), (2, 2), Path("frames.csv"))


def test_a_name_that_a_spreadsheet_would_run_is_written_as_text(answer):
    assert [as_cell(text) for text in ("=1+1", "+a", "-a", "@a", "-1.5", "cone", -1.5)] == [
        "'=1+1", "'+a", "'-a", "'@a", "-1.5", "cone", -1.5
    ]  # fmt: skip
    Path("a.stl").write_bytes(export_mesh(build_mesh(catalog()["cone"]), "stl"))
    assert answer("frames", "simulate", "--mesh", "=cmd=a.stl", "--unit", "m", "-o", "r.csv")[0] == 2
    assert answer("frames", "simulate", "--mesh", "@cmd=a.stl", "--unit", "m", "--frames", "1", "-o", "r.csv")[0] == 0
    *_, row = csv.reader(io.StringIO(Path("r.csv").read_text(encoding="utf-8")))
    assert row[-1] == "'@cmd"


def test_pages_forbid_whatever_they_do_not_hold():
    page = mesh_html(build_mesh(catalog()["cone"]), "cone")
    assert "Content-Security-Policy\" content=\"default-src 'none'; script-src 'unsafe-inline'" in page
    source = resources.files("phasemark.data.pages").joinpath("base.html.j2").read_text("utf-8")
    assert (
        "Content-Security-Policy\" content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\"" in source
    )
