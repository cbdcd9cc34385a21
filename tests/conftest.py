"""What every test may rely on."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

# Read when numpy is first imported. Threads of BLAS on matrices of three rows wait for each other and for the cores
# that the other test process uses; the command line sets the same.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

os.environ.setdefault("MPLBACKEND", "agg")

# Where code is compiled again, tests that compare all of standard error must not find a line about that.
os.environ["PHASEMARK_COMPILE_NOTES"] = "0"

# A shell starts background jobs with SIGINT ignored, and programs inherit that: interrupted ones would not notice.
signal.signal(signal.SIGINT, signal.default_int_handler)


_LONGEST = {
    f"test_{name}.py"
    for name in (
        "agreement", "bounces", "calibrate", "cells", "diagnosis", "direct_fit", "drive", "frequency_matching",
        "histogram_backgrounds", "histogram_matching", "lens_calibration", "locate", "recordings", "refine",
        "sweep_report", "tilted_matching",
    )
}  # fmt: skip
"""Files of tests that take longest. They go first: a worker that began one of them last would work alone.

So do files that compile what the next file calls too: the other worker would compile it at the same time.
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files that take longest before all others, each file's tests in their order."""
    items.sort(key=lambda item: item.path.name not in _LONGEST)


def pytest_configure(config: pytest.Config) -> None:
    """Compile once for all test processes: this runs in the one that starts them, too."""
    if not config.getoption("numprocesses", None) or config.option.collectonly:
        return
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    for pair in (("rendering", "rest"), ("matching", "histograms")):  # the second two use what the first compile
        commands = [[sys.executable, "-m", "programs.compile_kernels", part] for part in pair]
        running = [subprocess.Popen(command, env=environment) for command in commands]
        if any([process.wait() for process in running]):
            raise pytest.UsageError("compiling what the tests share failed")


@pytest.fixture
def one_example_of_each_method(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the report of a sweep draw one frame of each method and not four: a picture takes half a second."""
    monkeypatch.setattr("phasemark.matcher.sweep.report._MOST_EXAMPLES", 1)


class Outcome(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Run a command in this process; return its exit code, standard output and standard error."""
    from phasemark.cli import main  # not above: the environment is set before anything is imported

    def call(*arguments: object) -> Outcome:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        return Outcome(code, *capsys.readouterr())

    return call
