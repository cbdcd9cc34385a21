"""The layout holds: one copy of every module, one direction of imports, public names that are documented."""

import ast
import contextlib
import dataclasses
import doctest
import enum
import importlib
import inspect
import io
import os
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import FunctionType

import pytest

import phasemark

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("inputs", "data", "landmarks", "matcher", "render")
BIN = Path(sys.executable).parent
MODULES = ["phasemark", *(found.name for found in pkgutil.walk_packages(phasemark.__path__, "phasemark."))]
PACKAGES = ["phasemark", *(f"phasemark.{room}" for room in ROOMS)]


def _public_objects() -> list[tuple[str, object]]:
    modules = [importlib.import_module(name) for name in PACKAGES]
    return [
        (f"{module.__name__}.{name}", getattr(module, name))
        for module in modules
        for name in getattr(module, "__all__", [])
    ]


PUBLIC = dict(_public_objects())
FUNCTIONS = {name: thing for name, thing in PUBLIC.items() if isinstance(thing, FunctionType)}
CLASSES = {name: thing for name, thing in PUBLIC.items() if isinstance(thing, type)}


def test_the_root_holds_three_modules() -> None:
    # Any other would be shipped in the wheel.
    assert sorted(path.name for path in ROOT.glob("*.py")) == ["__init__.py", "__main__.py", "cli.py"]


def test_the_tests_are_no_package() -> None:
    assert not (ROOT / "tests" / "__init__.py").exists()


def test_every_package_is_named_in_the_project_file() -> None:
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    folders = [path.parent for room in ROOMS for path in (ROOT / room).rglob("__init__.py")]
    found = {".".join(("phasemark", *folder.relative_to(ROOT).parts)) for folder in folders}
    assert set(setuptools["packages"]) == {"phasemark", *found}


def test_every_folder_of_modules_is_a_package() -> None:
    folders = {path.parent for room in ROOMS for path in (ROOT / room).rglob("*.py")}
    assert [folder for folder in folders if not (folder / "__init__.py").exists()] == []


def test_every_module_is_imported_once_and_says_what_lives_there() -> None:
    # A bare ``import render`` would load files of the package under a second name.
    imported = [importlib.import_module(name) for name in MODULES]
    own = [path for room in ROOMS for path in (ROOT / room).rglob("*.py")]
    own += [ROOT / name for name in ("__init__.py", "__main__.py", "cli.py")]
    # pytest, which imports tests by their paths, has the root once more, by the folder's name
    modules = [module for name, module in [*sys.modules.items()] if name == "phasemark" or name != ROOT.name]
    files = [Path(file) for module in modules if (file := getattr(module, "__file__", None))]
    assert sorted(file for file in files if file in set(own)) == sorted(own)
    assert [module.__name__ for module in imported if not (module.__doc__ or "").strip()] == []


START = """
import sys
before = set(sys.modules)
import phasemark
print(*sorted(set(sys.modules) - before))
import phasemark.data as data, phasemark.matcher as matcher
print(set(data.__all__) <= set(dir(data)), set(matcher.__all__) <= set(dir(matcher)))
import contextlib, io
from phasemark.cli import main
with contextlib.redirect_stdout(io.StringIO()) as help:
    assert main(["--help"]) == 0 and "Usage" in help.getvalue()
print(*sys.modules)
from phasemark.data import BankPlan
from phasemark.matcher import Match
print("numpy" in sys.modules)
import phasemark.landmarks, phasemark.render, phasemark.matcher.plan_kinds
print(*sys.modules)
import phasemark.render.figures
print(*sys.modules)
"""


