"""Plans of banks: TOML in, everything explicit out."""

import json

import numpy as np
import pytest
from pydantic import ValidationError

from phasemark import InputFileError, UsageError
from phasemark.data import BankPlan
from phasemark.data.plans import MeshPlan, read_bank_plan
from phasemark.data.plans.bank_plan import factored_refusal
from phasemark.landmarks import catalog
from phasemark.matcher.plan_kinds import KINDS, plan_schema
from phasemark.render import preset

PART = {"name": "part", "path": "part.stl", "unit": "mm"}
OTHER_BOX = {
    "name": "mast",
    "box": {"length_m": 0.2, "width_m": 0.2, "height_m": 0.15},
    "upper": {"kind": "cylinder", "radius_m": 0.02, "height_m": 0.4},
}


BOX = "box = { length_m = 0.3, width_m = 0.3, height_m = 0.3 }"


def plan_file(tmp_path, text):
    path = tmp_path / "plan.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_default_plan_is_the_catalogue_on_141_distances_and_180_angles():
    plan = BankPlan().resolve()
    assert [spec.name for spec in plan.landmarks] == list(catalog())
    assert (len(plan.distance_m), plan.distance_m[0], plan.distance_m[-1]) == (141, 0.7, 2.1)
    assert plan.delta_deg == tuple(range(180))
    np.testing.assert_array_equal(plan.delta_rad, np.deg2rad(np.arange(180)))


def test_a_mesh_without_declared_symmetry_is_seen_from_360_sides():
    assert BankPlan(meshes=[PART]).resolve().delta_deg == tuple(range(360))
    assert BankPlan(meshes=[{**PART, "symmetry": 3}]).resolve().delta_deg == tuple(range(120))


def test_angles_cover_the_common_period_of_all_landmarks():
    assert len(BankPlan(landmarks=[OTHER_BOX]).resolve().delta_deg) == 90
    assert len(BankPlan(classes=["cone"], landmarks=[OTHER_BOX]).resolve().delta_deg) == 180
    assert len(BankPlan(classes=["cone"], meshes=[PART]).resolve().delta_deg) == 360


def test_a_resolved_plan_is_explicit_and_survives_json():
    plan = BankPlan(classes=["cone"], delta_deg="0:180:45", sensor_overrides={"contrast": 0.4}, albedo=0.3).resolve()
    again = BankPlan(**json.loads(plan.model_dump_json()))
    assert again == plan
    assert again.resolve() == plan
    assert again.build_sensor() == preset("pmd-16x16").with_(contrast=0.4)
    assert again.landmarks[0].albedo == 0.3
    assert json.loads(plan.model_dump_json())["delta_deg"] == "0:135:45"


def test_plans_are_frozen():
    with pytest.raises(ValidationError, match="frozen"):
        BankPlan().layout = "full"


