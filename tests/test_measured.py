"""Measured frames from files that somebody else wrote."""

import math
import time
from typing import Any

import h5py
import numpy as np
import pytest

from phasemark import InputFileError, UsageError
from phasemark.data import read_frames
from phasemark.data.measured import write_measured
from phasemark.render import Flag, Frames, Sensor, preset

PMD = preset("pmd-16x16")
SMALL = Sensor(rows=2, cols=3, half_angle_h_deg=30, half_angle_v_deg=20)
IMAGE = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
STATED: dict[str, Any] = {"unit": "m", "quantity": "range"}


def csv_file(tmp_path, text):
    path = tmp_path / "frames.csv"
    path.write_text(text, encoding="utf-8")
    return path


def hdf5_file(tmp_path, datasets, attributes=None):
    path = tmp_path / "frames.h5"
    with h5py.File(path, "w") as file:
        for name, values in datasets.items():
            file[name] = values
        for name, values in (attributes or {}).items():
            file[name].attrs.update(values)
    return path


@pytest.mark.parametrize(
    "text",
    [
        "1,2,3,4,5,6\n",
        "1;2;3;4;5;6",
        "1,0;2,0;3,0;4,0;5,0;6,0\n",  # decimal commas
        "1\t2\t3\t4\t5\t6\r\n",
        "1 2  3 4 5 6\n",
        " 1, 2, 3, 4, 5, 6 \n",
        '"1","2","3","4","5","6"\n',
        "a,b,c,d,e,f\n1,2,3,4,5,6\n",
        "t,x\n1,2,3,4,5,6\n",
        "# comment, 1\n\n1,2,3,4,5,6\n\n",
        "\ufeff1,2,3,4,5,6\n",
        "1e0,2e0,3e0,4e0,5e0,6e0\n",
    ],
)
def test_every_spelling_of_a_csv_frame_gives_the_same_frame(tmp_path, text):
    frames = read_frames(csv_file(tmp_path, text), sensor=SMALL, **STATED)
    assert frames.range_m.tolist() == [[IMAGE.tolist()]]
    assert frames.valid.all()


@pytest.mark.parametrize(("means", "flag"), [("missing", Flag.MISSING), ("no-return", Flag.NO_RETURN)])
def test_blank_and_nan_cells_are_invalid_and_mean_what_the_caller_says(tmp_path, means, flag):
    path = csv_file(tmp_path, "1,,nan,NaN,inf,6\n")
    frames = read_frames(path, sensor=SMALL, invalid_means=means, **STATED)
    assert frames.valid.tolist() == [[[[True, False, False], [False, False, True]]]]
    assert frames.flags.tolist() == [[[[0, flag, flag], [flag, flag, 0]]]]


def test_a_validity_that_is_not_a_number_marks_no_valid_pixel(tmp_path):
    np.savez(tmp_path / "a.npz", range=np.ones((1, 2, 3)), valid=[[[1.0, 0.0, np.nan], [2.0, 1.0, 1.0]]])
    frames = read_frames(tmp_path / "a.npz", sensor=SMALL, **STATED)
    assert frames.valid.tolist() == [[[[True, False, False], [True, True, True]]]]


@pytest.mark.parametrize("count", [255, 257])
def test_a_csv_line_with_a_value_too_few_or_too_many_is_named(tmp_path, count):
    lines = [",".join(["1.5"] * n) for n in (256, 256, count)]
    with pytest.raises(InputFileError) as caught:
        read_frames(csv_file(tmp_path, "header\n" + "\n".join(lines)), sensor=PMD, **STATED)
    assert str(caught.value).endswith(f"line 4 has {count} values, must have 256 (16 × 16 pixels)")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("1,2,3,4,5,6\n1,2,x,4,5,6\n", "line 2, column 3 must be a number, got 'x'"),
        ("1,2,3,4,5,six\n", "line 1, column 6 must be a number, got 'six'"),  # no header: it has numbers
        ("1,2,3,4,5,1_0\n", "line 1, column 6 must be a number, got '1_0'"),
        ("1,2,3,4,5,6\n1,2,3,4\n", "line 2 has 4 values, must have 6"),
        ("1,2,3,4,5,6,\n", "line 1 has 7 values, must have 6"),
        ("a,b,c\n", "holds no frames"),
        ("\n \n", "holds no frames"),
        ("", "is empty"),
    ],
)
def test_a_bad_csv_is_one_line_naming_the_place(tmp_path, text, reason):
    path = csv_file(tmp_path, text)
    with pytest.raises(InputFileError) as caught:
        read_frames(path, sensor=SMALL, **STATED)
    assert str(caught.value).startswith(f"{path}: ")
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001)])
def test_units_become_metres(tmp_path, unit, metres):
    np.save(tmp_path / "a.npy", np.round(IMAGE / metres).astype(np.uint16))
    frames = read_frames(tmp_path / "a.npy", sensor=SMALL, unit=unit, quantity="range")
    np.testing.assert_allclose(frames.range_m[0, 0], IMAGE, rtol=1e-15)  # one rounding of a product


