"""Banks of model images: what is written, what is read, what is refused."""

import hashlib
import json
import os
import shutil

import h5py
import numpy as np
import pytest
import trimesh
import xarray

from phasemark import InputFileError, OutputExistsError, UsageError
from phasemark.data import BankPlan, build_bank, open_bank
from phasemark.data.files import mesh_sha256, versions
from phasemark.data.files.hdf5_layout import Layout, SparseMemory
from phasemark.inputs import checksum_path, verify_checksum
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import PhasorImages, Renderer, preset

GRID = {"distance_m": "0.8:1.2:0.2", "delta_deg": "0:180:45"}  # 3 distances, 4 angles
PLAN = BankPlan(classes=["cone", "post"], **GRID)
FULL = BankPlan(classes=["cone", "post"], layout="full", **GRID)


class Painter:
    """Stands in for the renderer: images that say which class, part, view and pixel they belong to."""

    def __init__(self, mesh, sensor, *, albedo, harmonics=()):
        self.sensor, self.harmonics, self.mark = sensor, harmonics, mesh_mark(mesh)

    def render_views(self, views, *, rows, variant):
        assert variant == "exact"
        row, col = np.mgrid[rows[0] : rows[1], : self.sensor.cols]
        shape = (len(views), *row.shape)
        intensity = np.broadcast_to(paint(views.distance_m, views.delta_rad, row, col, self.mark), shape)
        return PhasorImages(
            phasor=intensity * np.exp(1j * views.distance_m)[:, None, None],
            intensity=intensity,
            coverage=intensity / 100,
            sensor=self.sensor,
            views=views,
            harmonics={k: intensity * (k + 1j) for k in self.harmonics},
        )


def mesh_mark(mesh):
    """A number that tells the meshes of classes and parts apart."""
    return float(np.linalg.norm(mesh.vertices, axis=1).mean() + mesh.extents[2])


def paint(distance_m, delta_rad, row, col, mark):
    view = np.asarray(distance_m) + 2 * np.asarray(delta_rad)
    return view[..., None, None] + 0.01 * row + 0.02 * col + 3 * mark


@pytest.fixture
def painted(monkeypatch):
    monkeypatch.setattr("phasemark.data.bank.build_bank.Renderer", Painter)


@pytest.fixture(scope="module")
def painted_bank(tmp_path_factory):
    path = tmp_path_factory.mktemp("bank") / "bank.h5"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("phasemark.data.bank.build_bank.Renderer", Painter)
        build_bank(PLAN, path).close()
    return path


@pytest.fixture
def bank_file(tmp_path, painted_bank, painted):
    for path in (painted_bank, checksum_path(painted_bank)):
        shutil.copy(path, tmp_path)
    return tmp_path / "bank.h5"


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def expected_images(class_name, layout):
    """Intensity of all images of a class, (distance, delta, row, col), from the painter's formula."""
    distance_m, delta_rad = np.array([0.8, 1.0, 1.2])[:, None], np.deg2rad([0, 45, 90, 135])
    row, col = np.mgrid[:16, :16]
    spec = catalog()[class_name]
    if layout == "full":
        return paint(*np.broadcast_arrays(distance_m, delta_rad), row, col, mesh_mark(build_mesh(spec)))
    # a factored bank sees the upper part from one side only
    upper = paint(*np.broadcast_arrays(distance_m, 0 * delta_rad), row, col, mesh_mark(build_mesh(spec, part="upper")))
    lower = paint(*np.broadcast_arrays(distance_m, delta_rad), row, col, mesh_mark(build_mesh(spec, part="lower")))
    return np.concatenate([upper[:, :, :8], lower[:, :, 8:]], axis=2)


@pytest.mark.parametrize("plan", [PLAN, FULL], ids=["factored", "full"])
def test_every_image_lies_where_its_coordinates_say(painted, tmp_path, plan):
    with build_bank(plan, tmp_path / "bank.h5", shard_items=5) as bank:
        assert bank.classes == ("cone", "post")
        assert bank.distance_m.tolist() == [0.8, 1.0, 1.2]
        assert bank.delta_rad.tolist() == np.deg2rad([0, 45, 90, 135]).tolist()
        for name in bank.classes:
            expected = expected_images(name, plan.layout)
            for i, distance_m in enumerate(bank.distance_m):
                for j in range(len(bank.delta_rad)):
                    image = bank.image(name, i, j)
                    rtol = 1e-6  # float32 in the bank: half of 1.2e-7, in each of two components
                    np.testing.assert_allclose(image.intensity[0], expected[i, j], rtol=rtol)
                    np.testing.assert_allclose(image.coverage[0], expected[i, j] / 100, rtol=rtol)
                    phasor = expected[i, j] * np.exp(1j * distance_m)
                    np.testing.assert_allclose(bank.phasor(name, i, j), phasor, rtol=rtol)
                    assert image.views.distance_m.tolist() == [distance_m]
                    assert image.views.delta_rad.tolist() == [bank.delta_rad[j]]