def test_a_plan_file_sets_every_key(tmp_path):
    (tmp_path / "my.toml").write_text("rows = 8\ncols = 8\nhalf_angle_h_deg = 20\nhalf_angle_v_deg = 20\n")
    path = plan_file(
        tmp_path,
        """
        classes = ["cone", "post"]
        sensor = "./my.toml"
        distance_m = "1:2:0.5"
        delta_deg = [0, 30]
        model = "ray"
        layout = "full"
        harmonics = [3, 5]
        [sensor_overrides]
        contrast = 0.4
        [[meshes]]
        name = "part"
        path = "parts/part.stl"
        unit = "mm"
        symmetry = 2
        albedo = 0.5
        """,
    )
    plan = read_bank_plan(path)
    assert plan.classes == ("cone", "post")
    assert plan.distance_m == (1.0, 1.5, 2.0)
    assert plan.delta_deg == (0.0, 30.0)
    assert plan.harmonics == (3, 5)
    assert plan.meshes == (
        MeshPlan(name="part", path=str(tmp_path / "parts/part.stl"), unit="mm", symmetry=2, albedo=0.5),
    )
    assert (plan.build_sensor().rows, plan.build_sensor().contrast) == (8, 0.4)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("colour = 1", "unknown key 'colour'"),
        ("model = 'wave'", "'model' must be 'ray', 'hard' or 'planar', got 'wave'"),
        ("layout = 1", "'layout' must be 'factored' or 'full', got 1"),
        ("distance_m = '1:2:0'", "'distance_m' must have a positive STEP, got '1:2:0'"),
        ("distance_m = '0:2:1'", "'distance_m' must be positive throughout, got 0.0"),
        ("distance_m = [2, 1]", "'distance_m' must increase"),
        ("delta_deg = 'all'", "'delta_deg' must hold finite numbers, got 'all'"),
        ("albedo = 2.0", "'albedo' must be less than or equal to 1, got 2.0"),
        ("harmonics = [5, 3]", "'harmonics' must increase"),
        ("harmonics = [1]", "'harmonics.0' must be greater than or equal to 2, got 1"),
        ("[[meshes]]\nname = 'a'\nunit = 'mm'", "meshes.0: 'path' is missing"),
        ("[[meshes]]\nname = 'a/b'\npath = 'a.stl'\nunit = 'm'", "'name'"),
        ("distanz_m = '1'", "unknown key 'distanz_m': did you mean 'distance_m'?"),
        (
            "views = 3",
            "unknown key 'views': there are classes, landmarks, meshes, sensor, sensor_overrides",
        ),
        ("harmonics = 3", "'harmonics' must be a list, got 3"),
        ("harmonics = ['x']", "'harmonics.0' must be a whole number, got 'x'"),
        ("albedo = 'bright'", "'albedo' must be a number, got 'bright'"),
        ("sensor = 3", "'sensor' must be a string, got 3"),
        ("sensor_overrides = 3", "'sensor_overrides' must be a table, got 3"),
        (
            "[[meshes]]\nname = 'a/b'\npath = 'a.stl'",
            "'name' must begin with a letter or digit and hold only letters, digits, '_', '.' and '-', got 'a/b'",
        ),
        (f"[[meshes]]\nname = '{'a' * 101}'\npath = 'a.stl'", "'name' must have at most 100 characters, got 'aaa"),
        (f"[[landmarks]]\nname = 'a'\n{BOX}\nupper = {{}}", "landmarks.0: 'upper.kind' is missing"),
        (
            f"[[landmarks]]\nname = 'a'\n{BOX}\nupper = {{ kind = 'ball' }}",
            "'upper.kind' must be one of 'cylinder', 'cone', 'sphere', 'revolution', got 'ball'",
        ),
        (
            "[[meshes]]\nname = 'a'\npath = 'a.stl'\nunit = 'ft'",
            "meshes.0: 'unit' must be 'm', 'cm', 'mm' or 'inch', got 'ft'",
        ),
    ],
)
def test_a_wrong_plan_is_one_line_with_file_key_value_and_remedy(tmp_path, text, reason):
    path = plan_file(tmp_path, text)
    with pytest.raises(UsageError) as caught:
        read_bank_plan(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert reason in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"classes": ["pyramid"]}, "unknown class 'pyramid': the catalogue has cylinder, cone, sphere, post"),
        ({"classes": ["cone", "cone"]}, "'cone' names two landmarks"),
        ({"classes": ["cone"], "meshes": [{**PART, "name": "cone"}]}, "'cone' names two landmarks"),
        ({"meshes": [{**PART, "name": "none"}]}, "'none' stands for no landmark"),
        ({"sensor": "kinect"}, "unknown sensor 'kinect'"),
        ({"sensor_overrides": {"contrast": 2}}, "'contrast' must be"),
        ({"sensor_overrides": {"colour": 2}}, "'sensor_overrides': unknown key 'colour'"),
        ({"region": [0, 1, 2]}, r"'region' must be whole, landmark or \[first row, .*\], got \[0, 1, 2\]"),
        ({"region": [-1, 4, 0, 4]}, r"'region' must be whole, landmark or \[first row, .*\], got \[-1, 4, 0, 4\]"),
    ],
)
def test_what_does_not_exist_is_named(fields, reason):
    with pytest.raises(UsageError, match=reason):
        BankPlan(**fields).resolve()


def test_an_unreadable_plan_is_an_input_error(tmp_path):
    with pytest.raises(InputFileError, match=r"absent\.toml: cannot be read"):
        read_bank_plan(tmp_path / "absent.toml")
    with pytest.raises(InputFileError, match="not a TOML file"):
        read_bank_plan(plan_file(tmp_path, "classes = ["))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({}, None),
        ({"landmarks": [OTHER_BOX]}, None),
        ({"meshes": [PART]}, "'part' comes from a mesh file"),
        ({"landmarks": [{**OTHER_BOX, "upper": None}]}, "'mast' has no upper part"),
        ({"classes": ["cone"], "landmarks": [OTHER_BOX]}, "'cone' and 'mast' stand on different boxes"),
        ({"sensor_overrides": {"pitch_deg": 1}}, "tilted (pitch 1°, roll 0°)"),
        ({"sensor_overrides": {"roll_deg": -2}}, "tilted (pitch 0°, roll -2°)"),
        ({"sensor_overrides": {"rows": 15}}, "odd number of rows (15)"),
        ({"sensor_overrides": {"principal_point_px": (8, 7.5)}}, "meets the image at row 7.5"),
        ({"sensor_overrides": {"principal_point_px": (7.5, 8)}}, None),
    ],
)
def test_only_a_bank_that_cannot_be_factored_says_why(fields, reason):
    found = factored_refusal(BankPlan(**fields).resolve())
    assert found is None if reason is None else reason in found


@pytest.mark.parametrize("kind", KINDS)
def test_every_pattern_of_a_plan_is_put_into_words(kind):
    def patterns(schema):
        found = [schema["pattern"]] if isinstance(schema.get("pattern"), str) else []
        inner = [value for value in schema.values() if isinstance(value, dict)]
        inner += [one for value in schema.values() if isinstance(value, list) for one in value if isinstance(one, dict)]
        return found + [pattern for one in inner for pattern in patterns(one)]

    for pattern in patterns(plan_schema(kind)):
        message = f"String should match pattern '{pattern}'"  # as pydantic writes it
        assert "^" not in str(UsageError.of_field(("name",), "string_pattern_mismatch", message, "a b"))
