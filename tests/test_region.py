"""A region of a large sensor's pixels, binned: geometry, noise, banks that hold it, frames that are matched there."""

from dataclasses import replace

import numpy as np
import pytest

from phasemark import UsageError
from phasemark.data import BankPlan, build_bank
from phasemark.data.plans import planned_size
from phasemark.data.plans.landmark_region import whole_region
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, cramer_rao, phasor_mean
from phasemark.matcher.filters.filtered_frames import FilteredFrames, PixelState
from phasemark.matcher.filters.region import read_region
from phasemark.render import Background, Frames, Renderer, Sensor, Views, capture, predicted_range_std, preset
from phasemark.render.sensor.region import Region
from phasemark.render.sensor.sensor_file import sensor_toml

LARGE = Sensor(rows=84, cols=112, half_angle_h_deg=31, half_angle_v_deg=24, signal_e=5000, max_phase_std_rad=0.25)
OVERRIDES = LARGE.model_dump(mode="json")


def frames_of(sensor, amplitude, phase, std_rad=0.01, state=None, n=10.0):
    """One position of filtered frames with some amplitudes and phases."""
    shape = (1, sensor.rows, sensor.cols)
    amplitude, phase = np.broadcast_to(amplitude, shape), np.broadcast_to(phase, shape)
    state = np.zeros(shape, np.uint8) if state is None else state
    seen = state == PixelState.RETURN
    scale = sensor.metres_per_radian
    return FilteredFrames(
        range_m=np.where(seen, phase * scale, np.nan),
        std_m=np.where(seen, np.broadcast_to(std_rad, shape) * scale, np.nan),
        amplitude_e=np.array(amplitude, float),
        intensity_e=np.array(amplitude, float),
        state=state,
        n_effective=np.where(seen, n, 0.0),
        sensor=sensor,
    )


LENS = {
    "model": "opencv",
    "fx": 92.0,
    "fy": 93.0,
    "cx": 55.1,
    "cy": 42.2,
    "distortion": [-0.2, 0.05, 1e-3, -5e-4, 0.01],
}


@pytest.mark.parametrize("geometry", [{}, {"principal_point_px": (50.25, 44.5)}, {"lens": LENS}])
def test_a_region_is_a_camera_with_the_same_rays(geometry):
    sensor = LARGE.with_(**geometry, pitch_deg=3.0, roll_deg=-2.0)
    region = Region(12, 60, 20, 92, 4)
    camera = region.camera(sensor)
    assert (camera.rows, camera.cols) == region.shape == (12, 18)
    u, v = np.meshgrid(np.linspace(0, 18, 7), np.linspace(0, 12, 5))
    there = sensor.ray_directions(20 + 4 * u, 12 + 4 * v)
    np.testing.assert_allclose(camera.ray_directions(u, v), there, atol=1e-12)


@pytest.mark.parametrize("geometry", [{}, {"lens": LENS}])
def test_an_image_of_the_region_is_the_mean_of_its_blocks(geometry):
    region = Region(2, 82, 6, 106, 4)
    sensor = LARGE.with_(**geometry)
    renderer = Renderer(build_mesh(catalog()["cone"]), sensor)
    views = Views.broadcast([1.0, 1.4], [0.3, 1.1], [0.02, -0.05], [0.01, -0.02])
    whole = renderer.render_views(views)
    binned = renderer.seen_by(region.camera(sensor)).render_views(views)
    # both are exact to 1e-4 of the brightest pixel; a shift of a tenth of a pixel would be 0.1
    brightest = np.abs(binned.phasor).max()
    assert np.abs(region.blocks(whole.phasor).mean(axis=-1) - binned.phasor).max() < 1e-4 * brightest
    assert np.abs(region.blocks(whole.coverage).mean(axis=-1) - binned.coverage).max() < 2e-4


