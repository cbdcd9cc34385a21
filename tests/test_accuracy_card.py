"""Accuracy at a glance: the card against the bound, its parts, the class error, the command."""

import json
import math

import numpy as np
import pytest

from phasemark import UsageError
from phasemark.cli import main
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import cramer_rao
from phasemark.matcher.accuracy import accuracy_card
from phasemark.matcher.accuracy.appearance import class_distances_squared
from phasemark.matcher.accuracy.expected_accuracy import CALIBRATION, DECLARED, EDGES, FACES
from phasemark.matcher.pixel_agreement import counts
from phasemark.render import Background, Renderer, Views, predicted_range_std, preset

FREE = ("distance_m", "delta_rad", "bearing_rad")
VIEWS = Views.broadcast(1.5, [0.3, 0.9, 1.4])


@pytest.fixture(scope="module")
def renderers():
    sensor = preset("pmd-16x16")
    return {name: Renderer(build_mesh(spec), sensor, albedo=spec.albedo) for name, spec in catalog().items()}


@pytest.mark.parametrize("background", [None, Background(wall_m=3.0)])
def test_the_parts_add_up_to_the_bound(renderers, background):
    card = accuracy_card(renderers["cylinder"], VIEWS, background=background)
    bound = cramer_rao(renderers["cylinder"], VIEWS, free=FREE, background=background)
    np.testing.assert_allclose(card.covariance, bound.covariance, rtol=1e-9)
    assert sum(card.shares().values()) == pytest.approx(1)
    along, across = bound.std("distance_m"), bound.std("delta_rad")
    np.testing.assert_allclose(card.position_std_m, np.hypot(along, 1.5 * across), rtol=1e-9)


def test_edges_and_faces_are_the_noise_of_their_pixels(renderers):
    """P I P with the information of the other pixels, which the card does not compute."""
    card = accuracy_card(renderers["cone"], VIEWS)
    bound = cramer_rao(renderers["cone"], VIEWS, free=FREE)
    whole = renderers["cone"].render_views(VIEWS).coverage >= 1 - 1e-6
    faces = cramer_rao(renderers["cone"], VIEWS, free=FREE, pixels=bound.pixels & whole).information
    np.testing.assert_allclose(card.parts[FACES], bound.covariance @ faces @ bound.covariance, rtol=1e-6, atol=1e-15)
    assert (np.einsum("npp->np", card.parts[EDGES]) > 0).all()


def test_what_the_sensor_declares_dominates_once_it_is_large(renderers):
    sensor = renderers["cylinder"].sensor.with_(systematic_distance_m=0.5)
    card = accuracy_card(renderers["cylinder"].seen_by(sensor), VIEWS)
    assert card.dominant == DECLARED
    np.testing.assert_allclose(card.parts[DECLARED][:, 0, 0], 0.25)
    assert card.std("distance_m") == pytest.approx(0.5, rel=1e-4)


def test_what_a_calibration_leaves_is_a_part_of_its_own(renderers):
    sensor = renderers["cylinder"].sensor.with_(
        calibration_fields=("range_offset_m",), calibration_covariance=((0.01**2,),)
    )
    card = accuracy_card(renderers["cylinder"].seen_by(sensor), VIEWS)
    bound = cramer_rao(renderers["cylinder"].seen_by(sensor), VIEWS, free=FREE, systematic=("calibration",))
    np.testing.assert_allclose(card.parts[CALIBRATION], bound.systematic)
    assert card.std("distance_m") == pytest.approx(0.01, rel=0.05)  # an offset of all ranges is one of D


def test_a_class_is_as_likely_as_its_twin(renderers):
    """d² is 0 of the very same landmark, and a fair coin decides."""
    card = accuracy_card(renderers["cone"], VIEWS, others={"twin": renderers["cone"]})
    np.testing.assert_allclose(card.class_error, 0.5, atol=1e-3)  # three Gauss–Newton steps leave a d of some 1e-3


def test_class_distances_are_the_least_of_a_fine_grid(renderers):
    """Against a search of its own: residuals of ranges on a grid of 1 mm and 1° about the truth."""
    true, other = renderers["cylinder"], renderers["cone"]
    view = Views.broadcast(2.0, 0.4)
    image = true.render_views(view)
    weight = 50 / predicted_range_std(np.abs(image.phasor), image.intensity, true.sensor) ** 2
    use = counts(image.phasor, image.intensity, true.sensor)[0]
    shift, turn = np.meshgrid(np.arange(-0.02, 0.021, 0.001), np.radians(np.arange(-10, 11)))
    images = other.render_views(Views.broadcast(2.0 + shift.ravel(), 0.4 + turn.ravel()))
    may, must = images.coverage >= 0.005, images.coverage > 0.3
    residual = np.where(use & may, image.range_m - images.range_m, 0.0)
    cost = (np.where(use, weight, 0) * residual**2).sum(axis=(1, 2)) + 25.0 * ((use & ~may) | (~use & must)).sum(
        axis=(1, 2)
    )
    own = 25.0 * (~use & (image.coverage > 0.3)).sum()
    found = class_distances_squared(true, view, {"cone": other})[0, 0]
    assert found == pytest.approx(cost.min() - own, rel=0.02)  # the grid's steps