@pytest.mark.parametrize(("shape", "result"), [((2, 3), (1, 1)), ((5, 2, 3), (1, 5)), ((4, 5, 2, 3), (4, 5))])
def test_the_shape_of_an_npy_file_says_positions_and_frames(tmp_path, shape, result):
    values = 1 + np.arange(math.prod(shape)).reshape(shape) / 100
    np.save(tmp_path / "a.npy", values)
    frames = read_frames(tmp_path / "a.npy", sensor=SMALL, **STATED)
    assert frames.range_m.shape == (*result, 2, 3)
    assert np.array_equal(frames.range_m.ravel(), values.ravel())


@pytest.mark.parametrize("tilt", [{}, {"pitch_deg": 20.0, "roll_deg": -10.0}, {"principal_point_px": (1.0, 0.5)}])
def test_z_of_a_plane_across_the_optical_axis_becomes_range_along_each_ray(tmp_path, tilt):
    sensor = SMALL.with_(**tilt)
    z_m = 2.0
    np.save(tmp_path / "a.npy", np.full((2, 3), z_m))
    frames = read_frames(tmp_path / "a.npy", sensor=sensor, unit="m", quantity="z")
    u0, v0 = sensor.principal_point_px or (1.5, 1.0)
    tan_h, tan_v = math.tan(math.radians(30)), math.tan(math.radians(20))
    for row in range(2):
        for col in range(3):
            x, y = 2 * (u0 - col - 0.5) / 3 * tan_h, 2 * (v0 - row - 0.5) / 2 * tan_v  # PHYSICS section 2
            expected = z_m * math.sqrt(1 + x * x + y * y)
            assert frames.range_m[0, 0, row, col] == pytest.approx(expected, rel=1e-12)  # rounding


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"flip_h": True}, [[3, 2, 1], [6, 5, 4]]),
        ({"flip_v": True}, [[4, 5, 6], [1, 2, 3]]),
        ({"rotate": 180}, [[6, 5, 4], [3, 2, 1]]),
        ({"rotate": 90}, [[4, 1], [5, 2], [6, 3]]),  # clockwise: the top left pixel goes to the top right
        ({"rotate": 270}, [[3, 6], [2, 5], [1, 4]]),
        ({"rotate": 90, "flip_h": True}, [[6, 3], [5, 2], [4, 1]]),  # mirrored first
    ],
)
@pytest.mark.parametrize("kind", ["csv", "npz"])
def test_images_are_mirrored_and_turned_with_all_that_belongs_to_them(tmp_path, kind, options, expected):
    upright = SMALL
    if len(expected) == 3:  # a quarter turn swaps rows and columns
        upright = Sensor(rows=3, cols=2, half_angle_h_deg=20, half_angle_v_deg=30)
    path = csv_file(tmp_path, "1,2,3,4,5,6\n") if kind == "csv" else tmp_path / "a.npz"
    if kind == "npz":
        np.savez(path, range=IMAGE, amplitude=10 * IMAGE, intensity=20 * IMAGE, valid=IMAGE != 1)
    frames = read_frames(path, sensor=upright, **STATED, **options)
    valid = np.ones_like(expected, bool) if kind == "csv" else np.array(expected) != 1
    np.testing.assert_array_equal(frames.valid[0, 0], valid)
    np.testing.assert_array_equal(frames.range_m[0, 0], np.where(valid, expected, np.nan))
    if kind == "npz":
        np.testing.assert_array_equal(frames.amplitude_e[0, 0], 10 * np.array(expected))
        np.testing.assert_array_equal(frames.intensity_e[0, 0], 20 * np.array(expected))


