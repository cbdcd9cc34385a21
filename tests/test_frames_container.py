import numpy as np
import pytest

from phasemark import UsageError
from phasemark.render import Flag, Frames, preset
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