@pytest.mark.parametrize("geometry", [{}, {"lens": LENS}])
def test_a_small_region_in_a_corner_of_the_image_is_a_camera_too(geometry):
    """Its principal point lies five and more image sizes away."""
    sensor, region = LARGE.with_(**geometry), Region(4, 12, 6, 18, 2)
    camera = region.camera(sensor)
    u, v = np.meshgrid(np.linspace(0, camera.cols, 5), np.linspace(0, camera.rows, 5))
    there = sensor.ray_directions(6 + 2 * u, 4 + 2 * v)
    np.testing.assert_allclose(camera.ray_directions(u, v), there, atol=1e-12)
    assert Sensor(**camera.model_dump(mode="json")) == camera  # as a bank holds it
    renderer = Renderer(build_mesh(catalog()["cone"]), sensor)
    views = Views.broadcast(0.9, 0.4, [0.42, 0.45], [0.25, 0.22])
    background = Background(wall_m=2.5, floor_m=1.0)
    whole = renderer.render_views(views, background=background)
    seen = renderer.seen_by(camera).render_views(views, background=background)
    assert seen.coverage.max() > 0.9
    error = np.abs(region.blocks(whole.phasor).mean(axis=-1) - seen.phasor).max()
    assert error < 1e-4 * np.abs(whole.phasor).max()  # both are exact to that


def test_a_file_may_hold_the_camera_of_a_region_in_a_corner(tmp_path):
    camera = Region(4, 12, 6, 18, 2).camera(LARGE.with_(lens=LENS))
    path = tmp_path / "camera.toml"
    path.write_text(sensor_toml(camera, {}, header=(), otherwise="measured"), encoding="utf-8")
    assert Sensor.from_toml(path) == camera
    text = path.read_text(encoding="utf-8")
    path.write_text("".join(line for line in text.splitlines(True) if "whole_image_px" not in line), encoding="utf-8")
    with pytest.raises(UsageError, match=r"camera.toml: 'lens.cx' must lie near the middle of an image of 6 columns"):
        Sensor.from_toml(path)


def test_blocks_add_up_phasors():
    rng = np.random.default_rng(4)
    region = Region(4, 76, 8, 104, 3)
    amplitude = rng.uniform(100, 900, (1, LARGE.rows, LARGE.cols))
    phase = rng.uniform(0.5, 1.5, amplitude.shape)
    frames = frames_of(LARGE, amplitude, phase, 0.02)
    found = read_region(frames, region)
    assert read_region(replace(frames, overdispersion=np.ones(1)), region).overdispersion == 1
    for row, col in ((0, 0), (5, 11), (23, 31)):
        block = np.s_[0, 4 + 3 * row : 7 + 3 * row, 8 + 3 * col : 11 + 3 * col]
        phasor = (amplitude[block] * np.exp(1j * phase[block])).sum()
        std = 0.02 * np.sqrt((amplitude[block] ** 2).sum()) / abs(phasor)
        assert found.amplitude_e[0, row, col] == pytest.approx(abs(phasor))
        assert found.range_m[0, row, col] == pytest.approx(np.angle(phasor) * LARGE.metres_per_radian)
        assert found.std_m[0, row, col] == pytest.approx(std * LARGE.metres_per_radian)
        assert found.n_effective[0, row, col] == pytest.approx(10.0)
        assert found.intensity_e[0, row, col] == pytest.approx(amplitude[block].sum())


def test_noise_of_blocks_is_that_of_the_camera_that_reads_them():
    """4 000 captures of a slanted plate, averaged by blocks, scatter as the noise law of the binned camera has it."""
    import trimesh

    sensor = Sensor(rows=8, cols=8, half_angle_h_deg=6, half_angle_v_deg=6, signal_e=4000, read_noise_e=12, dark_e=40)
    region = Region(0, 8, 0, 8, 4)
    camera = region.camera(sensor)
    renderer = Renderer(trimesh.creation.box((0.002, 3.0, 3.0)), sensor)
    image = renderer.render(1.5, 0.4)
    n = 4000
    frames = capture(image, sensor, rng=np.random.default_rng(8), n_frames=n)
    alone = Frames(
        *(part[0][:, None] for part in (frames.range_m, frames.amplitude_e, frames.intensity_e)), sensor=sensor
    )
    found = read_region(phasor_mean(alone), region)
    predicted = renderer.seen_by(camera).render(1.5, 0.4)
    law = predicted_range_std(predicted.amplitude, predicted.intensity, camera)[0]
    ratio = found.range_m.std(axis=0, ddof=1) / law
    # a scatter of n values has a standard deviation of 1 / √(2n) of it, 1.1 %
    np.testing.assert_allclose(ratio, 1.0, atol=4 * 0.011)
    np.testing.assert_allclose(found.std_m.mean(axis=0) / law, 1.0, atol=0.01)
    bias = (found.range_m.mean(axis=0) - predicted.range_m[0]) / (law / np.sqrt(n))
    assert np.abs(bias).max() < 4.5