def test_status_needs_the_values_that_are_valid(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, range=IMAGE, status=np.array([[5, 9, 0], [255, 5, 5]]))
    with pytest.raises(UsageError, match="valid_status=…"):
        read_frames(path, sensor=SMALL, **STATED)
    frames = read_frames(path, sensor=SMALL, valid_status={5, 9}, **STATED)
    assert frames.valid[0, 0].tolist() == [[True, True, False], [False, True, True]]


@pytest.mark.parametrize("kind", ["npz", "h5"])
def test_a_file_that_states_unit_and_quantity_needs_no_options(tmp_path, kind):
    if kind == "npz":
        path = tmp_path / "a.npz"
        np.savez(path, range=1000 * IMAGE, unit="mm", quantity="range")
    else:
        path = hdf5_file(tmp_path, {"range": 1000 * IMAGE}, {"range": {"units": "mm", "quantity": "range"}})
    frames = read_frames(path, sensor=SMALL)
    np.testing.assert_allclose(frames.range_m[0, 0], IMAGE, rtol=1e-15)  # one rounding of a product
    read_frames(path, sensor=SMALL, unit="mm", quantity="range")
    with pytest.raises(UsageError, match=r"unit=… is m, but .* says mm"):
        read_frames(path, sensor=SMALL, unit="m")
    with pytest.raises(UsageError, match=r"quantity=… is z, but .* says range"):
        read_frames(path, sensor=SMALL, quantity="z")


def test_hdf5_frames_are_read_with_their_amplitudes(tmp_path):
    path = hdf5_file(tmp_path, {"range": IMAGE[None], "amplitude": 7 * IMAGE[None]}, {"amplitude": {"units": "e-"}})
    frames = read_frames(path, sensor=SMALL, **STATED)
    assert frames.amplitude_e[0, 0].tolist() == (7 * IMAGE).tolist()


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({}, r"unit and quantity: give unit=m\|cm\|mm and quantity=range .*z"),
        ({"quantity": "range"}, r"does not say its unit: give unit=m\|cm\|mm"),
        ({"unit": "m"}, r"does not say its quantity: give quantity=range\|z"),
        ({"unit": "inch", "quantity": "range"}, "unit=… must be one of m, cm, mm, got 'inch'"),
        ({"unit": "m", "quantity": "depth"}, "quantity=… must be one of range, z, got 'depth'"),
        ({**STATED, "rotate": 45}, "'rotate' must be 0, 90, 180 or 270, got 45"),
        ({**STATED, "invalid_means": "far"}, "'invalid_means' must be"),
    ],
)
def test_a_missing_or_wrong_option_is_a_usage_error_that_names_it(tmp_path, options, reason):
    path = csv_file(tmp_path, "1,2,3,4,5,6\n")
    with pytest.raises(UsageError, match=reason):
        read_frames(path, sensor=SMALL, **options)


def test_a_file_that_says_one_of_unit_and_quantity_has_lost_the_other(tmp_path):
    path = tmp_path / "frames.npz"
    np.savez(path, range=IMAGE[None], unit="m")
    with pytest.raises(InputFileError, match=r"does not say its quantity: give quantity=range\|z"):
        read_frames(path, sensor=SMALL)
    assert read_frames(path, sensor=SMALL, quantity="range").range_m[0, 0].tolist() == IMAGE.tolist()


def test_ranges_no_such_camera_can_measure_are_invalid_with_a_warning(tmp_path):
    path = csv_file(tmp_path, "1,2,3,4,5,6\n1,0,-3,4,15,6\n")  # c / 2f is 14.99 m
    with pytest.warns(
        UserWarning, match=r"2 of 11 ranges .* frame 1, row 0, column 2: -3 m; taken as invalid"
    ) as caught:
        frames = read_frames(path, sensor=SMALL, **STATED)
    assert len(caught) == 1
    assert frames.valid[0, 1].tolist() == [[True, False, False], [True, False, True]]


def test_zeros_are_no_readings_and_say_nothing_of_the_unit(tmp_path):
    frames = read_frames(csv_file(tmp_path, "0,0,0,0,0,6\n"), sensor=SMALL, **STATED)
    assert frames.valid[0, 0].tolist() == [[False, False, False], [False, False, True]]


