"""The formats: files of every version that was released open, plans explain themselves, other programs read ours."""

import hashlib
import json
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from programs.regenerate_golden import BANK, BANK_PLAN, FRAMES, FRAMES_PLAN

from phasemark import InputFileError, UsageError
from phasemark.cli import main
from phasemark.data import build_bank, build_frames, open_bank, open_frames
from phasemark.data.verify import verify_bank, verify_frames
from phasemark.matcher.plan_kinds import KINDS, check_plan, plan_example, plan_schema

DOCS = Path(__file__).parent.parent / "docs"


def test_the_golden_bank_of_version_1_opens_and_is_what_is_built_today(tmp_path):
    with open_bank(BANK) as golden, build_bank(BANK_PLAN, tmp_path / "bank.h5") as built:
        assert golden.classes == built.classes == ("cone",)
        for i, j in np.ndindex(2, 2):
            # across machines: docs/formats.md promises 1e-5 of the brightest pixel
            atol = 1e-5 * np.abs(golden.phasor("cone", i, j)).max()
            np.testing.assert_allclose(built.phasor("cone", i, j), golden.phasor("cone", i, j), rtol=0, atol=atol)


def test_the_golden_frames_of_version_1_open_and_are_what_is_built_today(tmp_path):
    with open_frames(FRAMES) as golden, build_frames(FRAMES_PLAN, tmp_path / "frames.h5") as built:
        assert golden.plan.resolve() == built.plan  # which fills in fields of the sensor that came later
        old, new = golden[:], built[:]
        assert old.keys() == new.keys()
        for name in ("range_m", "range_hard_m", "range_mixed_m"):
            np.testing.assert_allclose(new[name], old[name], rtol=0, atol=1e-5)  # metres, across machines
        np.testing.assert_array_equal(old["flags"], new["flags"])
        np.testing.assert_array_equal(old["distance_m"], new["distance_m"])


def test_the_golden_files_verify():
    verify_bank(BANK)
    verify_frames(FRAMES)


@pytest.mark.parametrize(("golden", "read"), [(BANK, open_bank), (FRAMES, open_frames)])
def test_a_newer_version_is_refused_by_its_number(tmp_path, golden, read):
    path = tmp_path / golden.name
    shutil.copy(golden, path)
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = 2
    with pytest.raises(InputFileError, match="has schema version 2, this phasemark reads 1: update phasemark"):
        read(path)


def test_netcdf4_reads_the_files():
    netcdf4 = pytest.importorskip("netCDF4")
    with netcdf4.Dataset(FRAMES) as file, open_frames(FRAMES) as frames:
        assert file["range"].dimensions == ("frame", "row", "col")
        assert file["range"].units == "m"
        np.testing.assert_array_equal(np.ma.filled(file["range"][:], np.nan), frames[:]["range_m"])
    with netcdf4.Dataset(BANK) as file:
        assert file["lower/phasor"].dimensions == ("distance", "delta", "frequency", "row", "col", "iq")


@pytest.mark.skipif(shutil.which("h5dump") is None, reason="HDF5's own tools are not installed")
@pytest.mark.parametrize(
    ("golden", "name", "kind"),
    [(FRAMES, "range", "f4"), (FRAMES, "flags", "u1"), (FRAMES, "distance", "f8"), (BANK, "lower/phasor", "f4")],
)
def test_h5dump_reads_values_dimensions_and_units(tmp_path, golden, name, kind):
    values = tmp_path / "values"
    command = ["h5dump", "-d", f"/{name}", "-b", "LE", "-o", values, golden]
    subprocess.run(command, capture_output=True, check=True)
    with h5py.File(golden) as file:
        dataset = file[name]
        np.testing.assert_array_equal(np.fromfile(values, f"<{kind}").reshape(dataset.shape), dataset[...])
        shape, units = dataset.shape, dataset.attrs["units"]
    said = subprocess.run(["h5dump", "-A", "-d", f"/{name}", golden], capture_output=True, text=True, check=True).stdout
    assert f"SIMPLE {{ ( {', '.join(map(str, shape))} )" in said
    assert "DIMENSION_LIST" in said
    assert f'"{units}"' in said


@pytest.mark.parametrize(
    ("kind", "key"), [("frames", "views"), ("sweep", "methods"), ("drive", "path"), ("bank", "model")]
)
def test_a_misspelt_key_is_named_whatever_the_kind(tmp_path, kind, key):
    path = tmp_path / "plan.toml"
    text, count = re.subn(rf"^(\[{{0,2}}){key}\b", rf"\g<1>{key}x", plan_example(kind), flags=re.MULTILINE)
    assert count > 0
    path.write_text(text, encoding="utf-8")
    with pytest.raises((UsageError, InputFileError), match=f"{key}x"):
        check_plan(path)


@pytest.mark.parametrize("kind", KINDS)
def test_the_example_of_a_plan_is_a_plan_and_fits_its_schema(tmp_path, kind):
    path = tmp_path / "plan.toml"
    path.write_text(plan_example(kind), encoding="utf-8")
    found, plan = check_plan(path)
    assert found == kind
    given = type(plan)(**tomllib.loads(plan_example(kind)))
    runs_a_program = kind == "scenes"  # to resolve it, and a check runs none
    assert plan == (given.resolve() if hasattr(given, "resolve") and not runs_a_program else given)
    assert plan == check_plan(path, kind)[1]
    schema = plan_schema(kind)
    assert set(tomllib.loads(plan_example(kind))) <= set(schema["properties"])
    assert schema["additionalProperties"] is False
    assert set(schema["properties"]) == set(type(plan).model_fields)


