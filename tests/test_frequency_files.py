"""Files of several modulation frequencies: banks, frame sets, exports, and what somebody else measured."""

import h5py
import numpy as np
import pytest
import xarray
from builders import error_lines

from phasemark import InputFileError, UsageError
from phasemark.cli import main
from phasemark.data import BankPlan, FramePlan, build_bank, build_frames, open_frames, read_frames
from phasemark.data.export import export_frames
from phasemark.data.measured.reading import write_measured
from phasemark.data.measured.simulated import simulate_recording
from phasemark.data.partial_outputs import build_part, merge_parts
from phasemark.data.plans import planned_size
from phasemark.data.seeds import stream
from phasemark.data.verify import verify_bank, verify_frames
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Flag, Renderer, Sensor, capture, preset

TWO = preset("pmd-16x16").with_(modulation_hz=[20e6, 60e6])
FRAMES = FramePlan(
    classes=["cylinder", "post"],
    views=4,
    frames_per_view=3,
    seed=3,
    distance_m={"uniform": [0.8, 1.2]},
    wall_m=5.0,
    sensor_overrides={"modulation_hz": [20e6, 60e6]},
    variants=["mixed", "shot"],
    keep_taps=True,
)
BANK = BankPlan(
    classes=["cylinder", "post"],
    distance_m="0.9:1.1:0.1",
    delta_deg="0:170:10",
    sensor_overrides={"modulation_hz": [60e6, 20e6]},
)


@pytest.fixture(scope="module")
def frames_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("frames") / "frames.h5"
    build_frames(FRAMES, path, workers=1).close()
    return path