def test_a_mask_is_no_range(tmp_path):
    np.savez(tmp_path / "mask.npz", range=np.ones((1, SMALL.rows, SMALL.cols), np.bool_))
    with pytest.raises(InputFileError, match="'range' must hold real numbers, got bool"):
        read_frames(tmp_path / "mask.npz", sensor=SMALL, **STATED)


def test_nothing_but_zeros_is_an_error(tmp_path):
    with pytest.raises(InputFileError, match="every range is 0, which stands for no reading"):
        read_frames(csv_file(tmp_path, "0,0,0,0,0,0\n"), sensor=SMALL, **STATED)


DIRECT = SMALL.with_(kind="direct", modulation_hz=1e3, max_range_m=4.0)


@pytest.mark.parametrize(
    ("sensor", "unit", "text", "fitting"),
    [
        (DIRECT, "m", "590,700,800,900,1000,1693\n", "unit=mm (dividing by 1000)"),
        (DIRECT, "m", "59,70,80,90,100,169\n", "unit=cm (dividing by 100) or unit=mm (dividing by 1000)"),
        (DIRECT, "cm", "590,700,800,900,1000,1693\n", "unit=mm (dividing by 10)"),
        (SMALL, "m", "1600,2000,3000,4000,5000,6000\n", "unit=mm (dividing by 1000)"),
        (SMALL, "m", "-1,-2,-3,-4,-5,1\n", ""),
    ],
)
def test_the_error_names_the_units_in_which_every_range_would_be_possible(tmp_path, sensor, unit, text, fitting):
    with pytest.raises(InputFileError, match=r"[56] of 6 ranges") as caught:
        read_frames(csv_file(tmp_path, text), sensor=sensor, unit=unit, quantity="range")
    assert str(caught.value).endswith("is unit=… right?" + (f" All would fit with {fitting}" if fitting else ""))


@pytest.mark.parametrize(
    ("unit", "text", "fitting"),
    [
        ("mm", "0.59,0.7,0.8,0.9,1,1.693\n", "unit=m (multiplying by 1000)"),
        ("mm", "0.59,0.7,0,0.9,0.7,0.3\n", "unit=m (multiplying by 1000)"),
        ("cm", "0.59,0.7,0.8,0.9,0.7,0.3\n", "unit=m (multiplying by 100)"),
    ],
)
def test_ranges_that_no_lens_is_as_near_to_are_an_error_of_the_unit(tmp_path, unit, text, fitting):
    with pytest.raises(InputFileError, match=r"every range is below 0.01 m; is unit=… right\?") as caught:
        read_frames(csv_file(tmp_path, text), sensor=DIRECT, unit=unit, quantity="range")
    assert str(caught.value).endswith(fitting)


def test_a_direct_sensor_measures_little_beyond_its_largest_range(tmp_path):
    path = csv_file(tmp_path, "1,2,3,4,4.9,5.1\n")  # the limit is 1.25 · 4 m
    with pytest.warns(UserWarning, match=r"1 of 6 ranges are not in 0 … 5 m \(1.25 times the sensor's 'max_range_m'\)"):
        frames = read_frames(path, sensor=DIRECT, **STATED)
    assert frames.valid[0, 0].tolist() == [[True, True, True], [True, True, False]]
    path = csv_file(tmp_path, "1,2,3,4,5,60\n")
    assert read_frames(path, sensor=DIRECT.with_(max_range_m=None), **STATED).valid.all()


RECORDING = """t_ms,battery,mm_0,mm_1,mm_2,mm_3,mm_4,mm_5,status_0,status_1,status_2,status_3,status_4,status_5
100,3.9,1000,2000,3000,4000,5000,6000,5,5,5,5,5,5
166,3.9,1000,,3000,0,5000,6000,5,5,4,5,,nan
"""


def test_a_recording_with_named_columns_has_times_and_its_invalid_pixels(tmp_path):
    with pytest.warns(UserWarning, match="ignores the columns battery$"):
        frames = read_frames(csv_file(tmp_path, RECORDING), sensor=SMALL, quantity="range", valid_status=[5])
    assert frames.range_m.shape == (1, 2, 2, 3)
    np.testing.assert_allclose(frames.range_m[0, 0], IMAGE, rtol=1e-15)  # mm_* states the unit
    # an empty cell, a bad status, 0 mm, an empty status and a NaN status
    assert frames.valid[0, 1].ravel().tolist() == [True, False, False, False, False, False]
    np.testing.assert_allclose(frames.time_s, [[0.1, 0.166]], rtol=1e-15)


