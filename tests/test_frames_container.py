import numpy as np
import pytest

from phasemark import UsageError
from phasemark.render import Flag, Frames, Views, preset
from phasemark.render.direct import HistogramFrames
from phasemark.render.phasor_images import wrap_difference_m, wrap_range_m

SENSOR = preset("ideal").with_(rows=1, cols=2)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_a_valid_range_needs_a_sound_amplitude(bad):
    with pytest.raises(UsageError, match=r"'amplitude_e' must be finite and not negative .* frame 0, row 0, col 1"):
        Frames([[1.0, 2.0]], [[5.0, bad]], sensor=SENSOR)


def test_an_invalid_range_may_lack_its_amplitude():
    frames = Frames([[1.0, np.nan]], [[5.0, np.nan]], sensor=SENSOR)
    np.testing.assert_array_equal(frames.flags[0, 0], [[0, int(Flag.MISSING)]])


def test_wrapped_ranges_and_differences_stay_in_their_intervals():
    period = SENSOR.unambiguous_range_m
    values = np.array([-1e-20, 0.0, period, 1.5 * period, -0.25])
    wrapped = wrap_range_m(values, SENSOR)
    assert ((wrapped >= 0) & (wrapped < period)).all()
    np.testing.assert_allclose(wrapped, [0, 0, 0, period / 2, period - 0.25], rtol=0, atol=1e-12)  # rounding
    np.testing.assert_allclose(wrap_difference_m([14.9, -14.9, 0.1], SENSOR), [14.9 - period, period - 14.9, 0.1])
    assert wrap_difference_m(period / 2, SENSOR) == -period / 2


def test_a_range_without_amplitude_is_no_return():
    amplitude = np.full((1, 1, 16, 16), 100.0)
    amplitude[0, 0, 3, 4] = 0.0
    frames = Frames(np.ones((1, 1, 16, 16)), amplitude, sensor=preset("pmd-16x16"))
    assert frames.flags[0, 0, 3, 4] == Flag.NO_RETURN
    assert np.isnan(frames.range_m[0, 0, 3, 4])
    assert frames.valid.sum() == 255


def test_a_masked_pixel_is_invalid():
    masked = np.ma.array([[1.0, 2.0]], mask=[[False, True]])
    for frames in (
        Frames(masked, sensor=SENSOR),
        Frames([[1.0, 2.0]], np.ma.array([[5.0, np.nan]], mask=masked.mask), sensor=SENSOR),
        Frames([[1.0, 2.0]], valid=np.ma.array([[True, True]], mask=masked.mask), sensor=SENSOR),
    ):
        np.testing.assert_array_equal(frames.flags[0, 0], [[0, int(Flag.MISSING)]])
        np.testing.assert_array_equal(frames.range_m[0, 0], [[1.0, np.nan]])
    np.testing.assert_array_equal(masked.data, [[1.0, 2.0]])  # the frames are a copy


def test_a_negative_range_is_no_reading():
    frames = Frames([[1.0, -1.0]], sensor=SENSOR)
    np.testing.assert_array_equal(frames.flags[0, 0], [[0, int(Flag.MISSING)]])
    assert np.isnan(frames.range_m[0, 0, 0, 1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"range_m": [[1 + 1j, 2]]}, "'range_m' must be real numbers, got complex ones"),
        ({"range_m": [[1.0, 2.0]], "amplitude_e": [[1j, 2]]}, "'amplitude_e' must be real numbers, got complex ones"),
        ({"range_m": [[1.0, 2.0]], "flags": [[0, -1]]}, "'flags' must be sums of Flag, .* from 0 to 127, got -1"),
        ({"range_m": [[1.0, 2.0]], "flags": [[0, 1.5]]}, "'flags' must be sums of Flag, .* got 1.5"),
        (
            {"range_m": [[1.0, 2.0]], "flags": np.array([[0, 128]], np.uint8)},
            "'flags' must be sums of Flag, .* got 128",
        ),
        ({"range_m": [[[1.0, 2.0]]], "time_s": np.ma.array([1.0], mask=True)}, "'time_s' must not have masked values"),
    ],
)
def test_numbers_that_would_lose_a_part_are_refused(arguments, message):
    with pytest.raises(UsageError, match=message):
        Frames(**arguments, sensor=SENSOR)


def test_counts_and_views_lose_no_part_either():
    zones = preset("vl53l5cx-4x4")
    counts = np.ones((4, 4, 128))
    with pytest.raises(UsageError, match="'counts' must be real numbers, got complex ones"):
        HistogramFrames(counts + 1j, sensor=zones)
    with pytest.raises(UsageError, match="'counts' must not have masked values"):
        HistogramFrames(np.ma.array(counts, mask=counts > 0), sensor=zones)
    with pytest.raises(UsageError, match="'delta_rad' must be real numbers, got complex ones"):
        Views.broadcast(1.0, 0.5j)
