"""No command writes what it reads, whatever the name: files are compared by device and inode."""

import os

import pytest
import typer

from phasemark import UsageError
from phasemark.cli import app, main
from phasemark.data import BankPlan, build_bank
from phasemark.data.commands.command import OUTPUTS
from phasemark.data.files.same_file import refuse_inputs
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import build_mesh, catalog, export_mesh
from phasemark.matcher.plan_kinds import plan_example

SENSOR = "rows = 8\ncols = 8\nhalf_angle_h_deg = 11\nhalf_angle_v_deg = 11\n"
SWEEP = 'name = "x"\nclasses = ["cone"]\n[axes]\ndistance_m = [1.0]\n[[methods]]\nname = "n"\nmethod = "nearest"\n'


@pytest.fixture
def given(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "part.stl").write_bytes(export_mesh(build_mesh(catalog()["post"]), "stl"))
    (tmp_path / "cam.toml").write_text(SENSOR)
    (tmp_path / "frames.csv").write_text("1,2\n")
    (tmp_path / "ladder.npz").write_bytes(b"")
    (tmp_path / "frames.toml").write_text("views = 1\n")
    (tmp_path / "bank.toml").write_text('classes = ["cone"]\n')
    (tmp_path / "sweep.toml").write_text(SWEEP)
    for kind in ("design", "drive"):
        (tmp_path / f"{kind}.toml").write_text(plan_example(kind))
    (tmp_path / "dir").mkdir()
    return tmp_path


CASES = {
    "sensor show": ("cam.toml", "out.png", "cam.toml --picture out.png"),
    "sensor characterise": ("cam.toml", "dir/points.csv", "cam.toml --out dir"),
    "sensor fit": ("frames.csv", "out.toml", "frames.csv --distance 1 --out out.toml"),
    "sensor fit-direct": ("frames.csv", "out.toml", "ladder.npz --object frames.csv,part.stl --out out.toml"),
    "sensor import": ("cam.toml", "out.toml", "frames.csv --like cam.toml --out out.toml"),
    "landmark show": ("part.stl", "dir/part.png", "part.stl --unit m --out dir"),
    "landmark export": ("cone", "out.stl", "cone --out out.stl"),
    "landmark design": ("design.toml", "dir/pareto.csv", "design.toml --out dir"),
    "render": ("part.stl", "out.npz", "--mesh p=part.stl --unit m --out out.png"),
    "bank build": ("part.stl", "out.stl", "--mesh p=part.stl --unit m --distance 1:1.1:0.1 --out out.stl"),
    "bank merge": ("frames.csv", "out.h5", "frames.csv --out out.h5"),
    "frames build": ("frames.toml", "out.h5.sha256", "frames.toml --out out.h5"),
    "frames merge": ("frames.csv", "out.h5.partial", "frames.csv --out out.h5"),
    "frames export": ("frames.csv", "out.npz", "frames.csv --to npz --out out.npz"),
    "frames import": ("frames.csv", "out.npz", "frames.csv --unit m --quantity z --out out.npz"),
    "frames simulate": ("part.stl", "out.csv", "--mesh p=part.stl --unit m --out out.csv"),
    "frames show": ("frames.csv", "out.png", "frames.csv --unit m --quantity z --out out.png"),
    "calibrate": ("frames.csv", "out.png", "cone frames.csv --poses p.csv --out out.toml"),
    "live": ("frames.csv", "out.jsonl", "frames.csv --landmark cone --to jsonl:out.jsonl"),
    "locate": ("frames.csv", "out.csv", "cam.toml cam.toml frames.csv --out out.csv"),
    "sweep run": ("sweep.toml", "dir/cells.csv", "sweep.toml --out dir"),
    "drive": ("drive.toml", "dir/path.csv", "drive.toml --out dir"),
}
ELSEWHERE = {"match": "test_match_refuses_pictures_and_estimates_over_its_inputs", "demo": "reads no file",
             "sweep frames": "test_sweep.py"}  # fmt: skip


@pytest.mark.parametrize("command", CASES)
def test_an_output_that_is_an_input_is_refused(given, capsys, command):
    source, target, rest = CASES[command]
    source = given / source
    if command == "landmark export":  # its argument is a class, unless a file has that name
        source.write_text("mine")
    os.link(source, given / target)
    before = source.read_bytes()
    code = main([*command.split(), *rest.split(), "--force"])
    error = capsys.readouterr().err.splitlines()[-1]
    assert (code, source.read_bytes()) == (2, before), error
    assert "is the same file as the input" in error


def test_every_command_with_an_output_has_a_case():
    def commands(command, path):
        for name, one in getattr(command, "commands", {}).items():
            yield from commands(one, [*path, name])
        if not hasattr(command, "commands"):
            yield " ".join(path), {parameter.name for parameter in command.params}

    found = {name for name, names in commands(typer.main.get_command(app), []) if names & set(OUTPUTS)}
    assert found == {*CASES, *ELSEWHERE}


def test_match_refuses_pictures_and_estimates_over_its_inputs(given, capsys):
    assert main("bank build --class cone --distance 1:1.1:0.1 --delta 0:180:90 --out bank.h5".split()) == 0
    (given / "cone.csv").write_text(",".join(["1.0"] * 256))
    os.link("cone.csv", "out.png")
    match = "match bank.h5 cone.csv --unit m --quantity range --force".split()
    for option in (["--estimates", "cone.csv"], ["--plot", "out.png"]):
        assert main([*match, *option]) == 2
        assert "input" in capsys.readouterr().err


def test_what_a_plan_names_is_an_input_in_the_library_too(given):
    plan = BankPlan(meshes=(MeshPlan(name="p", path=str(given / "part.stl"), unit="m"),), distance_m="1:1.1:0.1")
    before = (given / "part.stl").read_bytes()
    with pytest.raises(UsageError, match="is an input too"):
        build_bank(plan, given / "part.stl", force=True)
    assert (given / "part.stl").read_bytes() == before


def test_the_checksum_of_an_input_belongs_to_it_and_a_link_is_what_it_leads_to(tmp_path):
    for name in ("a", "a.sha256"):
        (tmp_path / name).write_text(name)
    with pytest.raises(UsageError, match=r"a\.sha256: is an input too"):
        refuse_inputs([tmp_path / "a.sha256"], [tmp_path / "a"])
    (tmp_path / "link").symlink_to("a")
    with pytest.raises(UsageError, match=r"link: is the same file as the input '.*a'"):
        refuse_inputs([tmp_path / "link"], [tmp_path / "a"])
    refuse_inputs([tmp_path / "b"], [tmp_path / "a", tmp_path / "none"])