def named(prefix, lines=("1,2,3,4,5,6",), before="", after=""):
    header = before + ",".join(f"{prefix}_{k}" for k in range(6)) + after
    return "\n".join([header, *lines, ""])


@pytest.mark.parametrize(
    ("text", "options"),
    [
        (named("range"), {"unit": "m"}),
        (named("RANGE"), {"unit": "m"}),
        (named("range").replace(",", ";").replace("2;3", "2,0;3"), {"unit": "m"}),
        ("z_5,z_4,z_3,z_2,z_1,z_0\n6,5,4,3,2,1\n", {"unit": "m"}),
        (named("mm", ["1000,2000,3000,4000,5000,6000"]), {"quantity": "z"}),
        (named("mm", ["1000,2000,3000,4000,5000,6000"]).replace(",", " "), {"quantity": "z"}),
        ("# unit=m\n" + named("z"), {}),
        (named("z", ['1,2,3,4,5,6,"on; off"'], after=",truth_note"), {"unit": "m"}),
    ],
)
def test_named_columns_state_unit_or_quantity_and_stand_in_any_order(tmp_path, text, options):
    frames = read_frames(csv_file(tmp_path, text), sensor=SMALL, **options)
    is_range = "range" in text.lower()
    found = frames.range_m if is_range else frames.z_m
    np.testing.assert_allclose(found[0, 0], IMAGE, rtol=1e-15)  # one rounding of a product
    assert frames.time_s is None
    if "mm_" in text:  # millimetres do not say whether they are range or z
        with pytest.raises(UsageError, match=r"does not say its quantity: give quantity=range\|z"):
            read_frames(csv_file(tmp_path, text), sensor=SMALL)


def test_amplitudes_have_columns_of_their_own(tmp_path):
    groups = [",".join(f"{name}_{k}" for k in range(6)) for name in ("range", "amplitude", "intensity")]
    text = ",".join(["t_s", *groups]) + "\n" + ",".join(["0.5", "1,2,3,4,5,6", "7,7,7,7,7,7", "8,8,8,8,8,8"]) + "\n"
    frames = read_frames(csv_file(tmp_path, text), sensor=SMALL, unit="m")
    assert (frames.amplitude_e == 7).all()
    assert (frames.intensity_e == 8).all()
    assert frames.time_s.tolist() == [[0.5]]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (named("mm").replace("mm_2,", "", 1), r"line 1: has 5 columns 'mm_\*', must have 6, .*; 'mm_2' is missing"),
        (named("mm").replace("mm_5", "mm_6"), "'mm_5' is missing"),
        (named("mm", after=",mm_6"), r"has 7 columns 'mm_\*', must have 6, from 'mm_0' to 'mm_5' \(2 × 3 pixels\)$"),
        (named("mm", after=",status_0,status_1"), r"has 2 columns 'status_\*', must have 6"),
        (named("mm", after=",mm_3"), "names the column 'mm_3' twice"),
        (named("mm", after=",t_ms,t_ms"), "names the column 't_ms' twice"),
        (named("mm", after="," + named("z").partition("\n")[0]), "has columns mm_0 … and z_0 …: leave one of them out"),
        (named("mm", before="t_ms,t_s,"), "line 1: has both 't_ms' and 't_s'"),
        (named("depth", before="t_ms,"), "line 1: names no columns of pixels, which must be mm_0 … mm_5, range_0"),
        (
            named("mm", ["1,1,2,3,4,5,6", "x,1,2,3,4,5,6"], "t_ms,"),
            r"line 3, column 1 \(t_ms\) must be a number, got 'x'",
        ),
        (named("mm", ["1,1,2,3,4,5,6", ",1,2,3,4,5,6"], "t_s,"), "line 3: has no time: 't_s' must be a finite number"),
        (named("mm", ["1,1,2,3,4,5,6", "inf,1,2,3,4,5,6"], "t_s,"), "line 3: has no time"),
        (named("mm", ["1,2,3,4,5"]), "line 2 has 5 values, must have 6 \\(the columns that the header names\\)"),
        (
            named("mm", ["1.76e12,1,2,3,4,5,6"], "t_s,"),
            "line 2: 't_s' must be seconds, got 1.76e.12, which are 5.6e.04 y",
        ),
        (named("mm", ["1,2,3,?,5,6"]), r"line 2, column 4 \(mm_3\) must be a number, got '\?'"),
        (named("mm", []), "holds no frames"),
        ("# unit=m\n" + named("mm"), "line 2: has columns mm_0 …, but the first line says unit=m"),
    ],
)
def test_a_bad_header_or_line_of_a_recording_is_named(tmp_path, text, reason):
    path = csv_file(tmp_path, text)
    with pytest.raises(InputFileError, match=reason) as caught:
        read_frames(path, sensor=SMALL, quantity="range")
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_times_that_repeat_or_run_backwards_keep_their_order_with_one_warning(tmp_path):
    lines = [f"{t},1,2,3,4,5,6" for t in (10, 20, 20, 15, 30, 30)]
    with pytest.warns(
        UserWarning, match="2 of 6 time stamps repeat and 1 of 6 time stamps run backwards, the first in line 4"
    ) as caught:
        frames = read_frames(csv_file(tmp_path, named("z", lines, "t_ms,")), sensor=SMALL, unit="m")
    assert len(caught) == 1
    np.testing.assert_allclose(frames.time_s, [[0.01, 0.02, 0.02, 0.015, 0.03, 0.03]], rtol=1e-15)


