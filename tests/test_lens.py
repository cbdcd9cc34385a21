"""Lenses with distortion: rays against OpenCV's own code, images against an oracle, files and what is refused."""

import json
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from phasemark import InputFileError, UsageError
from phasemark.cli import main
from phasemark.data import BankPlan, build_bank, open_bank
from phasemark.data.plans.bank_plan import factored_refusal
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Renderer, Sensor, Views, preset
from phasemark.render.derivative import VIEW_PARAMETERS
from phasemark.render.planar import PlanarLandmark, planar_images
from phasemark.render.sensor import Lens
from phasemark.render.sensor.sensor_file import read_sources, sensor_toml

with np.load(Path(__file__).parent / "golden" / "lenses.npz") as _file:
    LENSES = json.loads(str(_file["lenses"]))
    CASES = json.loads(str(_file["cases"]))
    FREQUENCIES_HZ = _file["frequencies_hz"].tolist()
    PHASOR, INTENSITY, COVERAGE = (
        [_file[f"{name}_{j}"] for j in range(len(CASES))] for name in ("phasor", "intensity", "coverage")
    )

MESHES = {name: build_mesh(spec) for name, spec in catalog().items()}
BARREL, RATIONAL = (-0.31, 0.12, 0.0012, -0.0008, -0.02), (0.9, 0.3, 1e-3, -2e-3, 0.02, 1.2, 0.5, 0.03)


def matrix_of(lens):
    return np.array([[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1.0]])


def camera(name, **fields):
    lens = LENSES[name]
    size = lens["cols"], lens["rows"]
    return Sensor.from_opencv(matrix_of(lens), lens["distortion"], size=size, model=lens["model"], **fields)


def barrel(rows=24, cols=32, focal=60.0, distortion=BARREL, **fields):
    matrix = [[focal, 0, cols / 2 - 0.7], [0, focal, rows / 2 - 0.2], [0, 0, 1]]
    return Sensor.from_opencv(matrix, distortion, size=(cols, rows), **fields)


SENSORS = {
    **{name: camera(name) for name in LENSES},
    "rational": barrel(distortion=RATIONAL, focal=30.0),
    "four coefficients": barrel(distortion=BARREL[:4]),
    "none": barrel(distortion=()),
}


# --- rays ---


@pytest.mark.parametrize("name", SENSORS)
def test_rays_are_those_that_opencv_projects_to_the_same_pixels(name):
    sensor = SENSORS[name]
    v, u = np.mgrid[: sensor.rows + 1, : sensor.cols + 1].astype(float)
    y, z = sensor.tangents(u, v)
    points = np.stack([-y, -z, np.ones_like(y)], axis=-1).reshape(-1, 1, 3)  # OpenCV: x right, y down, z forward
    lens = sensor.lens
    project = cv2.fisheye.projectPoints if lens.model == "fisheye" else cv2.projectPoints
    still, distortion = np.zeros(3), np.array(lens.distortion or (0.0,) * 4)
    seen = project(points, still, still, matrix_of(lens.model_dump()), distortion)[0].reshape(*u.shape, 2)
    np.testing.assert_allclose(seen + 0.5, np.stack([u, v], axis=-1), atol=1e-9)  # half a pixel: OpenCV's (0, 0)
    np.testing.assert_allclose(np.stack(sensor.image_points(y, z)), np.stack([u, v]), atol=1e-9)


@pytest.mark.parametrize("name", SENSORS)
def test_the_kernels_trace_the_same_rays_back(name):
    from phasemark.render.integral.area_integral import camera_of
    from phasemark.render.integral.image_rays import ray_of

    sensor = SENSORS[name]
    kernels = camera_of(sensor, (0, sensor.rows), ())
    rng = np.random.default_rng(4)
    for u, v in rng.uniform(0, [sensor.cols, sensor.rows], (200, 2)):
        np.testing.assert_allclose(ray_of(kernels, u, v), np.ravel(sensor.tangents(u, v)), atol=1e-12)


