"""The layout holds: one copy of every module, one direction of imports, public names that are documented."""

import ast
import dataclasses
import doctest
import enum
import importlib
import inspect
import os
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import FunctionType, ModuleType

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


def test_importing_from_the_root_gives_one_copy_of_every_module() -> None:
    program = f"""
import importlib, sys
for name in {MODULES}:
    importlib.import_module(name)
for module in list(sys.modules.values()):
    if (getattr(module, "__file__", None) or "").startswith({str(ROOT / "x")[:-1]!r}):
        print(module.__file__)
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    files = [file for file in done.stdout.splitlines() if "site-packages" not in file]
    assert str(ROOT / "__init__.py") in files
    assert len(files) == len(set(files)) == len(MODULES)


def test_the_root_module_imports_nothing() -> None:
    program = "import sys; before = set(sys.modules); import phasemark; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.split() == ["phasemark"], done.stderr


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


@pytest.mark.parametrize("name", [*ROOMS, "cli"])
@pytest.mark.parametrize("statement", ["import {}", "from {} import x", "from {}.y import x"])
def test_a_bare_import_of_a_room_is_refused(name: str, statement: str) -> None:
    command = [str(BIN / "ruff"), "check", "--select", "TID251", "--stdin-filename", str(ROOT / "data" / "x.py"), "-"]
    done = subprocess.run(command, cwd=ROOT, input=statement.format(name) + "\n", capture_output=True, text=True)
    assert done.returncode == 1
    assert f"import phasemark.{name}" in done.stdout


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


@pytest.mark.parametrize("name", ["data", "matcher"])
def test_a_room_is_imported_without_its_modules(name: str) -> None:
    program = f"""
import sys
import phasemark.{name} as room
print("numpy" in sys.modules, set(room.__all__) <= set(dir(room)))
from phasemark.{name} import {{}}
print("numpy" in sys.modules)
"""
    first = importlib.import_module(f"phasemark.{name}").__all__[0]
    command = [sys.executable, "-c", program.format(first)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()) == (0, ["False", "True", "True"]), done.stderr


def test_the_rooms_export_what_a_newcomer_needs_and_no_more() -> None:
    counts = {
        room: len(importlib.import_module(f"phasemark.{room}").__all__)
        for room in ("landmarks", "render", "data", "matcher")
    }
    assert sum(counts.values()) <= 50, counts


def test_an_unknown_name_of_a_room_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match=r"module 'phasemark.data' has no attribute 'open_banks'"):
        importlib.import_module("phasemark.data").open_banks  # noqa: B018


@pytest.mark.parametrize("name", MODULES)
def test_every_module_says_what_lives_there(name: str) -> None:
    assert (importlib.import_module(name).__doc__ or "").strip()


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


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_give_what_they_print(name: str) -> None:
    module: ModuleType = importlib.import_module(name)
    assert doctest.testmod(module).failed == 0


def test_the_examples_are_found() -> None:
    # Were the finder to see none, the test above would pass for every module.
    modules = map(importlib.import_module, MODULES)
    assert sum(doctest.testmod(module).attempted for module in modules) > 0


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