@pytest.mark.parametrize("kind", ["npz", "h5"])
def test_arrays_have_times_too(tmp_path, kind):
    def written(**arrays):
        if kind == "npz":
            np.savez(tmp_path / "a.npz", range=np.stack([IMAGE, IMAGE]), **arrays)
            return tmp_path / "a.npz"
        return hdf5_file(tmp_path, {"range": np.stack([IMAGE, IMAGE]), **arrays})

    for name, scale in (("t_s", 1.0), ("t_ms", 1e-3)):
        frames = read_frames(written(**{name: np.array([1, 2])}), sensor=SMALL, **STATED)
        np.testing.assert_allclose(frames.time_s, [[scale, 2 * scale]], rtol=1e-15)
    with pytest.raises(InputFileError, match="has both 't_ms' and 't_s'"):
        read_frames(written(t_s=np.zeros(2), t_ms=np.zeros(2)), sensor=SMALL, **STATED)
    with pytest.raises(InputFileError, match="frame 1 has no time: 't_s' must be finite, got nan"):
        read_frames(written(t_s=np.array([0.0, np.nan])), sensor=SMALL, **STATED)
    with pytest.raises(InputFileError, match=r"one number for each frame, shape \(1, 2\), got \(3,\)"):
        read_frames(written(t_s=np.arange(3.0)), sensor=SMALL, **STATED)
    with pytest.warns(UserWarning, match="1 of 2 time stamps repeat, the first in frame 1"):
        read_frames(written(t_s=np.zeros(2)), sensor=SMALL, **STATED)


def test_times_survive_an_import(tmp_path):
    frames = read_frames(
        csv_file(tmp_path, named("z", ["10,1,2,3,4,5,6", "20,1,2,3,4,5,6"], "t_ms,")), sensor=SMALL, unit="m"
    )
    again = read_frames(write_measured(frames, tmp_path / "a.npz"), sensor=SMALL)
    assert again.time_s.tolist() == [[0.01, 0.02]]


@pytest.mark.parametrize("kind", ["csv", "npz"])
def test_the_tilt_of_each_frame_is_read_and_survives_an_import(tmp_path, kind):
    path = tmp_path / "a.npz"
    if kind == "csv":
        lines = ["3,1,2,3,4,5,6,10", "-4,1,2,3,4,5,6,20"]
        path = csv_file(tmp_path, named("z", lines, "roll_deg,", ",t_ms"))
    else:
        np.savez(path, range=np.stack([IMAGE, IMAGE]), roll_deg=np.array([3, -4]))
    frames = read_frames(path, sensor=SMALL, unit="m", quantity="z" if kind == "csv" else "range")
    tilt = np.radians([[[0, 3], [0, -4]]])
    np.testing.assert_allclose(frames.tilt_rad, tilt, rtol=1e-15)
    assert frames.each_a_position().tilt_rad.shape == (2, 1, 2)
    assert frames.some_frames(1, 2).tilt_rad.tolist() == tilt[:, 1:].tolist()
    again = read_frames(write_measured(frames, tmp_path / "b.npz"), sensor=SMALL)
    np.testing.assert_allclose(again.tilt_rad, tilt, rtol=1e-15)