def test_what_is_slow_to_import_is_loaded_when_it_is_used() -> None:
    # Checked by name: a measured time would depend on the machine.
    done = subprocess.run([sys.executable, "-c", START], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    root, listed, after_help, after_names, after_rooms, after_figures = map(str.split, done.stdout.splitlines())
    assert root == ["phasemark"]
    assert listed == ["True", "True"]
    heavy = {"embreex", "h5py", "jinja2", "manifold3d", "matplotlib", "numba", "numpy", "pydantic", "scipy", "trimesh"}
    assert heavy.isdisjoint(after_help)
    assert after_names == ["True"]
    assert {"matplotlib", "scipy.stats", "dask", "rosbags"}.isdisjoint(after_rooms)
    assert "matplotlib" in after_figures
    assert "matplotlib.pyplot" not in after_figures


FIRST_SCRIPT = {
    "data": ["build_bank", "read_frames"],
    "landmarks": ["catalog", "read_mesh"],
    "matcher": ["Matcher", "kalman_filter", "robot_poses"],
    "render": ["Renderer", "capture", "preset"],
}


def test_the_root_module_gives_a_first_script_the_names_of_the_rooms() -> None:
    names = {name: room for room, own in FIRST_SCRIPT.items() for name in own}
    for name, room in names.items():
        assert getattr(phasemark, name) is getattr(importlib.import_module(f"phasemark.{room}"), name)
    errors = {name for name, thing in vars(phasemark).items() if isinstance(thing, type) and name not in names}
    assert set(phasemark.__all__) == {*names, *errors, "__version__"}
    assert set(phasemark.__all__) <= set(dir(phasemark))
    with pytest.raises(AttributeError, match="module 'phasemark' has no attribute 'presets'"):
        phasemark.presets  # type: ignore[attr-defined]  # noqa: B018


def test_imports_point_one_way() -> None:
    done = subprocess.run([BIN / "lint-imports", "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert re.search(r"Contracts: \d+ kept, 0 broken", done.stdout)


def test_a_bare_import_of_a_room_is_refused() -> None:
    names = [*ROOMS, "cli"]
    lines = [
        f"{statement}\n"
        for room in names
        for statement in (f"import {room}", f"from {room} import x", f"from {room}.y import x")
    ]
    command = [str(BIN / "ruff"), "check", "--select", "TID251", "--output-format", "concise"]
    command += ["--stdin-filename", str(ROOT / "data" / "x.py"), "-"]
    done = subprocess.run(command, cwd=ROOT, input="".join(lines), capture_output=True, text=True)
    found = re.findall(r"x\.py:(\d+):.* import phasemark\.(\w+)", done.stdout)
    assert found == [(str(number + 1), names[number // 3]) for number in range(len(lines))]


@pytest.mark.parametrize("name", PACKAGES)
def test_public_names_are_listed_and_exist(name: str) -> None:
    module = importlib.import_module(name)
    imported = {
        key
        for key, thing in vars(module).items()
        if not key.startswith("_") and isinstance(thing, FunctionType | type) and thing.__module__ != "typing"
    }
    assert imported <= set(module.__all__)
    assert sorted(set(module.__all__)) == sorted(module.__all__)
    assert [key for key in module.__all__ if not hasattr(module, key)] == []


def test_the_rooms_export_what_a_newcomer_needs_and_no_more() -> None:
    counts = {
        room: len(importlib.import_module(f"phasemark.{room}").__all__)
        for room in ("landmarks", "render", "data", "matcher")
    }
    assert sum(counts.values()) <= 55, counts  # 50, and Body, Scene, SceneRenderer, zones_from_depth and Locator


def test_an_unknown_name_of_a_room_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match=r"module 'phasemark.data' has no attribute 'open_banks'"):
        importlib.import_module("phasemark.data").open_banks  # noqa: B018


def _parameters_section(docstring: str) -> set[str]:
    """Return the names that a numpydoc Parameters section explains."""
    found = re.search(r"^Parameters\n-+\n(.*?)(?=^\w[\w ]*\n-+\n|\Z)", docstring, flags=re.MULTILINE | re.DOTALL)
    lines = re.findall(r"^(?! )([\w*, ]+?)(?: : .*)?$", found[1], flags=re.MULTILINE) if found else []
    return {name.strip().lstrip("*") for line in lines for name in line.split(",")}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_explains_its_parameters_and_result(name: str) -> None:
    function = FUNCTIONS[name]
    docstring = inspect.cleandoc(function.__doc__ or "")
    assert set(inspect.signature(function).parameters) == _parameters_section(docstring)
    returns_nothing = inspect.signature(function).return_annotation in (None, "None")
    assert (
        returns_nothing or re.search(r"^(Returns|Yields)\n-+$", docstring, flags=re.MULTILINE) or _one_liner(docstring)
    )


def _one_liner(docstring: str) -> bool:
    """Whether the first line already says what comes back, as ``Return the …``."""
    return docstring.startswith(("Return ", "Yield "))


@pytest.mark.parametrize("name", CLASSES)
def test_a_public_class_explains_its_parameters(name: str) -> None:
    thing = CLASSES[name]
    docstring = inspect.cleandoc(thing.__doc__ or "")
    assert docstring
    assert docstring != inspect.getdoc(thing.__base__)  # not an inherited one
    if issubclass(thing, Exception | enum.Enum) or getattr(thing, "_is_protocol", False):
        return
    assert _constructor_parameters(thing) <= _parameters_section(docstring)


def _constructor_parameters(thing: type) -> set[str]:
    if hasattr(thing, "model_fields"):
        return set(thing.model_fields)
    if dataclasses.is_dataclass(thing):
        return {field.name for field in dataclasses.fields(thing) if field.init}
    return set(inspect.signature(thing).parameters)


@pytest.mark.parametrize("name", CLASSES)
def test_every_public_method_has_a_docstring(name: str) -> None:
    members = [key for key, thing in vars(CLASSES[name]).items() if not key.startswith("_") and _is_code(thing)]
    assert [key for key in members if not (getattr(CLASSES[name], key).__doc__ or "").strip()] == []


def _is_code(thing: object) -> bool:
    return isinstance(thing, FunctionType | property | classmethod | staticmethod)


def test_examples_in_docstrings_give_what_they_print() -> None:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        results = [doctest.testmod(importlib.import_module(name)) for name in MODULES]
    assert sum(result.failed for result in results) == 0, printed.getvalue()
    assert sum(result.attempted for result in results) > 50  # or the finder sees none


def test_ci_runs_the_command_that_the_readme_names() -> None:
    script = ROOT / ".ci" / "run"
    if not script.exists():
        pytest.skip("a source distribution carries no CI script")
    assert os.access(script, os.X_OK)
    assert "\nmake test" in script.read_text(encoding="utf-8")
    assert "\nmake test" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_no_function_of_a_command_is_longer_than_forty_lines():
    """Its signature, which is the help of its options, and its docstring left out."""
    long = {}
    for path in [ROOT / "cli.py", *ROOT.glob("*/commands/*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                statements = node.body[1:] if ast.get_docstring(node) and len(node.body) > 1 else node.body
                length = node.end_lineno - statements[0].lineno + 1
                if length > 40:
                    long[f"{path.name} {node.name}"] = length
    assert long == {}