def test_a_matcher_gets_whole_arrays_that_are_read_once(painted):
    with build_bank(PLAN) as bank:
        lower, upper = bank.lower, bank.upper
        assert bank.full is None
        assert (lower.phasor.shape, lower.phasor.dtype) == ((3, 4, 8, 16), np.complex64)
        assert (upper.phasor.shape, upper.intensity.shape, upper.coverage.shape) == ((2, 3, 8, 16),) * 3
        assert (lower.row.tolist(), upper.row.tolist()) == (list(range(8, 16)), list(range(8)))
        assert upper.classes == ("cone", "post")
        assert np.shares_memory(lower.phasor, lower.phasor)  # read once
        with pytest.raises(ValueError, match="read-only"):
            lower.phasor[0] = 0
        with pytest.raises(ValueError, match="read-only"):
            upper.distance_m[0] = 0
    with build_bank(FULL) as bank:
        assert bank.full.phasor.shape == (2, 3, 4, 16, 16)
        assert bank.lower is bank.upper is None


def test_harmonics_lie_on_a_frequency_axis(painted):
    plan = BankPlan(classes=["cone"], harmonics=[3, 5], **GRID)
    with build_bank(plan) as bank:
        assert bank.lower.order.tolist() == [1, 3, 5]
        np.testing.assert_allclose(bank.lower.harmonic(5), bank.lower.intensity * (5 + 1j), rtol=1e-6)  # float32
        with pytest.raises(UsageError, match="no harmonic 7, only 1, 3, 5"):
            bank.lower.harmonic(7)


def test_rendered_factored_and_full_banks_agree():
    factored, full = build_bank(PLAN), build_bank(FULL)
    with factored, full:
        brightest = np.abs(full.full.phasor).max()
        for name in full.classes:
            for i in range(3):
                for j in range(4):
                    difference = np.abs(factored.phasor(name, i, j) - full.phasor(name, i, j)).max()
                    # The full bank sees the tessellated upper part from other sides: the budget of tessellation, twice.
                    assert difference <= 1e-4 * brightest


def test_the_bank_holds_what_the_renderer_renders():
    sensor = preset("pmd-16x16")
    rendered = Renderer(build_mesh(catalog()["cone"]), sensor, albedo=0.8).render(1.0, np.deg2rad(45))
    with build_bank(FULL, workers=2) as bank:
        stored = bank.image("cone", 1, 1)
        rtol = 1e-6  # float32
        np.testing.assert_allclose(stored.phasor, rendered.phasor, rtol=rtol)
        np.testing.assert_allclose(stored.intensity, rendered.intensity, rtol=rtol)
        np.testing.assert_allclose(stored.coverage, rendered.coverage, rtol=rtol)


def test_a_bank_of_a_stored_plan_is_the_same_bank(bank_file):
    with open_bank(bank_file) as bank:
        again = bank_file.with_name("again.h5")
        build_bank(bank.plan, again).close()
    assert again.read_bytes() == bank_file.read_bytes()


def test_the_file_says_where_it_comes_from(bank_file):
    assert names(bank_file.parent) == ["bank.h5", "bank.h5.sha256"]
    verify_checksum(bank_file)
    with h5py.File(bank_file) as file:
        assert file.attrs["format"] == "phasemark-bank"
        assert file.attrs["schema_version"] == 1
        assert json.loads(file.attrs["plan"])["distance_m"] == "0.8:1.2:0.2"
        assert json.loads(file.attrs["sensor"])["rows"] == 16
        assert json.loads(file.attrs["versions"]) == versions()
        mesh = file["meshes/cone"]
        assert dict(mesh.attrs) == {
            "delta_period_deg": 180.0,
            "albedo": 0.8,
            "sha256": mesh_sha256(build_mesh(catalog()["cone"])),
        }
    with open_bank(bank_file) as bank:
        assert bank.plan == PLAN.resolve()
        assert bank.sensor == preset("pmd-16x16")
        info = bank.info()
        assert info["images"] == {"lower": 12, "upper": 6}
        assert info["size_bytes"] == bank_file.stat().st_size
        assert (info["distance_m"], info["delta_deg"]) == ("0.8:1.2:0.2", "0:135:45")
        json.dumps(info)