def test_what_a_block_says_of_pixels_without_a_return():
    region = Region(0, 8, 0, 8, 4)
    sensor = LARGE.with_(rows=8, cols=8)
    state = np.zeros((1, 8, 8), np.uint8)
    state[0, 1, 1] = PixelState.MISSING
    state[0, :4, 4:] = PixelState.NO_RETURN
    state[0, 4:, :4] = PixelState.NO_RETURN
    amplitude = np.full((1, 8, 8), 200.0)
    amplitude[0, :4, 4:] = 0.0  # nothing came back
    amplitude[0, 4:, :4] = 12.0  # each too dim by itself, together bright enough
    intensity = amplitude + 40.0
    frames = frames_of(sensor, amplitude, 1.0, state=state)
    frames.intensity_e[:] = intensity
    found = read_region(frames, region).state[0]
    expected = [[PixelState.MISSING, PixelState.NO_RETURN], [PixelState.MISSING, PixelState.RETURN]]
    np.testing.assert_array_equal(found, expected)


def test_the_region_of_landmarks_holds_what_they_cover():
    plan = BankPlan(
        classes=("cone", "sphere"), sensor_overrides=OVERRIDES, region="landmark", binning=4, margin_deg=4,
        distance_m="0.8:2:0.4", delta_deg="0:150:30", layout="full",
    ).resolve()  # fmt: skip
    region = plan.pixel_region()
    assert plan.resolve() == plan
    assert region.shape[0] * region.shape[1] < 0.5 * 21 * 28
    outside = np.ones((LARGE.rows, LARGE.cols), bool)
    outside[region.first_row : region.stop_row, region.first_col : region.stop_col] = False
    bearing = np.radians([-4.0, 0.0, 4.0])
    for name in ("cone", "sphere"):
        image = Renderer(build_mesh(catalog()[name]), LARGE).render(
            np.repeat([0.8, 2.0], 9), np.tile(np.repeat(np.radians([0, 40, 90]), 3), 2), np.tile(bearing, 6)
        )
        assert image.coverage.max() > 0.9
        assert image.coverage[:, outside].max() == 0


def test_a_plan_of_every_pixel_is_written_as_before_and_whole_blocks_may_leave_a_border():
    assert not {"region", "binning", "margin_deg"} & set(BankPlan().resolve().model_dump())
    assert BankPlan(binning=4).resolve().region == (0, 16, 0, 16)
    region = whole_region(LARGE.with_(rows=83), 4)
    region.check(LARGE.with_(rows=83))
    assert region.shape == (20, 28)


def test_size_of_a_bank_counts_the_regions_pixels():
    plan = BankPlan(classes=("cone",), layout="full", distance_m="1:2:0.5", delta_deg="0:170:10", binning=4)
    assert planned_size(plan) == {"images": 54, "bytes": 54 * 16 * 16}


@pytest.fixture(scope="module")
def bank():
    plan = BankPlan(
        classes=("cone", "cylinder"), sensor_overrides=OVERRIDES, region="landmark", binning=4,
        distance_m="0.98:1.34:0.02", delta_deg="0:178:2", layout="full",
    )  # fmt: skip
    with build_bank(plan) as built:
        yield built


