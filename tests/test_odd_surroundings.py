"""Closed streams, full devices, odd environment variables, no place to keep anything: the answer stays the answer."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from phasemark import UsageError
from phasemark.data import open_bank
from phasemark.inputs import verify_checksum
from phasemark.render.compile_cache import prepare_compile_cache

PHASEMARK = str(Path(sys.executable).with_name("phasemark"))
needs_full_device = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
ONE_IMAGE = ("bank", "build", "--class", "cone", "--distance", "1", "--delta", "0", "-o", "one.h5", "--full")


def shell(command: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["sh", "-c", f'exec "$0" "$@" {command}', PHASEMARK, *ONE_IMAGE],
        cwd=folder, env={**os.environ, **environment}, capture_output=True, text=True,
    )  # fmt: skip


@pytest.mark.parametrize(
    "closed", [">&- 2>&- <&-", *(pytest.param(one, marks=pytest.mark.soak) for one in (">&-", "2>&-", "<&-"))]
)
def test_a_closed_stream_changes_neither_the_files_nor_the_exit_code(closed: str, tmp_path: Path) -> None:
    done = shell(closed, tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert verify_checksum(tmp_path / "one.h5")
    open_bank(tmp_path / "one.h5").close()


@pytest.mark.parametrize(
    ("name", "code", "stderr"),
    [("nosuch", 2, "2>&-"), pytest.param("nosuch.toml", 3, "2>/dev/full", marks=needs_full_device)],
    ids=["closed", "full"],
)
def test_an_error_that_cannot_be_told_keeps_its_exit_code(name: str, code: int, stderr: str) -> None:
    done = subprocess.run(["sh", "-c", f'exec "$0" sensor show {name} {stderr}', PHASEMARK], capture_output=True)
    assert (done.returncode, done.stdout, done.stderr) == (code, b"", b"")


@needs_full_device
def test_a_note_that_cannot_be_told_does_not_end_the_work(tmp_path: Path) -> None:
    far = "--sensor vl53l5cx-8x8 --distance 5"  # beyond its range, which is noted
    done = shell(f"{far} 2>/dev/full", tmp_path)
    assert (done.returncode, done.stdout) == (0, "one.h5\n")


def test_a_backend_for_windows_is_not_asked_for(tmp_path: Path) -> None:
    command = [PHASEMARK, "render", "--class", "cone", "-o", "cone.png"]
    done = subprocess.run(command, cwd=tmp_path, env={**os.environ, "MPLBACKEND": "nosuch"}, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("threads", ["0", "-3", "9" * 400])
def test_a_number_of_threads_that_numba_cannot_have_is_refused(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    with pytest.raises(UsageError, match=r"NUMBA_NUM_THREADS must be at least 1, got '[-0-9]{1,20}'$"):
        prepare_compile_cache()


def test_a_command_tells_a_wrong_number_of_threads_in_one_line_and_makes_nothing(tmp_path: Path) -> None:
    done = shell("", tmp_path, NUMBA_NUM_THREADS="0")
    assert (done.returncode, done.stdout) == (2, "")
    assert "NUMBA_NUM_THREADS must be at least 1" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not any(tmp_path.iterdir())


NO_CACHE_FOLDER = """
import sys, warnings
from numba.core import caching
caching.CacheImpl._locator_classes = [caching.UserProvidedCacheLocator]  # as in a container
caching.CompileResultCacheImpl._locator_classes = caching.CacheImpl._locator_classes
with warnings.catch_warnings(record=True) as noted:
    warnings.simplefilter("always")
    from phasemark.matcher import Matcher
from phasemark.render import compile_cache
import pathlib
assert len([one for one in noted if "compiled code" in str(one.message)]) == 1
print([str(one.message) for one in noted if "compiled code" in str(one.message)][0])
"""


def imported_without_cache(temporary: Path, program: str = NO_CACHE_FOLDER) -> str:
    environment = {**os.environ, "TMPDIR": str(temporary)}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_compiled_code_without_a_folder_goes_to_the_temporary_one(tmp_path: Path) -> None:
    folder = tmp_path / f"phasemark-numba-{os.getuid()}"
    assert f"it is kept in {folder}" in imported_without_cache(tmp_path)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert f"it is kept in {folder}" in imported_without_cache(tmp_path)  # and is used again


def test_a_folder_that_others_can_write_to_is_not_trusted_with_compiled_code(tmp_path: Path) -> None:
    (tmp_path / f"phasemark-numba-{os.getuid()}").mkdir()
    (tmp_path / f"phasemark-numba-{os.getuid()}").chmod(0o777)
    program = NO_CACHE_FOLDER.replace("import sys", "import os, pathlib, sys", 1).replace(
        "with warnings",
        "exists = pathlib.Path.mkdir\n"
        "def nowhere_else(self, *a, **k):\n"
        "    if str(self).startswith('/dev/shm'): raise OSError\n"
        "    return exists(self, *a, **k)\n"
        "pathlib.Path.mkdir = nowhere_else\n"
        "with warnings",
        1,
    )
    assert "every start compiles again" in imported_without_cache(tmp_path, program)