def test_a_bank_of_a_direct_sensor_tells_bins_and_limits_and_no_modulation():
    plan = {"classes": ["cone"], "sensor": "vl53l5cx-4x4", "distance_m": 0.8, "delta_deg": 0}
    with build_bank(plan) as bank:
        info = bank.info()
    assert {"modulation_hz", "harmonics"}.isdisjoint(info)
    assert (info["kind"], info["quantity"], info["max_range_m"]) == ("direct", "z", 4.0)
    assert (info["bins"], info["bin_width_m"]) == (128, 0.0375)
    assert (info["max_targets"], info["min_separation_m"]) == (4, 0.6)


def test_a_mesh_hash_is_that_of_its_vertices_and_faces():
    mesh = trimesh.creation.box()
    content = mesh.vertices.astype("<f8").tobytes() + mesh.faces.astype("<i8").tobytes()
    assert mesh_sha256(mesh) == hashlib.sha256(content).hexdigest()


def test_the_mesh_comes_back_with_symmetry_albedo_and_parts(bank_file):
    built = build_mesh(catalog()["cone"])
    with open_bank(bank_file) as bank:
        mesh = bank.mesh("cone")
    assert np.array_equal(mesh.vertices, built.vertices)
    assert np.array_equal(mesh.faces, built.faces)
    assert np.array_equal(mesh.face_attributes["part"], built.face_attributes["part"])
    assert mesh.metadata == {"name": "cone", "symmetry": 2, "albedo": 0.8}


def test_a_bank_of_a_mesh_file_keeps_its_symmetry_and_albedo(painted, tmp_path):
    trimesh.creation.box((100, 60, 200)).export(tmp_path / "part.stl")
    part = {"name": "part", "path": str(tmp_path / "part.stl"), "unit": "mm", "symmetry": 2, "albedo": 0.4}
    with build_bank(BankPlan(meshes=[part], layout="full", **GRID)) as bank:
        assert bank.classes == ("part",)
        assert sorted(bank.mesh("part").extents.round(6)) == [0.06, 0.1, 0.2]
        assert bank.mesh("part").metadata == {"name": "part", "symmetry": 2, "albedo": 0.4}


def test_a_mesh_file_without_a_unit_is_refused_with_its_extents(painted, tmp_path):
    trimesh.creation.box((100, 60, 200)).export(tmp_path / "part.stl")
    part = {"name": "part", "path": str(tmp_path / "part.stl")}
    with pytest.raises(UsageError, match="unit"):
        build_bank(BankPlan(meshes=[part], layout="full", **GRID), tmp_path / "bank.h5")
    assert names(tmp_path) == ["part.stl"]


@pytest.mark.parametrize("layout", ["factored", "full"])
def test_the_planar_model_fills_the_same_schema(layout):
    plan = BankPlan(classes=["cone"], model="planar", layout=layout, **GRID)
    with build_bank(plan) as bank:
        assert bank.plan.model == bank.info()["model"] == "planar"
        # At D = 0.8 m and δ = 0 the box shows its front, 0.12 m before the axis, in the middle columns.
        assert bank.image("cone", 0, 0).range_m[0, 8, 8] == pytest.approx(0.68, abs=1e-3)  # the column is 0.7° aside


def test_the_planar_model_refuses_mesh_files(painted):
    part = {"name": "part", "path": "part.stl", "unit": "mm"}
    with pytest.raises(UsageError, match="'model' must be 'ray' or 'hard' for 'part'"):
        build_bank(BankPlan(meshes=[part], model="planar", layout="full", **GRID))


