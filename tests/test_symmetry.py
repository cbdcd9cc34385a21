"""The symmetry of meshes, found from their surface, and what a bank makes of it."""

import time

import h5py
import numpy as np
import pytest
import trimesh

from phasemark.cli import main
from phasemark.data import BankPlan, FramePlan, build_bank
from phasemark.landmarks import build_mesh, catalog, check_mesh, export_mesh, mesh_symmetry
from phasemark.landmarks.mesh_files import MeshWarning
from phasemark.landmarks.symmetry import has_symmetry, symmetry_tolerance_m
from phasemark.matcher import Matcher, kalman_filter, robot_poses
from phasemark.render import Renderer, capture


def box(length, width, height, at=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.box((length, width, height))
    mesh.apply_translation(at)
    return mesh


def table(thicker_m=0.0):
    """A table 0.3 m wide on four legs, the first of which is thicker."""
    legs = [
        box(width, width, 0.2, (0.12 * x, 0.12 * y, 0.1))
        for x, y, width in ((1, 1, 0.04 + thicker_m), (1, -1, 0.04), (-1, 1, 0.04), (-1, -1, 0.04))
    ]
    return trimesh.util.concatenate([box(0.3, 0.3, 0.02, (0, 0, 0.21)), *legs])


def prism(sides, radius=0.1):
    return trimesh.creation.cylinder(radius, 0.2, sections=sides)


def bracket():
    return trimesh.util.concatenate([box(0.2, 0.04, 0.2), box(0.04, 0.16, 0.2, (0.08, 0.1, 0.0))])


def finely(mesh, faces=100_000):
    while len(mesh.faces) < faces:
        mesh = mesh.subdivide()
    return mesh


def plate_with_a_hole():
    """A square plate with a hole beside its middle: the rim's points, turned, lie on the plate all the same."""
    plate = box(0.2, 0.2, 0.02)
    return trimesh.boolean.difference(
        [plate, trimesh.creation.cylinder(0.01, 0.05, sections=32, transform=_moved(0.05))]
    )


def _moved(x_m):
    transform = np.eye(4)
    transform[0, 3] = x_m
    return transform


@pytest.mark.parametrize(
    ("mesh", "n"),
    [
        (box(0.24, 0.16, 0.1), 2),
        (box(0.2, 0.2, 0.1), 4),
        (box(0.2, 0.2, 0.1, (0.03, 0.0, 0.0)), 1),  # the axis is z', not that of the box
        (table(), 4),
        (table(0.002), 1),
        (bracket(), 1),
        (prism(3), 3),
        (trimesh.creation.cone(0.1, 0.2, sections=3), 3),  # a tetrahedron on its foot
        (prism(6), 6),
        (prism(7), 7),
        (prism(12), 12),
        # 1° moves its outline by 0.2 mm only, but 6° by 0.6 mm: many small steps add up
        (prism(28), 28),
        (plate_with_a_hole(), 1),
        # 0.5 mm is nothing to a camera: flat sides of 256 differ from a cylinder by 8 µm
        (prism(256), 360),
        (trimesh.creation.icosphere(5, 0.1), 360),
    ],
    ids=lambda value: str(value) if isinstance(value, int) else f"{len(value.faces)} faces",
)
def test_the_symmetry_of_a_mesh_is_that_of_its_shape(mesh, n):
    assert check_mesh(mesh).symmetry == n
    assert has_symmetry(mesh, n)


@pytest.mark.parametrize("name", catalog())
def test_the_catalogue_has_the_symmetry_that_its_boxes_say(name):
    mesh = build_mesh(catalog()[name], tolerance_m=1e-4)
    assert mesh_symmetry(mesh) == catalog()[name].symmetry == 2


def test_what_differs_by_less_than_the_tolerance_is_the_same():
    # legs that are thicker by t on each side's half: the outermost points move by t/2 · √2
    assert symmetry_tolerance_m(table()) == 0.5e-3
    assert mesh_symmetry(table(0.0006)) == 4
    assert mesh_symmetry(table(0.0011)) == 1
    small = box(0.02, 0.0195, 0.01)  # 0.5 mm is 2.5 % of it
    assert symmetry_tolerance_m(small) == pytest.approx(0.2e-3)
    assert mesh_symmetry(small) == 2


@pytest.mark.parametrize(("thicker_m", "n"), [(0.0, 4), (0.002, 1)])
def test_a_mesh_of_many_faces_takes_no_two_seconds(thicker_m, n):
    mesh = finely(table(thicker_m))
    start = time.process_time()  # of this process alone: other tests run beside it
    assert mesh_symmetry(mesh) == n
    assert time.process_time() - start < 2
    assert len(mesh.faces) >= 100_000


def test_the_same_mesh_has_the_same_symmetry_however_its_faces_lie():
    mesh = finely(prism(6), 2000)
    rng = np.random.default_rng(1)
    shuffled = trimesh.Trimesh(mesh.vertices, rng.permutation(mesh.faces), process=False)
    open_lid = trimesh.Trimesh(mesh.vertices, mesh.faces[mesh.triangles_center[:, 2] < 0.09], process=False)
    assert [mesh_symmetry(one) for one in (mesh, shuffled, open_lid)] == [6, 6, 6]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    for name, mesh in (("table", table()), ("bracket", bracket()), ("can", prism(256, 0.08))):
        (folder / f"{name}.stl").write_bytes(export_mesh(mesh, "stl"))
    return folder


def plan_of(files, name, **fields):
    part = {"name": name, "path": str(files / f"{name}.stl"), "unit": "m", **fields}
    return BankPlan(meshes=[part], layout="full", distance_m="0.9:1.1:0.1")


def test_a_plan_finds_the_symmetry_and_the_grid_of_angles_follows(files):
    for name, n in (("table", 4), ("bracket", 1), ("can", 360)):
        plan = plan_of(files, name).resolve()
        assert plan.meshes[0].symmetry == n
        assert plan.delta_deg == tuple(range(360 // n))
        assert plan.resolve() == plan
    assert plan_of(files, "table", symmetry=1).resolve().delta_deg == tuple(range(360))
    both = BankPlan(classes=["cone"], meshes=plan_of(files, "table").meshes).resolve()
    assert len(both.delta_deg) == 180  # the cone's box repeats every 180°
    frames = FramePlan(meshes=plan_of(files, "table").meshes, views=1, seed=1).resolve()
    assert frames.meshes[0].symmetry == 4


def test_a_match_of_a_table_leaves_four_poses(files):
    plan = plan_of(files, "table").model_copy(update={"delta_deg": tuple(range(0, 90, 5))})
    with build_bank(plan) as bank:
        assert bank.mesh("table").metadata["symmetry"] == 4
        image = Renderer(bank.mesh("table"), bank.sensor, albedo=0.8).render(1.0, np.deg2rad(20 + 270))
        frames = capture(image, bank.sensor, rng=np.random.default_rng(3), n_frames=50)
        match = Matcher(bank).match(kalman_filter(frames))[0]
    assert match.class_name == "table"
    poses = robot_poses(match, landmark_xy_m=(0.0, 0.0), landmark_yaw_rad=0.0, pan_rad=0.0)
    assert len(poses) == 4
    truth = np.array([np.cos(np.deg2rad(290)), np.sin(np.deg2rad(290))])
    # half a step of the bank's grid, 5 cm and 2.5°, at 1 m
    assert min(np.hypot(pose.x_m - truth[0], pose.y_m - truth[1]) for pose in poses) < 0.1


@pytest.mark.parametrize("method", ["nearest", "refine"])
def test_a_body_of_revolution_is_matched_at_its_only_angle(files, method):
    with build_bank(plan_of(files, "can")) as bank:
        assert bank.delta_rad.tolist() == [0.0]
        image = Renderer(bank.mesh("can"), bank.sensor, albedo=0.8).render(1.0, 2.0)
        frames = capture(image, bank.sensor, rng=np.random.default_rng(3), n_frames=50)
        match = Matcher(bank, method=method).match(kalman_filter(frames))[0]
    assert match.accepted
    assert match.distance_m == pytest.approx(1.0, abs=0.002)


@pytest.mark.parametrize(("stated", "words"), [(3, "120° .* found: 4"), (2, "90° it is the same: .*: 4")])
def test_a_symmetry_that_is_not_that_of_the_mesh_is_doubted(files, stated, words):
    with pytest.warns(MeshWarning, match=rf"symmetry {stated} is stated for 'table', but turned by {words}"):
        build_bank(plan_of(files, "table", symmetry=stated).model_copy(update={"delta_deg": (0.0,)})).close()


def test_the_commands_say_what_was_found(files, tmp_path, capsys):
    def run(*arguments):
        code = main([*map(str, arguments)])
        out, err = capsys.readouterr()
        assert code == 0, err
        return out, err

    small = ("--unit", "m", "--distance", "1.0:1.1:0.1")
    out = tmp_path / "table.h5"
    _, err = run("bank", "build", "--mesh", f"table={files / 'table.stl'}", *small, "-o", out, "--delta", "0:90:45")
    assert "note: 'table' looks the same every 90° (symmetry 4)" in err
    assert "--symmetry N" in err
    with h5py.File(out) as file:
        assert file["meshes/table"].attrs["delta_period_deg"] == 90
        assert file["full/delta"][...].tolist() == [0, 45]
    _, err = run("bank", "build", "--mesh", f"part={files / 'bracket.stl'}", *small, "--dry-run", "-o", out)
    assert "'part' has no symmetry about its axis z'" in err
    _, err = run("bank", "build", "--mesh", f"can={files / 'can.stl'}", *small, "-o", tmp_path / "can.h5")
    assert "'can' is a body of revolution" in err
    _, err = run(
        "bank", "build", "--mesh", f"table={files / 'table.stl'}", *small, "--delta", "0", "-o", tmp_path / "t.h5",
        "--symmetry", 3,
    )  # fmt: skip
    assert "symmetry 3 is stated for 'table'" in err
    assert "found: 4" in err
    assert err.count("\n") == 1
    assert "4 (looks the same every 90° about z')" in run("landmark", "check", files / "table.stl", "--unit", "m")[0]
    assert '"symmetry": 4' in run("landmark", "check", files / "table.stl", "--unit", "m", "--json")[0]
