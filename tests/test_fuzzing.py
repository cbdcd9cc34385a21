"""Every reader on damaged and hostile files: an answer or one line, in time and in memory (fuzzing.py)."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from programs import fuzzing

SOAK = {
    "npy": 20_000, "npz": 12_000, "png": 12_000, "csv": 15_000, "board": 12_000, "poses": 12_000, "manifest": 2_000,
    "bank-plan": 1_500, "frames-plan": 1_500, "scenes-plan": 1_500, "sweep-plan": 1_500,
    "drive-plan": 1_500, "design-plan": 1_500,
    "sensor": 3_000, "camera-info": 3_000, "map": 3_000,
    "checksum": 2_000, "stl": 6_000, "ply": 6_000, "obj": 6_000, "off": 6_000, "bag": 1_000, "h5": 300, "bank": 300,
    "frames": 300, "scenes": 300,
}  # fmt: skip
"""Inputs of each kind: 131 200 in all. Kinds of HDF5 are read by a child process first, a fraction of a second each."""
TOML = [kind for kind, (suffix, *_) in fuzzing.KINDS.items() if suffix == ".toml"]
SEED = 20261


SLOW = [kind for kind in TOML if kind.endswith("-plan")]
"""Kinds whose readers build meshes and draw views, up to a second each."""
SHORT = dict.fromkeys(["npy", "npz", "png", "csv", "board", *TOML, "stl", "ply", "obj", "off"], 200)
SHORT |= {**dict.fromkeys(SLOW, 12), "frames-plan": 6, "sweep-plan": 4}


def run(kinds, count, folder):
    """Run the program; return what it found by kind, and what it said of readers that crashed."""
    command = [sys.executable, fuzzing.__file__, ",".join(kinds), str(count), str(SEED), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    return {found["kind"]: found for found in lines}, done.stderr[-2000:]


def check(kind, count, folder, ran):
    by_kind, said = ran
    assert kind in by_kind, said
    found = by_kind[kind]
    print(found)
    assert found["inputs"] == count
    assert not found["found"], f"{found['n_found']} findings, kept in {folder}: {found['found']}"
    assert found["longest_s"] < fuzzing.MOST_SECONDS
    assert found["peak_bytes"] < fuzzing.MOST_BYTES
    assert found["refused"] < count  # some are sound still


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """The folder of a run of all kinds and of one that is none, and what it found."""
    folder = tmp_path_factory.mktemp("mutants")
    return folder, run([*(f"{kind}:{count}" for kind, count in SHORT.items()), "unknown"], 1, folder)


@pytest.mark.parametrize("kind", SHORT)
def test_some_mutants_of_each_kind_end_with_an_answer_or_one_line(kind, short):
    check(kind, SHORT[kind], *short)


def test_a_reader_that_crashes_is_told(short):
    _, (found, said) = short
    assert "unknown" not in found
    assert "the reader of unknown ended with" in said


@pytest.mark.soak
@pytest.mark.parametrize("kind", fuzzing.KINDS)
def test_a_hundred_thousand_mutants_end_with_an_answer_or_one_line(kind, tmp_path):
    if kind == "bag":
        pytest.importorskip("rosbags")
    check(kind, SOAK[kind], tmp_path, run([kind], SOAK[kind], tmp_path))


def test_the_soak_reads_a_hundred_thousand_inputs():
    assert set(SOAK) == set(fuzzing.KINDS)
    assert sum(SOAK.values()) >= 100_000


@pytest.mark.parametrize("path", sorted(fuzzing.CORPUS.glob("*/*")), ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_was_found_once_stays_mended(path, tmp_path):
    fuzzing.read_one(path.parent.name, path.read_bytes(), tmp_path)


def test_the_readers_whose_lines_are_followed_exist():
    root = Path(__file__).resolve().parent.parent
    assert [part for part in fuzzing.OWN_READERS if not (root / part.strip("/")).exists()] == []


def test_the_corpus_is_small():
    assert all(path.stat().st_size <= 1 << 16 for path in fuzzing.CORPUS.glob("*/*"))


def test_a_reader_that_stumbles_is_found(tmp_path, monkeypatch):
    def stumble(path):
        raise ZeroDivisionError("stumbled")

    monkeypatch.setitem(fuzzing.KINDS, "npy", (".npy", stumble, fuzzing.KINDS["npy"][2]))
    found = fuzzing.fuzz("npy", 3, 0, tmp_path)
    assert found["n_found"] == 3
    assert len(list(Path(tmp_path).iterdir())) == 3