@pytest.mark.parametrize(
    ("group", "dims"),
    [
        ("lower", ("distance", "delta", "frequency", "row", "col", "iq")),
        ("upper", ("landmark_class", "distance", "frequency", "row", "col", "iq")),
    ],
)
def test_xarray_shows_labelled_axes_with_units(bank_file, group, dims):
    with xarray.open_dataset(bank_file, group=group, engine="h5netcdf") as data:
        assert data.phasor.dims == dims
        assert data.coverage.dims == data.intensity.dims == tuple(d for d in dims if d not in ("frequency", "iq"))
        assert set(data.coords) == set(dims)
        units = {"distance": "m", "delta": "degree", "frequency": "Hz", "row": "1", "col": "1"}
        for name in dims:
            assert data[name].attrs.get("units") == units.get(name)
            assert data[name].attrs["long_name"]
        assert data.row.values.tolist() == list(range(8, 16) if group == "lower" else range(8))
        assert data.frequency.values.tolist() == [10e6]
        if group == "upper":
            assert data.landmark_class.values.tolist() == ["cone", "post"]
        else:
            picked = data.phasor.sel(distance=1.0, delta=45, frequency=10e6)
            with open_bank(bank_file) as bank:
                expected = bank.lower.phasor[1, 1]
            assert np.array_equal(picked.sel(iq="i") + 1j * picked.sel(iq="q"), expected)


def test_a_bank_without_a_path_leaves_no_file(painted, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with build_bank(PLAN) as bank:
        assert names(tmp_path) == []
        assert bank.phasor("cone", 0, 0).shape == (16, 16)


def test_progress_counts_images(painted, tmp_path):
    seen = []

    def note(done, total):
        seen.append((done, total))

    build_bank(PLAN, tmp_path / "bank.h5", workers=1, shard_items=5, progress=note).close()
    assert seen == [(5, 18), (10, 18), (15, 18), (18, 18)]


def test_an_existing_bank_needs_force_and_is_asked_about_before_rendering(bank_file, monkeypatch):
    before = bank_file.read_bytes()
    monkeypatch.setattr("phasemark.data.bank.build_bank.Renderer", None)
    with pytest.raises(OutputExistsError, match="force=True"):
        build_bank(PLAN, bank_file)
    monkeypatch.setattr("phasemark.data.bank.build_bank.Renderer", Painter)
    build_bank(FULL, bank_file, force=True).close()
    assert bank_file.read_bytes() != before
    verify_checksum(bank_file)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"sensor_overrides": {"pitch_deg": 1}}, "no factored bank: the sensor is tilted"),
        (
            {"meshes": [{"name": "part", "path": "part.stl", "unit": "mm"}]},
            "comes from a mesh file; build a full one (layout='full')",
        ),
    ],
)
def test_a_factored_bank_that_cannot_be_is_refused_with_the_way_out(tmp_path, painted, fields, reason):
    with pytest.raises(UsageError) as caught:
        build_bank(BankPlan(**GRID, **fields), tmp_path / "bank.h5")
    assert reason in str(caught.value)
    assert "layout='full'" in str(caught.value)
    assert names(tmp_path) == []


def test_an_unknown_class_is_named(bank_file):
    with open_bank(bank_file) as bank, pytest.raises(UsageError, match=r"unknown class 'cube': .* has cone, post"):
        bank.phasor("cube", 0, 0)


def with_attribute(name, value):
    return lambda file: file.attrs.__setitem__(name, value)


def without(name):
    return lambda file: file.__delitem__(name)


def replaced(name, values):
    def change(file):
        del file[name]
        file[name] = values

    return change


def spoiled(name, value):
    def change(file):
        file[name][(0,) * file[name].ndim] = value

    return change


def damage(path, change):
    checksum_path(path).unlink()
    with h5py.File(path, "r+") as file:
        change(file)