def test_opencvs_pixel_0_0_is_the_centre_of_ours():
    sensor = Sensor.from_opencv([[100, 0, 0], [0, 100, 0], [0, 0, 1]], (), size=(1, 1))
    assert sensor.centre_px == (0.5, 0.5)
    np.testing.assert_allclose(sensor.ray_directions(0.5, 0.5), [1, 0, 0], atol=1e-15)


# --- images ---


@pytest.mark.parametrize("frequency", range(len(FREQUENCIES_HZ)))
@pytest.mark.parametrize("frame", range(len(CASES)))
def test_frame_agrees_with_the_true_solid_behind_the_lens(frame, frequency):
    case = CASES[frame]
    sensor = camera(case["lens_name"], modulation_hz=FREQUENCIES_HZ[frequency])
    background = Background(wall_m=case.get("wall_m"), floor_m=case.get("floor_m"))
    names = ("distance_m", "delta_rad", "bearing_rad", "height_m", "pitch_rad", "roll_rad")
    views = Views.broadcast(**{name: case[name] for name in names})
    image = Renderer(MESHES[case["cls"]], sensor).render_views(views, background=background)
    # 1e-4 of the brightest pixel: the budget of integration and tessellation together
    phasor = PHASOR[frame][frequency]
    assert np.abs(image.phasor[0] - phasor).max() / np.abs(phasor).max() <= 1e-4
    assert np.abs(image.intensity[0] - INTENSITY[frame]).max() / INTENSITY[frame].max() <= 1e-4
    assert np.abs(image.coverage[0] - COVERAGE[frame]).max() <= 2e-4


@pytest.mark.parametrize("background", [None, Background(wall_m=4.0), Background(wall_m=4.0, floor_m=0.5)])
def test_a_lens_without_distortion_is_the_ideal_camera(background):
    ideal = Sensor.from_intrinsics(60.0, 61.0, 16.3, 11.7, rows=24, cols=32, pitch_deg=3, fill_factor=(0.8, 0.9))
    matrix = np.array([[60.0, 0, 15.8], [0, 61.0, 11.2], [0, 0, 1]])
    views = Views.broadcast([0.9, 1.3], [0.3, 2.0], [0.02, -0.05], 0.02)
    expected = Renderer(MESHES["cylinder"], ideal).render_views(views, background=background)
    for zeros in ((), (0.0,) * 8):
        lens = Sensor.from_opencv(
            matrix, zeros, size=(32, 24), model="opencv", pitch_deg=3, fill_factor=(0.8, 0.9), modulation_hz=10e6
        )
        assert lens.tan_half_angles == pytest.approx(ideal.tan_half_angles, rel=1e-14)
        found = Renderer(MESHES["cylinder"], lens).render_views(views, background=background)
        brightest = np.abs(expected.phasor).max()
        assert np.abs(found.phasor - expected.phasor).max() / brightest <= 1e-12
        assert np.abs(found.coverage - expected.coverage).max() <= 1e-12


def test_a_pixel_is_the_mean_of_the_pixels_that_a_finer_camera_has_in_its_place():
    coarse, k = camera("pincushion-16x16"), 4
    lens = coarse.lens
    matrix = [[k * lens.fx, 0, k * (lens.cx + 0.5) - 0.5], [0, k * lens.fy, k * (lens.cy + 0.5) - 0.5], [0, 0, 1]]
    fine = Sensor.from_opencv(matrix, lens.distortion, size=(16 * k, 16 * k))
    views = Views.broadcast([0.8, 1.1], [0.4, 2.2], 0.03, 0.02, 0.05, -0.08)
    for background in (None, Background(wall_m=3.0)):
        whole = Renderer(MESHES["cone"], coarse).render_views(views, background=background).phasor
        parts = Renderer(MESHES["cone"], fine).render_views(views, background=background).phasor
        mean = parts.reshape(2, 16, k, 16, k).mean(axis=(2, 4))
        assert np.abs(whole - mean).max() / np.abs(mean).max() <= 1e-4  # the integral's own budget


