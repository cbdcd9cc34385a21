"""What the spacing of a bank's grid costs, against what uniform rounding and direct differences say it must."""

import json
import math
from dataclasses import replace

import h5py
import numpy as np
import pytest

from phasemark import UsageError
from phasemark.cli import main
from phasemark.data import BankPlan, build_bank, open_bank
from phasemark.data.files import write_checksum
from phasemark.inputs import checksum_path
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher.accuracy import grid_loss
from phasemark.matcher.filters import noise_free
from phasemark.render import Renderer, capture, predicted_range_std, preset

SENSOR = preset("pmd-16x16")


@pytest.fixture(scope="module")
def banks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("banks")
    for name, distance, delta in (("coarse", "0.95:1.05:0.01", "0:180:1"), ("fine", "0.95:1.05:0.005", "0:180:0.5")):
        build_bank(BankPlan(classes=["cone", "post"], distance_m=distance, delta_deg=delta), folder / name).close()
    return folder


@pytest.fixture(scope="module")
def losses(banks):
    found = {}
    for name in ("coarse", "fine"):
        with open_bank(banks / name) as bank:
            found[name] = grid_loss(bank, 400, seed=1)
    return found


def test_the_nearest_image_is_off_by_the_rounding_of_the_grid(losses):
    for name, step_m, step_deg in (("coarse", 0.01, 1.0), ("fine", 0.005, 0.5)):
        nearest = losses[name].nearest
        # a uniform error within half a step has an r.m.s. of step / √12, known to 1/√(5 · 400) · 3.3 = 7 %; D and δ are
        # coupled where faces are seen aslant: another row of the grid can be nearer, worse in δ
        assert nearest.distance_rms_m == pytest.approx(step_m / math.sqrt(12), rel=0.12)
        assert 0.93 * step_deg / math.sqrt(12) < nearest.delta_rms_deg < 2.2 * step_deg / math.sqrt(12)


def test_half_the_spacing_costs_half_the_error_and_a_quarter_of_the_mismatch(losses):
    coarse, fine = losses["coarse"], losses["fine"]
    assert coarse.nearest.distance_over_bound / fine.nearest.distance_over_bound == pytest.approx(2, rel=0.15)
    # twice squared, and a third about it: the image is chosen by ranges below, the mismatch is that of all phasors
    assert 3 < coarse.mismatch_median / fine.mismatch_median < 5.5
    assert coarse.mismatch_99 > coarse.mismatch_median > 0


def test_interpolation_costs_far_less_than_the_noise(losses):
    for loss in losses.values():
        assert loss.refined.class_errors == 0
        assert loss.refined.distance_over_bound < 0.1 < 1 < loss.nearest.distance_over_bound


def test_at_the_suggested_steps_a_view_is_one_standard_deviation_from_the_four_images_around_it(losses):
    loss = losses["fine"]
    renderer = Renderer(build_mesh(catalog()["cone"]), SENSOR, albedo=catalog()["cone"].albedo)
    rng = np.random.default_rng(3)
    n = 600
    distance, delta = rng.uniform(0.9, 1.1, n), rng.uniform(0, math.pi, n)
    here = renderer.render(distance, delta)
    std = predicted_range_std(here.amplitude, here.intensity, SENSOR) / math.sqrt(50)
    # the interior of the image: at edges a pixel appears or goes, which is no matter of differences
    used = (std * math.sqrt(50) < 0.1 * SENSOR.metres_per_radian) & (np.arange(16)[:, None] >= 8)
    half_m, half_rad = loss.suggested_distance_m / 2, math.radians(loss.suggested_delta_deg) / 2
    for change in ((half_m, 0.0), (0.0, half_rad)):
        there = renderer.render(distance + change[0], delta + change[1])
        used &= there.amplitude > 0
        squares = np.where(used, ((there.range_m - here.range_m) / std) ** 2, 0.0).sum(axis=(1, 2))
        # median of 600 against that of 400 other views, of which half are of the other class, on the same lower part
        assert np.median(squares) == pytest.approx(0.5, rel=0.25)


