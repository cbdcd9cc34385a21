"""Install the oldest versions of dependencies that pyproject.toml allows, and run fast tests against them.

The environment is made from scratch. A package without a version, or without a wheel for this Python, is named.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FAST = (
    "tests/test_conventions.py",
    "tests/test_landmarks.py",
    "tests/test_capture.py",
    "tests/test_matcher.py",
    "tests/test_bank_plans.py",
    "tests/test_statistics.py",
)
IMPORT_ALL = """
import importlib, pkgutil
import phasemark
names = [found.name for found in pkgutil.walk_packages(phasemark.__path__, "phasemark.")]
names = [name for name in names if not name.startswith("phasemark.render.simulators.")]  # they need an extra
print(len([importlib.import_module(name) for name in names]), "modules import")
"""


def oldest(requirements: list[str]) -> list[str]:
    """Return requirements with their lower bounds as the version that is asked for."""
    return [re.sub(r">=([\w.]+)", r"==\1", requirement) for requirement in requirements]


def main() -> int:
    """Make the environment and run the tests; the exit code is that of pytest."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("venv", type=Path, help="folder of the environment")
    parser.add_argument("tests", nargs="*", help="tests to run instead of a fast subset")
    arguments = parser.parse_args()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    python = arguments.venv.absolute() / "bin" / "python"
    pip = (python, "-m", "pip", "--disable-pip-version-check", "--quiet")
    shutil.rmtree(arguments.venv, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "venv", arguments.venv], check=True)
    subprocess.run([*pip, "install", *oldest(project["dependencies"]), "pytest", "hypothesis"], check=True)
    subprocess.run([*pip, "install", "--no-deps", "--editable", ROOT], check=True)
    shown = subprocess.run([python, "-m", "pip", "--disable-pip-version-check", "list"], capture_output=True, text=True)
    print(shown.stdout)
    # with one cache for both, the next run of the other numba would have to compile everything again
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(arguments.venv.absolute() / "numba")}
    subprocess.run([python, "-c", IMPORT_ALL], check=True, env=environment)
    # what is deprecated in an old version is not ours to mend: only errors count here
    command = [python, "-m", "pytest", "-q", "-W", "default", *(arguments.tests or FAST)]
    return subprocess.run(command, cwd=ROOT, env=environment).returncode


if __name__ == "__main__":
    sys.exit(main())
