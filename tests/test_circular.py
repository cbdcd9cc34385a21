"""Cosines and sines of many phases at once agree with those of the standard library."""

import numpy as np
import pytest

from phasemark.render.integral.circular import turn


@pytest.mark.parametrize("largest_rad", [1.0, 10.0, 1e3, 1e6])
@pytest.mark.parametrize("order", [1, 3, 49])
def test_a_turned_amplitude_is_the_complex_exponential(largest_rad, order):
    quarters = np.arange(-8, 9) * (np.pi / 2)
    drawn = np.random.default_rng(11).uniform(-largest_rad, largest_rad, 1000)
    phase = np.concatenate([quarters, np.nextafter(quarters, 9), drawn]) / order
    amplitude, real, imaginary = np.full(len(phase), 3.0), np.empty(len(phase)), np.empty(len(phase))
    turn(len(phase), order, phase, amplitude, real, imaginary)
    expected = 3.0 * np.exp(1j * (order * phase))
    # two units in the last place of the amplitude
    np.testing.assert_allclose(real + 1j * imaginary, expected, rtol=0, atol=2 * np.spacing(3.0))


def test_entries_beyond_the_count_stay_as_they_are():
    real, imaginary = np.zeros(4), np.zeros(4)
    turn(2, 1, np.ones(4), np.ones(4), real, imaginary)
    assert real[2:].tolist() == imaginary[2:].tolist() == [0.0, 0.0]