def test_a_tilt_that_cannot_be_is_named(tmp_path):
    path = csv_file(tmp_path, named("z", ["3,1,2,3,4,5,6", "60,1,2,3,4,5,6"], "pitch_deg,"))
    with pytest.raises(InputFileError, match=r"line 3: 'pitch_deg' must be within ± 45°.*, got 60$"):
        read_frames(path, sensor=SMALL, unit="m")
    np.savez(tmp_path / "a.npz", range=np.stack([IMAGE, IMAGE]), pitch_deg=np.array([3, 50]))
    with pytest.raises(
        InputFileError, match=r"'tilt_rad' must be within ± 0.785 \(± 45°\), got pitch 0.87.* at frame 1"
    ):
        read_frames(tmp_path / "a.npz", sensor=SMALL, **STATED)
    with pytest.raises(UsageError, match=r"'tilt_rad' has shape \(2,\), but must have \(1, 2\)"):
        Frames(np.ones((1, 2, 3)), sensor=SMALL, tilt_rad=[0.1, 0.1])


def test_a_long_recording_with_empty_cells_is_read_in_seconds(tmp_path):
    # 100 000 lines of 64 zones take a few seconds; a fifth of that here, and ten times as long as it takes
    sensor = preset("vl53l5cx-8x8")
    n = 20_000
    cells = ["700"] * 64
    cells[7] = ""
    line = ",".join(cells[1:] + ["5"] * 64)
    header = ",".join(["t_ms"] + [f"mm_{k}" for k in range(64)] + [f"status_{k}" for k in range(64)])
    path = csv_file(tmp_path, header + "\n" + "".join(f"{66 * k},{700 + k % 2},{line}\n" for k in range(n)))
    start = time.process_time()
    frames = read_frames(path, sensor=sensor, quantity="z", valid_status=[5])
    assert time.process_time() - start < 15
    assert frames.valid.sum() == 63 * n
    assert frames.time_s[0, -1] == pytest.approx(66e-3 * (n - 1))


def saved(tmp_path, **arrays):
    np.savez(tmp_path / "a.npz", **arrays)
    return tmp_path / "a.npz"


def npy(tmp_path, values):
    np.save(tmp_path / "a.npy", values, allow_pickle=True)
    return tmp_path / "a.npy"


def cut(path, size):
    path.write_bytes(path.read_bytes()[:size])
    return path