def test_frames_of_the_whole_camera_match_at_the_bound(bank):
    rng = np.random.default_rng(11)
    n = 60
    views = Views.broadcast(rng.uniform(1.0, 1.3, n), rng.uniform(0, np.pi, n))
    renderer = Renderer(build_mesh(catalog()["cone"]), LARGE)
    frames = phasor_mean(capture(renderer.render_views(views), LARGE, rng=rng, n_frames=40))
    found = Matcher(bank, "refine", free=("distance_m", "delta_rad")).match(frames)
    bound = cramer_rao(renderer.seen_by(bank.sensor), views, n_frames=40).covariance
    error = np.column_stack([found.distance_m - views.distance_m, found.delta_rad - views.delta_rad])
    error[:, 1] = (error[:, 1] + np.pi / 2) % np.pi - np.pi / 2
    good = found.accepted & (found.class_name == "cone")
    assert good.mean() > 0.75
    assert not (found.accepted & ~good).any()
    nees = np.einsum("ni,nij,nj->n", error[good], np.linalg.inv(bound[good]), error[good])
    # χ² of 2 · n degrees of freedom: the mean of n values has a standard deviation of 2 / √n
    assert abs(nees.mean() - 2) < 4 * 2 / np.sqrt(good.sum())
    assert np.abs(error[found.accepted]).max() < 0.05


def test_nearest_image_of_frames_of_the_whole_camera(bank):
    renderer = Renderer(build_mesh(catalog()["cylinder"]), LARGE)
    image = renderer.render([1.0, 1.3], [0.5, 2.0])
    found = Matcher(bank).match(phasor_mean(capture(image, LARGE, rng=np.random.default_rng(2), n_frames=40)))
    np.testing.assert_allclose(found.distance_m, [1.0, 1.3], atol=0.021)
    assert found.class_name.tolist() == ["cylinder", "cylinder"]


def test_frames_of_a_camera_that_reads_the_region_itself(bank):
    image = Renderer(build_mesh(catalog()["cone"]), bank.sensor).render(1.2, 0.7)
    frames = phasor_mean(capture(image, bank.sensor, rng=np.random.default_rng(2), n_frames=40))
    assert Matcher(bank).read_out(frames) is frames


def test_a_bank_of_a_region_describes_it(bank):
    info = bank.info()
    assert info["binning"] == 4
    assert info["region"].endswith("of 84 × 112")
    assert bank.camera.optics_difference(LARGE) is None


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"region": (0, 300, 0, 8)}, "the region's rows must lie in 0 … 16, got 0 … 300"),
        ({"region": (0, 8, 9, 9)}, "the region's columns must lie in 0 … 16, got 9 … 9"),
        ({"region": (0, 9, 0, 8), "binning": 4}, "the region's rows 0 … 9 do not make whole blocks of 4: end it at 8"),
        ({"binning": 20}, "'binning' must be at most 16, the image's size, got 20"),
        ({"binning": 0}, "'binning' must be greater than or equal to 1"),
        ({"binning": 2, "sensor_overrides": {"fill_factor": [0.6, 0.8]}}, "'binning' takes pixels without gaps, got a"),
        ({"sensor": "vl53l5cx-8x8", "region": "landmark"}, "belong to phase cameras"),
        ({"region": "landmark", "sensor_overrides": {"pitch_deg": -40}}, "no landmark is in view at any distance"),
    ],
)
def test_regions_that_cannot_be_are_refused(fields, message):
    with pytest.raises(UsageError, match=message):
        BankPlan(classes=("cone",), layout="full", **fields).resolve()


def test_adding_up_pixels_takes_amplitudes(bank):
    frames = phasor_mean(Frames(np.full((1, 2, 84, 112), 1.2), sensor=LARGE))
    with pytest.raises(UsageError, match="adding up pixels takes amplitudes"):
        Matcher(bank).match(frames)


def test_frames_of_another_camera_are_refused(bank):
    frames = phasor_mean(Frames(np.full((1, 2, 16, 16), 1.2), sensor=preset("pmd-16x16")))
    with pytest.raises(UsageError, match="another sensor than the bank's: 'rows' is 16 here and 84 there"):
        Matcher(bank).match(frames)
