"""Build what a release would ship from a clean clone, and check that it is all there, that nothing else is, and runs.

The wheel must hold exactly the tracked files of the packages; the one built from the sdist must equal the one built
from the tree; installed in a fresh environment with its declared dependencies alone, every module must import, or name
the extra that it needs, and the command line answer.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ROOT_FILES = {"__init__.py", "__main__.py", "cli.py", "py.typed"}
ROOMS = {"data", "inputs", "landmarks", "matcher", "render"}

IMPORT_ALL = """
import importlib, pkgutil, sys
import phasemark
names = ["phasemark"] + [found.name for found in pkgutil.walk_packages(phasemark.__path__, "phasemark.")]
for name in names:
    try:
        module = importlib.import_module(name)
    except phasemark.UsageError as missing:
        if "pip install -e '.[" not in str(missing):
            raise
        print(name, "needs an extra:", missing)
        continue
    if not module.__file__.startswith(sys.prefix):
        sys.exit(f"{name} came from {module.__file__}, not from the wheel")
print(f"{len(names)} modules import")
"""


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command, and end with all its output if it fails."""
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        command, cwd=cwd, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    output = done.stdout.decode(errors="replace")
    if done.returncode:
        sys.exit(f"{output}\n{' '.join(map(str, command))}: exit code {done.returncode}")
    return output


def tracked_files(source: Path) -> set[str]:
    """Return what the clone tracks, relative to its root."""
    return set(run("git", "ls-files", cwd=source).splitlines())


def expected_in_wheel(tracked: Iterable[str]) -> set[str]:
    """Return the tracked files of the packages under the names they have in the wheel."""
    return {f"phasemark/{name}" for name in tracked if name in ROOT_FILES or name.split("/")[0] in ROOMS}


def contents(wheel: Path) -> dict[str, bytes]:
    """Return the files of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def compare(what: str, found: set[str], expected: set[str]) -> None:
    """End with the differences if two sets of names differ."""
    lines = [f"missing: {name}" for name in sorted(expected - found)]
    lines += [f"stray:   {name}" for name in sorted(found - expected)]
    if lines:
        sys.exit("\n".join([f"{what} is not what the repository tracks", *lines]))


def main() -> None:
    """Run all checks in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        source = work / "source"
        run("git", "clone", "--quiet", ROOT, source, cwd=work)
        tracked = tracked_files(source)

        run(sys.executable, "-m", "build", "--outdir", work / "dist", cwd=source)
        run(sys.executable, "-m", "build", "--wheel", "--outdir", work / "direct", cwd=source)
        (sdist,) = (work / "dist").glob("*.tar.gz")
        (wheel,) = (work / "dist").glob("*.whl")
        files = contents(wheel)
        if files != contents(work / "direct" / wheel.name):
            sys.exit("the wheel built from the sdist differs from the one built from the tree")

        metadata = {name for name in files if ".dist-info/" in name}
        compare("the wheel", set(files) - metadata, expected_in_wheel(tracked))
        if not any(name.endswith("licenses/LICENSE") for name in metadata):
            sys.exit("the wheel has no licence")
        with tarfile.open(sdist) as archive:
            shipped = {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}
        generated = {name for name in shipped if name.split("/")[0] in ("PKG-INFO", "setup.cfg", "phasemark.egg-info")}
        compare("the sdist", shipped - generated, {name for name in tracked if not name.startswith(".")})
        print(f"{wheel.name}: {len(files)} files, {wheel.stat().st_size / 1024:.0f} KiB")

        run(sys.executable, "-m", "venv", work / "venv", cwd=work)
        python = work / "venv" / "bin" / "python"
        run(python, "-m", "pip", "--disable-pip-version-check", "install", wheel, cwd=work)
        print(run(python, "-I", "-W", "error", "-c", IMPORT_ALL, cwd=work), end="")
        run(work / "venv" / "bin" / "phasemark", "--help", cwd=work)
        run(work / "venv" / "bin" / "phasemark", "sensor", "list", cwd=work)
        run(python, "-I", "-m", "phasemark", "sensor", "list", cwd=work)


if __name__ == "__main__":
    main()