def test_a_landmark_that_fills_the_image_leaves_no_pixel_out():
    image = Renderer(MESHES["cylinder"], barrel(rows=8, cols=8, focal=200.0)).render(0.3, height_m=0.08)
    np.testing.assert_allclose(image.coverage, 1.0, rtol=1e-12)
    assert (image.intensity > 0).all()


@pytest.mark.parametrize("name", ["barrel-24x32", "fisheye-16x20"])
def test_slopes_behind_a_lens_are_those_of_differences(name):
    renderer = Renderer(MESHES["cone"], camera(name))
    views = Views.broadcast([0.87, 1.12], [0.35, 1.4], 0.031, 0.021)
    for background in (None, Background(wall_m=3.0, floor_m=0.4)):
        images, slope = renderer.render_with_slopes(views, background=background)
        assert np.array_equal(images.phasor, renderer.render_views(views, background=background).phasor)
        expected = renderer.jacobian(
            views.distance_m, views.delta_rad, views.bearing_rad, views.height_m, background=background
        )
        for k, parameter in enumerate(VIEW_PARAMETERS):
            largest = np.abs(expected[:, k]).max()
            error = np.abs(slope[:, k] - expected[:, k]) / largest
            # single pixels differ: beside a limb, as without a lens, and where a bent edge runs along a row
            assert np.quantile(error, 0.95) <= 5e-5, parameter
            assert error.max() <= 0.15, parameter


def test_the_hard_variant_sees_what_the_centre_rays_see():
    sensor = camera("barrel-24x32")
    image = Renderer(None, sensor).render(1.0, background=Background(wall_m=2.0), variant="hard")
    np.testing.assert_allclose(image.range_m[0], 2.0 / sensor.pixel_directions()[..., 0], rtol=1e-9)


def test_a_large_camera_behind_a_lens_takes_at_most_twice_the_time():
    lens = barrel(rows=86, cols=112, focal=100.0)
    ideal = lens.with_(lens=None)
    views = Views.broadcast(np.linspace(0.9, 1.5, 3), np.linspace(0, 3, 3))
    renderers = [Renderer(MESHES["cylinder"], sensor) for sensor in (lens, ideal)]
    spent = [[], []]
    for _ in range(6):  # the first compiles
        for renderer, times in zip(renderers, spent, strict=True):
            begin = time.process_time()
            renderer.render_views(views)
            times.append(time.process_time() - begin)
    with_lens, without = (np.median(times[1:]) for times in spent)
    assert without / with_lens >= 0.5


# --- the sensor ---


def test_cameras_that_differ_in_the_lens_see_different_images_and_one_without_is_written_without():
    assert "lens" not in preset("pmd-16x16").model_dump()
    assert '"lens"' not in preset("pmd-16x16").model_dump_json()
    sensor = barrel()
    other = sensor.with_(lens={**sensor.lens.model_dump(), "distortion": (-0.2, 0, 0, 0)})
    assert "'lens' is " in sensor.optics_difference(other)
    assert sensor.optics_difference(Sensor(**sensor.model_dump())) is None


def test_a_file_gives_the_sensor_back(tmp_path):
    sensor = camera("fisheye-16x20", modulation_hz=20e6)
    (tmp_path / "own.toml").write_text(sensor_toml(sensor, {}, header=(), otherwise="assumed"), encoding="utf-8")
    assert Sensor.from_toml(tmp_path / "own.toml") == sensor


def test_half_angles_and_principal_point_follow_from_the_lens():
    sensor = camera("barrel-24x32")
    left, right = (float(sensor.tangents(u, sensor.centre_px[1])[0]) for u in (0, sensor.cols))
    assert sensor.tan_half_angles[0] == pytest.approx((left - right) / 2, rel=1e-12)
    assert sensor.centre_px == (16.3, 11.7)
    wider = sensor.with_(half_angle_h_deg=16.0)
    assert wider.half_angle_h_deg == pytest.approx(16.0, rel=1e-12)
    assert wider.half_angle_v_deg == pytest.approx(sensor.half_angle_v_deg, rel=1e-3)  # tangential terms alone
    assert wider.lens.fx < sensor.lens.fx
    assert sensor.with_(principal_point_px=(16.0, 12.0)).lens.cx == 15.5
    with pytest.raises(UsageError, match="'half_angle_h_deg' must be greater than 0, got 0"):
        sensor.with_(half_angle_h_deg=0)
    with pytest.raises(UsageError, match=r"'principal_point_px\.1' is missing"):
        sensor.with_(principal_point_px=[1])


