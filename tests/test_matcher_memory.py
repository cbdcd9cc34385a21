"""What a matcher holds of a bank: the images once, and nothing that depends on how many are read together."""

import tracemalloc

import numpy as np
import pytest

from phasemark.data import BankPlan, build_bank, open_bank
from phasemark.data.bank import bank_file
from phasemark.matcher import Matcher, kalman_filter
from phasemark.render import Background, Renderer, capture

VIEW = ("distance_m", "delta_rad")
WALL = Background(wall_m=4.0)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    plan = BankPlan(
        classes=("cone",), distance_m="0.9:1.2:0.01", delta_deg="0:178:2", binning=2, layout="full",
        sensor_overrides={"rows": 40, "cols": 48, "half_angle_h_deg": 24, "half_angle_v_deg": 20},
    )  # fmt: skip
    out = tmp_path_factory.mktemp("bank") / "bank.h5"
    build_bank(plan, out).close()
    return out


def small_parts(monkeypatch, n_bytes):
    monkeypatch.setattr(bank_file, "_PART_BYTES", n_bytes)


@pytest.mark.parametrize(
    ("options", "share"),
    [
        # cells of twice the grid's step in D, 9 bytes a pixel, and some parts: 0.6 of the images; intervals in float64
        pytest.param({"method": "refine", "free": VIEW}, 1.7, marks=pytest.mark.soak),
        ({"method": "refine"}, 2.2),
        pytest.param({"method": "refine", "free": (*VIEW, "bearing_rad")}, 2.2, marks=pytest.mark.soak),
        # ranges in float64 while their mean is not known, then in float32, and what may and must return
        ({"method": "nearest"}, 1.2),
    ],
    ids=["refine", "prior", "bearing", "nearest"],
)
def test_a_matcher_holds_the_images_of_a_bank_once(path, options, share, monkeypatch):
    small_parts(monkeypatch, 1 << 18)
    with open_bank(path) as bank:
        images = np.prod(bank.full.n_views) * bank.sensor.rows * bank.sensor.cols * 16
        assert images > 20 * (1 << 20)  # large beside a part
        Matcher(bank, **options)  # compiles
        tracemalloc.start()
        try:
            Matcher(bank, **options)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    assert peak < share * images


@pytest.mark.parametrize("options", [{}, {"background": WALL}], ids=["alone", "wall"])
def test_templates_do_not_depend_on_how_many_images_are_read_together(path, options, monkeypatch):
    with open_bank(path) as bank:
        together = Matcher(bank, **options)._method.pose  # type: ignore[union-attr]
        small_parts(monkeypatch, 1 << 16)
        apart = Matcher(bank, **options)._method.pose  # type: ignore[union-attr]
    for name in ("range_m", "may_return", "must_return", "mean_m"):
        np.testing.assert_array_equal(getattr(apart, name), getattr(together, name))


@pytest.mark.parametrize(
    "background",
    [pytest.param(None, marks=pytest.mark.soak), WALL, pytest.param("auto", marks=pytest.mark.soak)],
    ids=["alone", "wall", "auto"],
)
def test_answers_do_not_depend_on_how_many_images_are_read_together(path, background, monkeypatch):
    with open_bank(path) as bank:
        renderer = Renderer(bank.mesh("cone"), bank.camera, albedo=0.8)
        image = renderer.render([1.013, 1.1], [0.7, 2.1], background=WALL if background else None)
        frames = kalman_filter(capture(image, bank.camera, rng=np.random.default_rng(5), n_frames=20))
        together = Matcher(bank, "refine", background=background).match(frames)
        small_parts(monkeypatch, 1 << 16)
        matcher = Matcher(bank, "refine", background=background)
        apart = matcher.match(frames)
    closed = matcher.match(frames)  # everything was read but images before a wall that is found, which save time
    assert [one.as_dict() for one in apart] == [one.as_dict() for one in together]
    assert apart.accepted.all()
    assert closed.accepted.all()
    np.testing.assert_allclose(closed.distance_m, apart.distance_m, atol=1e-5)
    if background != "auto":
        assert [one.as_dict() for one in closed] == [one.as_dict() for one in together]
