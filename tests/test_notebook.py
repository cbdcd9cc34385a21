"""What notebooks show: pictures are PNG, tables escape what files and users call things."""

import numpy as np
import pytest

from phasemark.data import BankPlan, FramePlan, build_bank, build_frames
from phasemark.data.pages.notebook import facts_html, table_html
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Match, Matches, kalman_filter
from phasemark.render import Frames, Renderer, capture, preset

PNG = b"\x89PNG\r\n\x1a\n"
SENSOR = preset("pmd-16x16")


@pytest.fixture(scope="module")
def image():
    return Renderer(build_mesh(catalog()["cylinder"]), SENSOR).render(1.0, 0.5)


def test_a_landmark_shows_itself():
    assert catalog()["cone"]._repr_png_().startswith(PNG)


def test_images_frames_and_filtered_frames_show_pictures(image):
    frames = capture(image, SENSOR, rng=np.random.default_rng(1), n_frames=3)
    filtered = kalman_filter(frames)
    for shown in (image, frames, filtered):
        assert shown._repr_png_().startswith(PNG)


def test_a_single_frame_of_unknown_noise_shows_a_picture():
    # its standard deviation is infinite, which no colour stands for
    assert kalman_filter(Frames(np.ones((1, 1, 16, 16)), sensor=SENSOR))._repr_png_().startswith(PNG)


def test_no_positions_show_nothing(image):
    filtered = kalman_filter(capture(image, SENSOR, rng=np.random.default_rng(1), n_frames=2))
    assert filtered[:0]._repr_png_() is None


def test_a_match_shows_its_view_with_standard_deviations():
    match = Match("cone", True, 1.25, np.radians(30), covariance=np.diag([1e-6, np.radians(0.5) ** 2]), p_value=0.5)
    for shown in (match._repr_html_(), Matches([match])._repr_html_()):
        assert "1.2500 ± 0.0010" in shown
        assert "30.00 ± 0.50" in shown


def test_no_landmark_is_said_so():
    assert "no landmark" in Match(None, False)._repr_html_()


def test_a_long_batch_is_cut():
    shown = Matches([Match("cone", True, 1.0, 0.0)] * 250)._repr_html_()
    assert shown.count("<tr>") == 1 + 100
    assert "250 matches" in shown


def test_what_things_are_called_is_escaped():
    evil = "<script>alert('&')</script>"
    for shown in (
        table_html([evil], [[evil]], caption=evil),
        facts_html(evil, {evil: evil}),
        Match(evil, True, 1.0, 0.0)._repr_html_(),
    ):
        assert "<script" not in shown
        assert "&lt;script&gt;" in shown


def test_banks_and_frame_sets_tell_what_they_hold_open_or_closed(tmp_path):
    bank = build_bank(BankPlan(classes=("cone",), distance_m="0.9:1.1:0.1", delta_deg="0:180:90"), tmp_path / "b<1>.h5")
    plan = FramePlan(classes=("cone",), views=3, frames_per_view=2, distance_m=1.0, delta_deg=0.0)
    frames = build_frames(plan, tmp_path / "f.h5")
    for _ in range(2):
        shown = bank._repr_html_()
        assert "b&lt;1&gt;.h5" in shown
        assert "0.9 … 1.1 m, 3 values" in shown
        assert "6: 2 of each of 3 views" in frames._repr_html_()
        bank.close()
        frames.close()