PLAIN = {"fx": 60, "fy": 60, "cx": 16, "cy": 12}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"half_angle_h_deg": 30.0}, "'half_angle_h_deg' must be left out beside 'lens', from which it follows as 14"),
        ({"principal_point_px": (10.0, 12.0)}, "'principal_point_px' must be left out beside 'lens'"),
        ({"lens": {**PLAIN, "distortion": [0.1]}}, "must have 4 or 5 or 8 coefficients"),
        ({"lens": {**PLAIN, "model": "fisheye", "distortion": [0.1] * 5}}, "must have 4"),
        ({"lens": {**PLAIN, "fx": -1}}, "'lens.fx' must be greater than or equal to 0.001, got -1"),
        ({"lens": {**PLAIN, "k1": 0}}, r"'k1' is no key of \[lens\]"),
        ({"lens": {"fx": 60, "fy": 60, "cx": 16}}, "'lens.cy' is missing"),
        ({"lens": {**PLAIN, "cx": 90}}, "another image size"),
    ],
)
def test_what_contradicts_a_lens_is_refused(fields, message):
    with pytest.raises(UsageError, match=message) as refused:
        Sensor(**{"rows": 24, "cols": 32, "lens": PLAIN, **fields})
    assert "\n" not in str(refused.value)


def test_intrinsics_of_another_image_size_are_refused(tmp_path):
    matrix = [[60, 0, 90], [0, 60, 12], [0, 0, 1]]
    with pytest.raises(UsageError, match=r"'lens\.cx' must lie near the middle of an image of 32 columns, got 90"):
        Sensor.from_opencv(matrix, size=(32, 24))
    file = tmp_path / "my.toml"
    file.write_text("rows = 24\ncols = 32\n[lens]\nfx = 60\nfy = 60\ncx = 90\ncy = 12\n")
    with pytest.raises(UsageError, match=r"my\.toml: 'lens\.cx' must lie near the middle"):
        Sensor.from_toml(file)


def test_a_lens_that_folds_inside_the_image_is_refused_with_the_radius():
    # x_d = x (1 − x² / 3) folds at x = 1, where x_d = 2/3
    with pytest.raises(UsageError, match=r"folds 13\.3\d* pixels from the principal point, at the tangent (0\.99|1)"):
        barrel(focal=20.0, distortion=(-1 / 3, 0, 0, 0))
    assert barrel(focal=40.0, distortion=(-1 / 3, 0, 0, 0)).lens is not None  # it folds outside
    with pytest.raises(UsageError, match="no farther than 85°"):
        Sensor.from_opencv(
            np.array([[10, 0, 15.5], [0, 10, 11.5], [0, 0, 1]]), (0.0,) * 4, size=(32, 24), model="fisheye"
        )


def test_what_knows_no_lens_refuses_it():
    with pytest.raises(UsageError, match="the planar model needs an ideal lens"):
        planar_images(PlanarLandmark(0.24, 0.16), barrel(), Views.broadcast(1.0))
    direct = preset("vl53l5cx-8x8")
    with pytest.raises(UsageError, match="'lens' must be left out beside 'histogram'"):
        direct.with_(lens=Lens(fx=10, fy=10, cx=3.5, cy=3.5))


@pytest.mark.parametrize("with_lens", [True, False])
def test_a_bank_holds_its_sensor_whole_and_needs_its_file_no_more(tmp_path, with_lens):
    sensor = barrel(rows=8, cols=8, focal=20.0, distortion=BARREL[:4])
    sensor = sensor if with_lens else sensor.with_(lens=None)
    (tmp_path / "own.toml").write_text(sensor_toml(sensor, {}, header=(), otherwise="assumed"), encoding="utf-8")
    grid = {"distance_m": "0.9:1.1:0.1", "delta_deg": "0:180:45", "layout": "full"}
    plan = BankPlan(classes=["cone"], sensor=str(tmp_path / "own.toml"), **grid)
    build_bank(plan, tmp_path / "own.h5")
    (tmp_path / "own.toml").unlink()
    bank = open_bank(tmp_path / "own.h5")
    assert bank.sensor == sensor
    assert bank.plan.build_sensor() == sensor


