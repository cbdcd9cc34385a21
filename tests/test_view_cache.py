"""Images that frames share: never more than the stated bytes, and the same answers with and without.

Also the ranges of the tuning numbers of the search, one of which are these bytes.
"""

from dataclasses import fields, replace

import numpy as np
import pytest

from phasemark import UsageError
from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, SearchPolicy, kalman_filter
from phasemark.matcher.likelihood.rendered_images import RenderedModel
from phasemark.matcher.likelihood.view_cache import ViewCache
from phasemark.render import Background, Renderer, capture, preset

SENSOR = preset("pmd-16x16")
WALL = Background(wall_m=4.0)
BEARING = ("distance_m", "delta_rad", "bearing_rad")


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    plan = BankPlan(distance_m="0.9:1.1:0.02", delta_deg="0:180:3")
    with build_bank(plan, tmp_path_factory.mktemp("bank") / "bank.h5") as opened:
        yield opened


def test_a_cache_drops_what_was_used_longest_ago_and_keeps_to_its_bytes():
    cache = ViewCache(100)
    for key in range(3):
        cache.put(key, (np.zeros(4),))
    cache.get(0)
    cache.put(3, (np.zeros(4),))
    assert [cache.get(key) is not None for key in range(4)] == [True, False, True, True]
    cache.put("large", (np.zeros(13),))
    assert cache.get("large") is None
    assert cache.n_bytes == 96
    cache.put(0, (np.zeros(1), np.zeros(1)))
    assert cache.n_bytes == 80


def test_a_model_renders_a_view_once_and_keeps_to_its_bytes(bank, monkeypatch):
    model = RenderedModel(bank, WALL, cache_bytes=100_000)
    rendered = []
    images = RenderedModel.images

    def counted(self, class_index, view, free):
        rendered.append(len(view))
        return images(self, class_index, view, free)

    monkeypatch.setattr(RenderedModel, "images", counted)
    view = np.zeros((12, 6))
    view[:, 0] = np.tile(np.linspace(0.95, 1.05, 6), 2)  # every view twice
    c = np.zeros(12, np.int64)
    first = model.first_images(c, view, BEARING)
    again = model.first_images(c[:3], view[3:6], BEARING)  # a view with three slopes takes 20 kB: four fit
    assert rendered == [6, 0]
    whole = images(model, c, view, BEARING)
    for name in ("phasor", "slope", "intensity", "coverage"):
        np.testing.assert_array_equal(getattr(first, name), getattr(whole, name))
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name)[3:6])
    assert 0 < model.cache.n_bytes <= 100_000
    other = model.with_background(Background(wall_m=3.0)).first_images(c[:1], view[:1], BEARING)
    assert not np.array_equal(other.phasor, whole.phasor[:1])


def test_answers_do_not_depend_on_the_cache_nor_on_threads(bank):
    image = Renderer(build_mesh(catalog()["cone"]), SENSOR, albedo=0.8).render(np.full(6, 1.013), 0.7, background=WALL)
    frames = kalman_filter(capture(image, SENSOR, rng=np.random.default_rng(1), n_frames=50))
    answers = [
        Matcher(
            bank,
            "refine",
            free=BEARING,
            background=WALL,
            workers=workers,
            policy=replace(SearchPolicy(), cache_bytes=cache_bytes),
        ).match(frames)
        for workers, cache_bytes in ((1, 0), (1, 1 << 20), (3, 50_000))
    ]
    for other in answers[1:]:
        for name in ("distance_m", "delta_rad", "bearing_rad", "chi2", "accepted"):
            np.testing.assert_array_equal(getattr(other, name), getattr(answers[0], name))


@pytest.mark.parametrize("field", [field.name for field in fields(SearchPolicy)])
def test_a_value_of_the_search_policy_out_of_range_names_its_field(field):
    for bad in (-1, float("nan"), "2", None, True, (float("inf"),)):
        with pytest.raises(UsageError, match=f"'policy': '{field}' must be "):
            replace(SearchPolicy(), **{field: bad})  # type: ignore[arg-type]


def test_an_image_does_not_depend_on_what_is_rendered_beside_it_when_a_floor_gives_way(bank):
    """The landmark ends 0.15 m or more below the lens; at some heights it would reach below the floor."""
    model = RenderedModel(bank, Background(wall_m=4.0, floor_m=0.2))
    view = np.array([[1.0, 0.3, 0.0, 0.0], [1.0, 0.3, 0.0, -0.1], [1.02, 0.4, 0.01, -0.06], [1.0, 0.3, 0.0, 0.05]])
    c = np.full(4, bank.classes.index("post"))
    together = model.images(c, view, BEARING)
    for k in range(4):
        alone = model.images(c[k : k + 1], view[k : k + 1], BEARING)
        for name in ("phasor", "slope", "coverage"):
            np.testing.assert_array_equal(getattr(together, name)[k], getattr(alone, name)[0])


def test_a_stated_floor_above_the_landmarks_foot_is_refused(bank):
    with pytest.raises(UsageError, match=r"the floor 0\.05 m below the lens is above the landmark's lowest point"):
        Matcher(bank, "refine", free=BEARING, background=Background(floor_m=0.05))
