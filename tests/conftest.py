"""What every test may rely on."""

import os
import signal

import pytest

# Read when numpy is first imported. Threads of BLAS on matrices of three rows wait for each other and for the cores
# that the other test process uses; the command line sets the same.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

os.environ.setdefault("MPLBACKEND", "agg")

# A shell starts background jobs with SIGINT ignored, and programs inherit that: interrupted ones would not notice.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def one_example_of_each_method(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the report of a sweep draw one frame of each method and not four: a picture takes half a second."""
    monkeypatch.setattr("phasemark.matcher.sweep.report._MOST_EXAMPLES", 1)