def test_a_factored_bank_needs_a_middle_line_that_is_straight():
    lens = {"fx": 41.0, "fy": 41.0, "cx": 7.5, "cy": 7.5, "distortion": (-0.3, 0.1, 0.0, 1e-3)}
    straight = preset("pmd-16x16").with_(lens=lens)
    overrides = straight.model_dump(mode="json")
    plan = BankPlan(classes=["cone"], sensor_overrides=overrides, distance_m="0.9:1.1:0.1", delta_deg="0:180:45")
    assert factored_refusal(plan.resolve()) is None
    overrides["lens"]["distortion"] = (-0.3, 0.1, 1e-3, 0.0)
    for name in ("half_angle_h_deg", "half_angle_v_deg"):
        overrides.pop(name)
    bent = BankPlan(classes=["cone"], sensor_overrides=overrides, distance_m="0.9:1.1:0.1", delta_deg="0:180:45")
    assert "bends the image's middle line" in factored_refusal(bent.resolve())


# --- camera_info ---

MATRIX, COEFFICIENTS = [211.5, 0, 111.2, 0, 211.8, 86.1, 0, 0, 1], [-0.28, 0.11, 1e-3, -5e-4, 0.0]


def calibrated(model="plumb_bob", d=COEFFICIENTS, w=224, k=MATRIX):
    return (
        f"image_width: {w}\nimage_height: 171\ncamera_name: own\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: {k}\n"
        f"distortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n  cols: {len(d)}\n  data: {d}\n"
    )


def echoed(keys, model="plumb_bob", d=COEFFICIENTS):
    return (
        f"header:\n  frame_id: own\nheight: 171\nwidth: 224\ndistortion_model: {model}\n{keys[0]}: {d}\n"
        f"{keys[1]}: {MATRIX}\nbinning_x: 0\nroi:\n  width: 0\n  height: 0\n---\n"
    )


@pytest.mark.parametrize("text", [calibrated(), echoed("DK"), echoed("dk")], ids=["file", "ROS 1", "ROS 2"])
def test_every_spelling_of_a_camera_info_is_read(tmp_path, text):
    (tmp_path / "info.yaml").write_text(text)
    sensor = Sensor.from_camera_info(tmp_path / "info.yaml", modulation_hz=60e6)
    matrix = np.reshape(MATRIX, (3, 3))
    assert sensor == Sensor.from_opencv(matrix, COEFFICIENTS, size=(224, 171), modulation_hz=60e6)


@pytest.mark.parametrize(
    ("model", "d", "own"),
    [
        ("rational_polynomial", [0.1, 0.02, 0, 0, 0, 0.11, 0.03, 0], "opencv"),
        ("equidistant", [0.01, -0.02, 0.003, 0.0], "fisheye"),
        ("fisheye", [0.01, -0.02, 0.003, 0.0], "fisheye"),
    ],
)
def test_models_of_ros_are_those_of_opencv(tmp_path, model, d, own):
    (tmp_path / "info.yaml").write_text(echoed("dk", model, d))
    lens = Sensor.from_camera_info(tmp_path / "info.yaml").lens
    assert (lens.model, list(lens.distortion)) == (own, d)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (calibrated("thin_prism"), "unknown 'distortion_model' 'thin_prism': known are plumb_bob"),
        (calibrated(w=112), "do the intrinsics belong to another image size"),
        (calibrated(d=[0.1] * 3), "'distortion_coefficients' must have 4 or 5 numbers for plumb_bob, got 3"),
        (calibrated(d=[-2.9, 0, 0, 0, 0]), "folds"),
        (calibrated(k=[0] * 9), "of a calibrated camera"),
        (calibrated(w="wide"), "'image_width' must be a whole number of pixels"),
        (echoed("dk").replace("binning_x: 0", "binning_x: 2"), "'binning_x' must be 0 or 1, got 2"),
        ("width: 3\n", "'image_height' .or 'height'. is missing"),
        ("a: [1, 2", "not a YAML file .*line 1"),
        ("!!python/object/apply:os.system [exit]", "not a YAML file"),
        ("[" * 5000, "not a YAML file"),
        ("- 1\n", "must hold a table"),
        ("a: 2026-13-45\n", "not a YAML file that can be used"),
    ],
)
def test_a_camera_info_that_cannot_be_used_is_refused_in_one_line(tmp_path, text, message):
    (tmp_path / "info.yaml").write_text(text)
    with pytest.raises(InputFileError, match=message) as refused:
        Sensor.from_camera_info(tmp_path / "info.yaml")
    assert str(refused.value).startswith(f"{tmp_path / 'info.yaml'}: ")
    assert "\n" not in str(refused.value)


