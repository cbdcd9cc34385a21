"""Golden frames of the four classes: unintended change shows here, correctness in test_reference_frames.py."""

import numpy as np
import pytest
from programs.regenerate_golden import CATALOGUE, render_catalogue

from phasemark.landmarks import catalog


@pytest.fixture(scope="module")
def images():
    return render_catalogue()


@pytest.mark.parametrize("name", list(catalog()))
def test_the_golden_frame_is_reproduced(images, name):
    phasor, coverage = images[name]
    with np.load(CATALOGUE) as golden:
        # libm and Embree differ between machines by less than 1e-5 of the brightest pixel
        brightest = np.abs(golden[f"{name}_phasor"]).max()
        assert np.abs(phasor - golden[f"{name}_phasor"]).max() < 1e-5 * brightest
        assert np.abs(coverage - golden[f"{name}_coverage"]).max() < 1e-5