def changed_sensor(file):
    file.attrs["sensor"] = preset("pmd-16x16").with_(rows=8).model_dump_json()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (with_attribute("format", "phasemark-frames"), "not a bank .*'phasemark-frames'"),
        (with_attribute("schema_version", 0), "build it again"),
        (with_attribute("plan", "{"), "damaged"),
        (with_attribute("plan", "[1]"), "must be a JSON object"),
        (with_attribute("plan", '{"model": "wave"}'), "damaged .*'model'"),
        (with_attribute("sensor", "{}"), "damaged .*'rows' is missing"),
        (lambda file: file.attrs.__delitem__("sensor"), "damaged"),
        (changed_sensor, "'lower/row' do not belong"),
        (without("lower"), "group 'lower' is missing"),
        (without("upper/phasor"), "dataset 'upper/phasor' is missing"),
        (without("lower/delta"), "dataset 'lower/delta' is missing"),
        (without("meshes/cone"), "group 'meshes/cone' is missing"),
        (
            replaced("lower/coverage", np.zeros((3, 4, 8, 15))),
            r"'lower/coverage' must be floats of shape \(3, 4, 8, 16\)",
        ),
        (replaced("lower/intensity", np.zeros((3, 4, 8, 16), int)), "'lower/intensity' must be floats"),
        (replaced("lower/distance", ["a", "b", "c"]), "'lower/distance' must be one row of numbers"),
        (replaced("lower/distance", np.zeros((3, 1))), "'lower/distance' must be one row of numbers"),
        (spoiled("lower/distance", np.nan), "'lower/distance' do not belong"),
        (spoiled("lower/distance", -1), "'lower/distance' do not belong"),
        (spoiled("upper/distance", 0.75), "must agree"),
        (spoiled("lower/delta", 100), "'lower/delta' do not belong"),
        (spoiled("lower/frequency", 20e6), "'lower/frequency' do not belong"),
        (spoiled("upper/landmark_class", "post"), "'upper/landmark_class' do not belong"),
    ],
)
def test_a_damaged_bank_is_refused_when_opened(bank_file, change, reason):
    damage(bank_file, change)
    with pytest.raises(InputFileError, match=reason) as caught:
        open_bank(bank_file)
    assert str(caught.value).startswith(f"{bank_file}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value", "read", "reason"),
    [
        *(
            (f"lower/{field}", np.inf, lambda bank, field=field: getattr(bank.lower, field), f"'lower/{field}' must be")
            for field in ("phasor", "intensity", "coverage")
        ),
        *(
            (f"meshes/cone/{field}", value, lambda bank: bank.mesh("cone"), "'meshes/cone' has vertices")
            for field, value in (("vertices", np.nan), ("vertices", 1e60), ("faces", -1), ("faces", 10**6))
        ),
    ],
)
def test_values_that_cannot_be_are_refused_when_read(bank_file, name, value, read, reason):
    damage(bank_file, spoiled(name, value))
    with open_bank(bank_file) as bank, pytest.raises(InputFileError, match=reason):
        read(bank)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_a_cut_off_bank_is_an_input_error_of_one_line(bank_file, share):
    content = bank_file.read_bytes()
    bank_file.write_bytes(content[: int(share * len(content))])
    checksum_path(bank_file).unlink()
    with pytest.raises(InputFileError, match=r"damaged or cut off|not a bank") as caught:
        open_bank(bank_file)
    assert "\n" not in str(caught.value)


def test_what_is_no_bank_is_an_input_error(tmp_path):
    with pytest.raises(InputFileError, match="No such file"):
        open_bank(tmp_path / "absent.h5")
    with pytest.raises(InputFileError, match="Is a directory"):
        open_bank(tmp_path)
    (tmp_path / "a.csv").write_text("1,2,3")
    with pytest.raises(InputFileError, match="not an HDF5 file"):
        open_bank(tmp_path / "a.csv")


def test_a_layout_of_a_terabyte_takes_a_few_pages_of_memory():
    with Layout() as layout:
        _, first = layout.reserve(layout.file, "a", (1 << 19, 1 << 18), "<f4")
        _, second = layout.reserve(layout.file, "b", (1 << 18,), "<f4")
        held = sum(len(page) for _, page in layout._memory.pages())
    assert second - first >= 1 << 39
    assert held < 1 << 20


def test_sparse_memory_is_a_file(tmp_path):
    rng = np.random.default_rng(3)
    with open(tmp_path / "f", "w+b") as file:
        both = (SparseMemory(), file)
        for at, size in zip(rng.integers(0, 400_000, 50), rng.integers(0, 200_000, 50), strict=True):
            data = rng.bytes(int(size))
            for target in both:
                target.seek(int(at))
                assert target.write(memoryview(data)) == size
        for at, size in zip(rng.integers(0, 700_000, 50), rng.integers(0, 200_000, 50), strict=True):
            buffers = bytearray(int(size)), bytearray(int(size))
            assert both[0].seek(int(at)) == both[1].seek(int(at))
            assert both[0].readinto(memoryview(buffers[0])) == both[1].readinto(buffers[1])
            assert buffers[0] == buffers[1]
        for target in both:
            target.truncate(300_000)
            assert target.seek(0, os.SEEK_END) == 300_000