def test_an_imported_sensor_says_of_every_field_where_it_is_from(tmp_path, capsys):
    (tmp_path / "info.yaml").write_text(calibrated())
    out = tmp_path / "own.toml"
    assert main(["sensor", "import", str(tmp_path / "info.yaml"), "-o", str(out), "--modulation", "60e6"]) == 0
    stated = out.read_text(encoding="utf-8").split("[source]")[0]
    lines = [line for line in stated.splitlines() if " = " in line]
    for line in lines:
        assert any(word in line.partition("#")[2] for word in ("measured", "published", "assumed", "stated")), line
    sensor = Sensor.from_toml(out)
    assert sensor.lens == Sensor.from_camera_info(tmp_path / "info.yaml").lens
    assert (sensor.modulation_hz, sensor.contrast) == (60e6, preset("pmd-16x16").contrast)
    assert main(["sensor", "import", str(tmp_path / "info.yaml"), "-o", str(out)]) == 4
    assert main(["sensor", "show", str(out), "--picture", str(tmp_path / "grid.png")]) == 0
    assert (tmp_path / "grid.png").read_bytes().startswith(b"\x89PNG")
    shown = capsys.readouterr().out.partition("\n")[2]
    (tmp_path / "again.toml").write_text(shown, encoding="utf-8")
    assert Sensor.from_toml(tmp_path / "again.toml") == sensor


def test_numbers_of_a_camera_that_nobody_named_are_assumed_of_an_imported_one(tmp_path, capsys):
    (tmp_path / "info.yaml").write_text(calibrated())
    out = tmp_path / "own.toml"
    command = ["sensor", "import", str(tmp_path / "info.yaml"), "-o", str(out), "--force"]
    assert main(command) == 0
    sources = read_sources(out)
    assumed = [name for name, text in sources.items() if text == "assumed (from pmd-16x16)"]
    assert {"modulation_hz", "frame_rate_hz", "contrast", "signal_e"} <= set(assumed)
    measured = [name for name, text in sources.items() if text == "measured: info.yaml"]
    assert {*assumed, *measured} == set(sources)
    note = capsys.readouterr().err
    assert note.startswith("note: info.yaml states the lens alone; assumed from pmd-16x16: ")
    assert set(note.split(": ")[2].partition(";")[0].split(", ")) == set(assumed)
    assert note.endswith("; --like NAME|FILE takes them from another camera\n")
    assert main([*command, "--like", "pmd-16x16"]) == 0
    assert read_sources(out)["frame_rate_hz"] == "published (pmd-16x16)"
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("name", "published"),
    [("sr4000-176x144", (43.6, 34.6)), ("picoflexx-224x171", (62.0, 45.0)), ("opt8241-320x240", (74.4, 59.3))],
)
def test_presets_of_cameras_that_people_have_see_the_published_field_of_view(name, published):
    sensor = preset(name)
    assert f"{sensor.cols}x{sensor.rows}" == name.partition("-")[2]
    assert (2 * sensor.half_angle_h_deg, 2 * sensor.half_angle_v_deg) == pytest.approx(published)