@pytest.fixture
def sensor_file(tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(
        "rows = 16\ncols = 16\nhalf_angle_h_deg = 11\nhalf_angle_v_deg = 11\nmodulation_hz = [20e6, 60e6]\n",
        encoding="utf-8",
    )
    return str(path)


def taken(n_frames=3):
    renderer = Renderer(build_mesh(catalog()["cylinder"]), TWO)
    image = renderer.render([0.9, 1.1], 0.3, background=Background(wall_m=5.0))
    return capture(image, TWO, rng=np.random.default_rng(1), n_frames=n_frames, keep_taps=True)


def test_a_frame_set_holds_what_each_frequency_measured(frames_file):
    with open_frames(frames_file) as opened:
        assert opened.sensor == TWO
        frames = opened.frames(slice(0, 3))
        truth = {name: values[0] for name, values in opened.truth.items()}
        image = Renderer(opened.mesh(opened.classes[truth["class_index"]]), TWO, albedo=truth["albedo"]).render(
            truth["distance_m"], truth["delta_rad"], truth["bearing_rad"], truth["height_m"],
            background=Background(wall_m=5.0),
        )  # fmt: skip
        again = capture(image, TWO, rng=stream(3, "frames.noise", 0), n_frames=3)
        np.testing.assert_allclose(frames.range_m[:, 0], again.range_m[0], atol=1e-6)  # float32
        for part, own in zip(frames.by_frequency, again.by_frequency, strict=True):
            np.testing.assert_allclose(part.range_m[:, 0], own.range_m[0], atol=1e-6)
            np.testing.assert_allclose(part.amplitude_e[:, 0], own.amplitude_e[0], rtol=1e-6)
            np.testing.assert_array_equal(part.flags[:, 0], own.flags[0])
        sample = opened[0]
        assert sample["frequency_range_m"].shape == (2, 16, 16)
        assert sample["taps_e"].shape == (8, 2, 16, 16)
        assert opened.view(2).by_frequency[1].range_m.shape == (1, 3, 16, 16)
    verify_frames(frames_file, sample=2)


def test_xarray_sees_the_frequencies(frames_file):
    with xarray.open_dataset(frames_file, engine="h5netcdf", phony_dims="sort") as data:
        assert data["frequency_range"].dims == ("frame", "frequency", "row", "col")
        assert data["frequency"].values.tolist() == [20e6, 60e6]
        assert data["phase"].values.tolist() == [0, 90, 180, 270] * 2
        assert data["flags"].attrs["flag_meanings"].split()[-1] == "inconsistent"


def test_a_frame_set_is_as_large_as_planned_and_the_same_from_shards(frames_file, tmp_path):
    assert abs(planned_size(FRAMES)["bytes"] - frames_file.stat().st_size) < 2e6  # header and meshes
    parts = []
    for k in (1, 2):
        part = tmp_path / f"part{k}.h5"
        build_part(FRAMES, (k, 2), part, workers=1)
        parts.append(part)
    merge_parts(parts, tmp_path / "merged.h5")
    assert (tmp_path / "merged.h5").read_bytes() == frames_file.read_bytes()


def test_a_frame_set_of_other_frequencies_than_its_sensor_is_refused(frames_file, tmp_path):
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes(frames_file.read_bytes())
    with h5py.File(damaged, "r+") as file:
        file["frequency"][1] = 50e6
    with pytest.raises(InputFileError, match="'frequency' must be 20000000 and 60000000 Hz"):
        open_frames(damaged)


def test_a_bank_holds_phasors_at_every_frequency(tmp_path):
    path = tmp_path / "bank.h5"
    with build_bank(BANK, path, workers=1) as bank:
        image = Renderer(build_mesh(catalog()["post"]), bank.sensor).render(1.0, np.deg2rad(20))
        for hz in (60e6, 20e6):
            # the bank has the parts of the landmark by themselves: their edges are cut in other places
            np.testing.assert_allclose(bank.phasor("post", 1, 2, hz), image.at_frequency(hz)[0], atol=5e-5)
            np.testing.assert_allclose(bank.image("post", 1, 2).at_frequency(hz), image.at_frequency(hz), atol=5e-5)
        np.testing.assert_array_equal(bank.phasor("post", 1, 2), bank.phasor("post", 1, 2, 60e6))
        assert bank.lower.frequency_hz.tolist() == [20e6, 60e6]  # rising, as dimension scales are
        assert bank.info()["modulation_hz"] == (60e6, 20e6)
        with pytest.raises(UsageError, match="no phasors at 30000000 Hz, only at 20000000 and 60000000 Hz"):
            bank.phasor("post", 1, 2, 30e6)
    verify_bank(path, sample=2)
    assert abs(planned_size(BANK)["bytes"] - path.stat().st_size) < 2e6


@pytest.mark.parametrize("to", ["npz", "csv", "ply", "png16"])
def test_frames_of_several_frequencies_are_exported(frames_file, tmp_path, to):
    with open_frames(frames_file) as opened:
        written, frames = export_frames(opened, tmp_path / f"out.{to}", to), opened.frames()
    if to == "npz":
        back = read_frames(written, sensor=TWO)
        for part, own in zip(back.by_frequency, frames.by_frequency, strict=True):
            np.testing.assert_allclose(part.range_m[0], own.range_m[:, 0], atol=1e-6)
        same = np.isfinite(back.range_m[0]) == np.isfinite(frames.range_m[:, 0])
        assert same.mean() > 0.999  # what was dark at one frequency is no return here and NaN there
    elif to == "csv":
        assert read_frames(written, sensor=TWO).by_frequency == ()


def test_measured_frames_come_back_with_every_frequency(tmp_path):
    frames = taken()
    back = read_frames(write_measured(frames, tmp_path / "frames.npz"), sensor=TWO)
    for part, own in zip(back.by_frequency, frames.by_frequency, strict=True):
        good = own.valid & frames.valid
        np.testing.assert_allclose(part.range_m[good], own.range_m[good])
        np.testing.assert_allclose(part.amplitude_e, own.amplitude_e)
    np.testing.assert_allclose(back.range_m, frames.range_m)


def arrays_of(frames):
    def stacked(name):
        return np.stack([getattr(part, name) for part in frames.by_frequency], axis=2)[0]

    return {
        "frequency_range": stacked("range_m"),
        "frequency_amplitude": stacked("amplitude_e"),
        "frequency_intensity": stacked("intensity_e"),
    }


@pytest.mark.parametrize("kind", ["npz", "h5", "csv", "named csv"])
def test_files_with_a_frequency_dimension_are_read_and_unwrapped(tmp_path, kind):
    frames = taken()
    arrays = arrays_of(frames)
    path = tmp_path / f"frames.{kind.split()[-1]}"
    if kind == "npz":
        np.savez(path, **arrays, frequency=[20e6, 60e6], taps=frames.taps_e[0], unit="m", quantity="range")
    elif kind == "h5":
        with h5py.File(path, "w") as file:
            for name, values in arrays.items():
                file[name] = values
            file["frequency_range"].attrs.update(units="m", quantity="range")
    else:
        ranges = arrays["frequency_range"].reshape(3, -1)
        with path.open("w", encoding="utf-8") as file:
            file.write("# unit=m quantity=range\n")
            if kind == "named csv":
                file.write(",".join(f"range_{k}" for k in range(512)) + "\n")
            np.savetxt(file, ranges, delimiter=",", fmt="%.9g")
    read = read_frames(path, sensor=TWO)
    for part, own in zip(read.by_frequency, frames.by_frequency, strict=True):
        np.testing.assert_allclose(part.range_m[0], own.range_m[0], atol=1e-7)
    both = read.valid[0] & frames.valid[0]
    assert both.mean() > 0.8
    # without amplitudes both frequencies count with the same phase noise
    np.testing.assert_allclose(read.range_m[0][both], frames.range_m[0][both], atol=1e-6 if "csv" not in kind else 0.02)
    if kind == "npz":
        np.testing.assert_array_equal(read.taps_e[0], frames.taps_e[0])


BOTH = "at 20000000 and 60000000 Hz"
MISFITS = [
    (lambda a: {**a, "frequency": [20e6, 50e6]}, "has frames at 20000000 and 50000000 Hz, but the sensor modulates"),
    (lambda a: {**a, "frequency": [20e6]}, f"has frames at 20000000 Hz, but the sensor modulates {BOTH}"),
    (lambda a: {k: v[:, :1] for k, v in a.items()}, "'frequency_range' has 1 frequencies, but the sensor has 2: 200"),
    (
        lambda a: {**a, "taps": np.zeros((3, 4, 2, 16, 16))},
        "'taps' has 4 phase images a frame, but the sensor takes 8: 4 at each of 2 modulation frequencies",
    ),
    (lambda a: {"frequency_amplitude": a["frequency_amplitude"]}, "must have an array 'range'"),
    (lambda a: {**a, "frequency_amplitude": a["frequency_amplitude"][:2]}, "must have the frames of"),
    (lambda a: {"frequency_range": a["frequency_range"][..., :8]}, "16 × 8 pixels, but the sensor's have 16 × 16"),
]


def test_files_that_do_not_fit_the_frequencies_are_refused_in_one_line(tmp_path):
    path, arrays = tmp_path / "frames.npz", arrays_of(taken())
    one = (lambda a: a, "'frequency_range' has 2 frequencies, but the sensor has 1: 10000000 Hz")
    for sensor, (change, message) in [*((TWO, misfit) for misfit in MISFITS), (preset("pmd-16x16"), one)]:
        np.savez(path, **change(arrays), unit="m", quantity="range")
        with pytest.raises(InputFileError) as error:
            read_frames(path, sensor=sensor)
        assert message in str(error.value)
        assert str(error.value).startswith(str(path))
        assert "\n" not in str(error.value)
    path = tmp_path / "frames.csv"
    path.write_text("# unit=m quantity=range\n" + ",".join(["1"] * 300) + "\n", encoding="utf-8")
    with pytest.raises(InputFileError, match=r"has 300 values, must have 512 \(16 × 16 pixels at each of 2 freq"):
        read_frames(path, sensor=TWO)


def test_a_simulated_recording_keeps_every_frequency():
    view = Renderer(None, TWO).render([1.0, 1.0], 0.2).views
    recording = simulate_recording(build_mesh(catalog()["post"]), "post", TWO, view, seed=1)
    assert [part.range_m.shape for part in recording.frames.by_frequency] == [(1, 2, 16, 16)] * 2


def test_commands_render_and_show_several_frequencies(tmp_path, capsys, sensor_file):
    out = tmp_path / "one.png"
    assert main(["render", "--class", "post", "--distance", "1", "--sensor", sensor_file, "-o", str(out)]) == 0
    with np.load(out.with_suffix(".npz")) as data:
        assert data["frequency"].tolist() == [20e6, 60e6]
        np.testing.assert_array_equal(data["frequency_phasor"][0], data["phasor"])
    capsys.readouterr()
    assert main(["sensor", "show", sensor_file]) == 0
    shown = capsys.readouterr().out
    assert "# unambiguous range 7.4948 m, 1.192836, 0.397612 m per radian" in shown
    assert "modulation_hz = [20000000.0, 60000000.0]" in shown


def test_a_distance_beyond_the_frequencies_is_refused_with_the_divisor_that_would_do(tmp_path, capsys, sensor_file):
    options = ["--class", "post", "--distance", "1", "--wall", "10", "--sensor", sensor_file]
    assert main(["render", *options, "-o", str(tmp_path / "one.png")]) == 2
    (line,) = error_lines(capsys.readouterr().err)
    assert "--wall at 10 m is beyond c / (2 gcd f) = 7.495 m" in line
    assert "a common divisor below 1.499e+07 Hz" in line


def test_flags_of_frames_and_files_are_the_same():
    assert [flag.value for flag in Flag] == [1, 2, 4, 8, 16, 32, 64]


@pytest.mark.parametrize("options", [[], ["--frequency", "30e6"]])
def test_a_data_sheet_asks_which_frequency(tmp_path, capsys, sensor_file, options):
    assert main(["sensor", "characterise", sensor_file, "-o", str(tmp_path / "sheet"), *options]) == 2
    (line,) = error_lines(capsys.readouterr().err)
    assert "--frequency must be one of the sensor's 20000000 and 60000000 Hz, got" in line
    assert not (tmp_path / "sheet").exists()


def test_a_fit_takes_the_frequency_that_is_named(tmp_path, capsys, sensor_file):
    out, files = tmp_path / "fitted.toml", []
    for distance in (1.0, 1.6):
        image = Renderer(None, TWO).render(1.0, background=Background(wall_m=distance, wall_albedo=0.8))
        frames = capture(image, TWO, rng=np.random.default_rng(3), n_frames=12)
        files.append(write_measured(frames, tmp_path / f"board_{distance}.npz"))
    arguments = ["sensor", "fit", *map(str, files), "--distance", "1.0", "--distance", "1.6", "--albedo", "0.8"]
    assert main([*arguments, "--sensor", sensor_file, "--frequency", "60e6", "-o", str(out)]) == 0
    capsys.readouterr()
    fitted = Sensor.from_toml(out)
    assert fitted.modulation_hz == 60e6
    assert fitted.signal_e == pytest.approx(TWO.signal_e, rel=0.05)
