"""One sweep, whatever runs it: threads, a cluster, or several lives of a program that is killed."""

import pytest
from builders import run_program
from programs.sweep_random_kills import plan, tables

from phasemark.matcher.sweep.run import run_sweep

TRIALS = 60


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The tables of one worker; of more than one round, so that a round depends on the one before."""
    folder = tmp_path_factory.mktemp("ways")
    run_sweep(plan(TRIALS), folder, workers=1)
    assert (folder / "trials-001.h5").is_file()
    return tables(folder)


@pytest.fixture(scope="module")
def ways(tmp_path_factory):
    """A folder in which the program was run by two threads, killed twice, and what it printed."""
    folder = tmp_path_factory.mktemp("program")
    return folder, run_program("sweep_random_kills", folder, TRIALS, 2, 17)


def test_two_threads_and_a_sweep_that_is_killed_and_resumed_give_the_tables_of_one_worker(ways, reference):
    folder, counts = ways  # the program compares the killed ones with its first
    assert sum(map(int, counts.split())) == 2
    assert tables(folder / "warm") == reference


def test_a_dask_cluster_gives_the_tables_of_one_worker(ways, reference):
    pytest.importorskip("distributed")
    assert tables(ways[0] / "dask") == reference


@pytest.mark.soak
def test_a_sweep_killed_at_20_random_moments_and_resumed_gives_the_same_tables(tmp_path):
    counts = list(map(int, run_program("sweep_random_kills", tmp_path, 300, 20, 18).split()))
    assert sum(counts) == 20
    assert sum(count > 0 for count in counts) > 1, "the kills all came at one stage"
    print(f"killed before a trial was safe, in the first round, after it, at the end: {counts}")