def plain(tmp_path, content):
    (tmp_path / "a").write_bytes(content)
    return tmp_path / "a"


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda t: t / "absent.csv", "No such file"),
        (lambda t: t, "is a folder without PNG images, and no ROS bag"),
        (lambda t: plain(t, b"\x00\x01\x02"), "is not CSV, NPY, NPZ, HDF5 or PNG"),
        (lambda t: plain(t, b"\xff\xfe\xfd"), "is not CSV, NPY, NPZ, HDF5 or PNG"),
        (lambda t: npy(t, np.ones((3, 8, 8))), "8 × 8 pixels, but the sensor's have 2 × 3"),
        (lambda t: npy(t, np.ones((3, 6))), "3 × 6 pixels"),
        (lambda t: npy(t, np.ones(6)), r"must have shape .*got \(6,\)"),
        (lambda t: npy(t, np.ones((0, 2, 3))), "holds no frames"),
        (lambda t: npy(t, np.ones((2, 3), complex)), "real numbers, got complex128"),
        (
            lambda t: npy(t, np.array([[1, None, "x"]] * 2)),
            "must hold real numbers, got object",
        ),  # a pickle is never loaded
        (lambda t: cut(npy(t, np.ones((2, 3))), 100), "cannot be read"),
        (lambda t: cut(npy(t, np.ones((2, 3))), 140), "cannot be read"),
        (lambda t: saved(t, z=IMAGE), "must have an array 'range', got z"),
        (lambda t: saved(t, range=IMAGE, amplitude=np.ones((4, 2, 3))), "'amplitude' must have the shape of 'range'"),
        (lambda t: saved(t, range=IMAGE, amplitude=-IMAGE), "'amplitude_e' must be finite and not negative"),
        (lambda t: saved(t, range=IMAGE, unit="furlong"), "its unit must be one of m, cm, mm, got 'furlong'"),
        (lambda t: cut(saved(t, range=IMAGE), 200), "cannot be read"),
        (lambda t: hdf5_file(t, {"depth": IMAGE}), "must have a dataset 'range', got depth"),
        (lambda t: hdf5_file(t, {"range/x": IMAGE}), "must have a dataset 'range'"),
        (
            lambda t: hdf5_file(t, {"range": IMAGE, "amplitude": IMAGE}, {"amplitude": {"units": "mV"}}),
            "'amplitude' must be in electrons",
        ),
        (lambda t: cut(hdf5_file(t, {"range": IMAGE}), 600), "damaged or cut off"),
    ],
)
def test_a_bad_file_is_an_input_error_of_one_line(tmp_path, make, reason):
    path = make(tmp_path)
    with pytest.raises(InputFileError, match=reason) as caught:
        read_frames(path, sensor=SMALL, **STATED)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_header_of_pixel_numbers_is_no_frame(tmp_path):
    rows = [",".join(f"{1000 + k + 64 * frame}" for k in range(64)) for frame in range(3)]
    sensor = preset("vl53l5cx-8x8")
    for first in (0, 1):
        text = "\n".join([",".join(str(first + k) for k in range(64)), *rows])
        frames = read_frames(csv_file(tmp_path, text), sensor=sensor, unit="mm", quantity="range")
        assert frames.n_frames == 3
        assert frames.range_m[0, :, 0, 0].tolist() == pytest.approx([1.0, 1.064, 1.128])


def test_frames_that_repeat_the_one_before_are_noted(tmp_path):
    rng = np.random.default_rng(4)
    text = "\n".join(",".join(f"{value:.4f}" for value in rng.normal(1.0, 0.01, 6)) for _ in range(4))
    each_twice = "\n".join(line for line in text.splitlines() for _ in range(2))
    read_frames(csv_file(tmp_path, text), sensor=SMALL, **STATED)
    with pytest.warns(
        UserWarning, match="4 of 8 frames repeat the one before to the last digit, the first .* frame 1:"
    ):
        read_frames(csv_file(tmp_path, each_twice), sensor=SMALL, **STATED)
    with pytest.warns(UserWarning, match="19 of 20 frames repeat .* is the sensor stuck"):
        read_frames(csv_file(tmp_path, "\n".join([text.splitlines()[0]] * 20)), sensor=SMALL, **STATED)


@pytest.mark.parametrize("form", ["npz", "h5"])
def test_arrays_under_names_that_are_not_read_are_named(tmp_path, form):
    arrays: dict[str, Any] = {"range": IMAGE, "target_status": np.full(IMAGE.shape, 5), "truth_distance_m": np.ones(1)}
    if form == "npz":
        np.savez(tmp_path / "a.npz", unit=np.bytes_("m"), quantity="range", **arrays)
        path = tmp_path / "a.npz"
    else:
        words = {"units": np.bytes_("m"), "quantity": np.bytes_("range")}
        path = hdf5_file(tmp_path, arrays, {"range": words})
    with pytest.warns(UserWarning, match="ignores the arrays target_status$"):
        assert read_frames(path, sensor=SMALL).range_m[0, 0].tolist() == IMAGE.tolist()


def test_packed_arrays_are_refused(tmp_path):
    path = hdf5_file(tmp_path, {"range": IMAGE}, {"range": {"units": "m", "quantity": "range", "scale_factor": 0.25}})
    with pytest.raises(InputFileError, match="'range' is packed"):
        read_frames(path, sensor=SMALL)


def test_a_unit_that_the_file_states_wrongly_is_not_asked_of_the_caller(tmp_path):
    np.savez(tmp_path / "a.npz", range=IMAGE, unit="mm", quantity="range")
    with pytest.raises(InputFileError, match=r"is its unit, mm, right\? All would fit with m \(multiplying by 1000\)"):
        read_frames(tmp_path / "a.npz", sensor=SMALL)