def test_the_matcher_itself_is_asked(banks, tmp_path):
    """Two classes whose images have changed places are taken for each other, each and every one."""
    path = tmp_path / "swapped.h5"
    path.write_bytes((banks / "fine").read_bytes())
    checksum_path(path).unlink(missing_ok=True)
    with h5py.File(path, "r+") as file:
        for field in ("phasor", "intensity", "coverage"):
            file[f"upper/{field}"][...] = file[f"upper/{field}"][...][::-1]
    write_checksum(path)
    with open_bank(path) as bank:
        loss = grid_loss(bank, 20)
    assert loss.nearest.class_errors == loss.views == 20
    assert math.isnan(loss.nearest.distance_rms_m)
    assert "nearest_distance_rms_m" not in loss.as_dict()


def test_views_lie_beyond_the_last_angle_where_the_grid_closes(tmp_path, monkeypatch):
    from phasemark.matcher.accuracy import grid_spacing as population

    seen = []
    render = noise_free
    monkeypatch.setattr(
        population, "noise_free", lambda images, n: (seen.append(images.views.delta_rad), render(images, n))[1]
    )
    plan = BankPlan(classes=["cone"], distance_m="0.9,1", delta_deg="0:180:30", model="planar")
    with build_bank(plan, tmp_path / "bank.h5") as bank:
        grid_loss(bank, 100)
    # six angles that close at 180°: none of 100 views in the last cell has a chance of 1e-8
    assert 150 < np.rad2deg(np.concatenate(seen)).max() < 180


def test_a_planar_bank_is_tested_without_refinement_and_a_grid_without_spacing_is_refused(tmp_path):
    plan = BankPlan(classes=["cone"], distance_m="0.9:1.1:0.02", delta_deg="0:90:2", model="planar")
    with build_bank(plan, tmp_path / "bank.h5") as bank:
        loss = grid_loss(bank, 100)
    assert loss.refined is None
    assert loss.nearest.distance_rms_m == pytest.approx(0.02 / math.sqrt(12), rel=0.25)
    with (
        build_bank(plan.model_copy(update={"distance_m": (1.0,)})) as bank,
        pytest.raises(UsageError, match="one distance or one angle only"),
    ):
        grid_loss(bank, 10)


def test_the_command_reports_what_the_function_finds(banks, capsys):
    assert main(["bank", "verify", str(banks / "coarse"), "--population", "30", "--seed", "4", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    with open_bank(banks / "coarse") as bank:
        for key, value in grid_loss(bank, 30, seed=4).as_dict().items():
            assert report[key] == pytest.approx(value, rel=0.01)  # three digits
    assert report["rendered_again"] == 16


def test_noise_free_frames_are_the_limit_of_many_noisy_ones():
    image = Renderer(build_mesh(catalog()["cone"]), SENSOR).render(1.0, 0.4)
    ideal = noise_free(image, 50)
    returned = ideal.state == 0
    sensor = SENSOR.with_(max_phase_std_rad=None)
    frames = capture(replace(image, sensor=sensor), sensor, rng=np.random.default_rng(8), n_frames=4000)
    mean, std = frames.range_m.mean(axis=1), frames.range_m.std(axis=1, ddof=1)
    # N = 4000, about 100 pixels: the mean is within 4.5 σ/√N (99.9 % over all), the standard deviation within 5 %
    assert (np.abs(mean - ideal.range_m)[returned] < 4.5 * (std / math.sqrt(4000))[returned] + 2e-4).all()
    np.testing.assert_allclose(ideal.std_m[returned], (std / math.sqrt(50))[returned], rtol=0.06)
    assert (ideal.n_effective[returned] == 50).all()
    assert not ideal.n_effective[~returned].any()