def test_plan_commands_print_and_check(tmp_path, capsys):
    assert main(["plan", "example", "frames"]) == 0
    path = tmp_path / "plan.toml"
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    assert main(["plan", "check", str(path), "--json"]) == 0
    checked = json.loads(capsys.readouterr().out)
    assert checked["kind"] == "frames"
    assert checked["plan"]["views"] == 1000
    assert main(["plan", "schema", "bank"]) == 0
    assert "distance_m" in json.loads(capsys.readouterr().out)["properties"]
    path.write_text(path.read_text(encoding="utf-8").replace("views = 1000", "views = -1"), encoding="utf-8")
    assert main(["plan", "check", str(path)]) == 2
    assert re.search(r"plan\.toml: 'views' must be .* got -1", capsys.readouterr().err)
    assert main(["plan", "schema", "tour"]) == 2
    assert "'tour' is not one of 'bank', 'frames', 'scenes', 'sweep', 'drive'" in capsys.readouterr().err
    with pytest.raises(UsageError, match="unknown kind of plan 'tour'"):
        plan_schema("tour")


CONE = 'classes = ["cone"]\n'
MESH = '[[meshes]]\nname = "part"\npath = "{}"\n'
SWEEP = 'name = "x"\nbank_distance_m = [0.9, 1.1]\nmethods = [{{ name = "n", method = "nearest"{} }}]\n'


@pytest.mark.parametrize(
    ("kind", "text", "code", "part"),
    [
        ("bank", CONE + 'distance_m = "0.05:0.5:0.05"', 2, "the lens is inside the landmark's bounding box"),
        ("bank", MESH.format("missing.stl") + 'unit = "m"', 3, "missing.stl: cannot be read"),
        ("bank", MESH.format("cube.stl"), 2, "cube.stl: say in which unit it is"),
        ("bank", 'model = "planar"\n' + MESH.format("cube.stl") + 'unit = "m"', 2, "'model' must be 'ray' or 'hard'"),
        ("bank", 'layout = "factored"\n' + MESH.format("cube.stl") + 'unit = "m"', 2, "no factored bank"),
        ("frames", CONE + "views = 9\ndistance_m = { uniform = [0.05, 0.3] }", 2, "the lens is inside"),
        ("frames", CONE + "views = 9\nwall_m = 0.6", 2, "the wall at 0.6 m is before"),
        ("frames", CONE + "views = 9\nfloor_m = 0.05", 2, "the floor 0.05 m below the lens is above"),
        ("frames", CONE + "views = 9\npitch_deg = 89", 2, "turn the landmark out of the image"),
        ("frames", "views = 9\n" + MESH.format("missing.stl") + 'unit = "m"', 3, "missing.stl: cannot be read"),
        ("sweep", CONE + SWEEP.format("") + "axes = { wall_m = [0.8] }", 2, "condition 0: the wall at 0.8 m is before"),
        (
            "sweep", CONE + SWEEP.format("").replace("0.9", "0.05") + "axes = { distance_m = [0.1] }", 2,
            "condition 0: in view 0 the lens is inside",
        ),
        (
            "sweep", 'sensor = "vl53l5cx-8x8"\n' + SWEEP.format("") + "axes = { noise_factor = [1, 2] }", 2,
            "condition 1: 'signal_e' must be left out",
        ),
        (
            "sweep", 'sensor = "vl53l5cx-8x8"\n' + SWEEP.format(', on = "phasors"').replace("nearest", "refine"), 2,
            "method 'n': on=\"phasors\" needs amplitudes",
        ),
        ("sweep", SWEEP.format("") + MESH.format("missing.stl") + 'unit = "m"', 3, "missing.stl: cannot be read"),
        (
            "sweep", SWEEP.format(', bank_model = "planar"') + MESH.format("cube.stl") + 'unit = "m"', 2,
            "'model' must be 'ray' or 'hard'",
        ),
        ("drive", "another class", 2, "'map.landmark.class' must be one of cylinder, cone, sphere, post, got 'nosuch'"),
        ("design", 'sensor = "nosuch"', 2, "unknown sensor 'nosuch'"),
    ],
)  # fmt: skip
def test_a_plan_that_a_build_would_refuse_is_refused_by_its_check(
    tmp_path, monkeypatch, capsys, kind, text, code, part
):
    monkeypatch.chdir(tmp_path)
    trimesh.creation.box((0.2, 0.1, 0.3)).export("cube.stl")
    if kind == "drive":
        text = re.sub('class = "[^"]*"', 'class = "nosuch"', plan_example("drive"), count=1)
    Path("plan.toml").write_text(text, encoding="utf-8")
    assert main(["plan", "check", "--kind", kind, "plan.toml"]) == code
    done = capsys.readouterr()
    assert done.out == ""
    *_, line = done.err.splitlines()
    assert line.startswith("error: ")
    assert part in line


@pytest.mark.parametrize("golden", [BANK, FRAMES], ids=["bank", "frames"])
def test_the_documentation_has_a_row_for_every_dataset_and_attribute(golden):
    """docs/formats.md is the contract: what lies in a file is in its tables."""
    text = (DOCS / "formats.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([^`\n]+)`", text))
    with h5py.File(golden) as file:
        found = set(file.attrs)

        def note(name, item):
            if isinstance(item, h5py.Dataset):
                found.add(name.split("/")[-1])

        file.visititems(note)
    assert found - named == set()


def test_the_checksum_is_that_of_sha256sum():
    digest, name = (BANK.parent / "bank-v1.h5.sha256").read_text().split()
    assert (digest, name) == (hashlib.sha256(BANK.read_bytes()).hexdigest(), "bank-v1.h5")