def test_a_tilted_landmark_looks_like_itself_and_like_others_at_the_same_tilt(renderers):
    true, other = renderers["cylinder"], renderers["sphere"]
    level, tilted = Views.broadcast(2.0, [0.3, 1.0]), Views.broadcast(2.0, [0.3, 1.0], 0.0, 0.0, math.radians(2.0))
    assert class_distances_squared(true, tilted, {"same": true}).max() < 1e-6
    mounted = [one.seen_by(one.sensor.with_(pitch_deg=2.0)) for one in (true, other)]
    expected = class_distances_squared(mounted[0], level, {"other": mounted[1]})
    np.testing.assert_allclose(class_distances_squared(true, tilted, {"other": other}), expected, rtol=1e-6)


def test_a_landmark_out_of_reach_is_said_to_be_not_observed(renderers):
    card = accuracy_card(renderers["post"], Views.broadcast(14.0, 0.3))
    assert "not observed" in card.line()
    assert card.as_dict()["position_std_m"] is None
    assert card.as_dict()["dominant"] is None


@pytest.mark.parametrize(("wrong", "words"), [({"n_frames": 0}, "n_frames"), ({"free": ("delta_rad",)}, "distance_m")])
def test_wrong_arguments_are_refused(renderers, wrong, words):
    with pytest.raises(UsageError, match=words):
        accuracy_card(renderers["post"], VIEWS, **wrong)


def test_the_command_prints_one_line(capsys):
    assert main(["accuracy", "--class", "cylinder", "--distance", "1.5", "--delta", "20", "--wall", "3"]) == 0
    line = capsys.readouterr().out
    assert line.count("\n") == 1
    for part in ("cylinder at 1.5 m, δ 20°, 50 frames", " mm,", "1 σ", "class error", "noise of edge pixels dominates"):
        assert part in line
    assert (
        main(["accuracy", "--class", "cylinder", "--distance", "0.7", "--sensor", "vl53l5cx-8x8", "--wall", "1"]) == 0
    )
    assert "means over their zones" in capsys.readouterr().err


def test_the_command_prints_json(capsys, tmp_path):
    sensor = tmp_path / "camera.toml"
    sensor.write_text("rows = 16\ncols = 16\nhalf_angle_h_deg = 11.3\nhalf_angle_v_deg = 11.3\n")
    build_mesh(catalog()["post"]).export(tmp_path / "part.stl")
    mesh = ["--mesh", f"part={tmp_path / 'part.stl'}", "--unit", "m"]
    assert main(["accuracy", *mesh, "--distance", "1.2", "--sensor", str(sensor), "--frames", "7", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["landmark"] == "part"
    assert found["n_frames"] == 7
    assert found["views"] == 12
    assert found["delta_deg"] == [0.0, pytest.approx(330)]  # a mesh is seen from all around
    assert found["other_classes"] == list(catalog())
    assert 0 < found["position_std_m"] <= found["worst_position_std_m"]
    assert found["class_error"] == pytest.approx(0.5, abs=1e-3)  # the part is the catalogue's post


def test_the_command_refuses_what_cannot_be(capsys):
    assert main(["accuracy", "--distance", "1.5"]) == 2
    assert "--class NAME or --mesh NAME=FILE" in capsys.readouterr().err
    cylinder = ["accuracy", "--class", "cylinder", "--distance"]
    assert main([*cylinder, "-1"]) == 2
    assert main([*cylinder, "1", "--frames", "0"]) == 2
    capsys.readouterr()
    assert main([*cylinder, "1", "--sensor", "ideal"]) == 2
    assert capsys.readouterr().err.startswith("error: the sensor has no noise, so that there is no bound: set its")


@pytest.mark.parametrize(("sensor", "known"), [("pmd-16x16", True), ("ideal", False)])
def test_the_page_of_a_sensor_carries_the_card(tmp_path, sensor, known):
    assert main(["sensor", "characterise", sensor, "--frames", "2", "-o", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert ("The bound of a match with this camera: cylinder at 1 m, δ 0 … 165°, 50 frames: D 0." in page) is known
