"""Compiled code that is kept is used only while all source files it was made from are the same."""

import ast
import functools
import os
import re
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from phasemark.cli import main
from phasemark.render import compile_notes
from phasemark.render.compiled_sources import COMPILED_SOURCES, ROOT, compiled_sources_hash

_COMPILERS = ("njit", "kernel", "inner", "inlined", "_compiled", "_vectorised")

TESTS = list((ROOT / "tests").glob("**/*.py"))


def compiled_functions(tree: ast.Module) -> list[ast.FunctionDef]:
    """Return the functions of a module that numba compiles."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    passed = {
        argument.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and "njit" in ast.unparse(node.func)
        for argument in node.args
        if isinstance(argument, ast.Name)
    }
    return [
        one
        for one in functions
        if one.name in passed
        or any(word in ast.unparse(by).replace("(", ".").split(".") for by in one.decorator_list for word in _COMPILERS)
    ]


def imported_names(tree: ast.Module) -> dict[str, str]:
    """Return the module of this package that each name of a module is imported from."""
    found = {}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("phasemark."):
            found |= {name.asname or name.name: node.module for name in node.names}
    return found


def test_every_file_that_compiled_code_is_made_from_is_listed():
    files = [
        path
        for folder in ("inputs", "landmarks", "render", "data", "matcher")
        for path in ROOT.glob(f"{folder}/**/*.py")
    ]
    needed = {"render/kernel.py"}
    for path in files:
        source = path.read_text(encoding="utf-8")
        if not any(word in source for word in _COMPILERS):
            continue
        tree = ast.parse(source)
        compiled = compiled_functions(tree)
        if not compiled:
            continue
        needed.add(path.relative_to(ROOT).as_posix())
        imported = imported_names(tree)
        used = {node.id for one in compiled for node in ast.walk(one) if isinstance(node, ast.Name)}
        for name in used & set(imported):
            needed.add(imported[name].removeprefix("phasemark.").replace(".", "/") + ".py")
    assert sorted(COMPILED_SOURCES) == sorted(needed)


def test_functions_without_a_way_in_from_python_are_named_by_compiled_ones_alone():
    """Calling one from Python ends the process."""
    texts = {path: path.read_text(encoding="utf-8") for path in [*ROOT.glob("[rm]*/**/*.py"), *TESTS]}
    inner = {
        (".".join(["phasemark", *path.relative_to(ROOT).with_suffix("").parts]), one.name)
        for path, text in texts.items()
        if "@inner" in text
        for one in compiled_functions(ast.parse(text))
        if any(ast.unparse(by) == "inner" for by in one.decorator_list)
    }
    assert len(inner) > 100
    named = re.compile("|".join(rf"\b{name}\b" for _, name in inner))
    for path, text in texts.items():
        if not named.search(text):
            continue
        tree = ast.parse(text)
        own = ".".join(["phasemark", *path.relative_to(ROOT).with_suffix("").parts])
        known = {name for module, name in inner if module == own}
        known |= {name for name, module in imported_names(tree).items() if (module, name) in inner}
        for one in compiled_functions(tree):
            one.body = []
        used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        assert not used & known, path


def test_the_hash_of_the_sources_is_quick():
    seconds = []
    for _ in range(20):
        compiled_sources_hash.cache_clear()
        start = time.perf_counter()
        compiled_sources_hash()
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 5e-3  # once a process


PROGRAM = """
import importlib, sys
from pathlib import Path
from phasemark.render.compile_cache import stamp_with_all_sources
from phasemark.render.compiled_sources import compiled_sources_hash
folder = Path(sys.argv[1]).resolve()
stamp_with_all_sources(folder, ("inner_part.py", "outer_part.py"))
sys.path.insert(0, str(folder))
for value in (10, 10, 20, 20):  # as processes one after the other
    (folder / "inner_part.py").write_text(INNER.format(value))
    compiled_sources_hash.cache_clear()
    for name in ("inner_part", "outer_part"):
        sys.modules.pop(name, None)
    outer = importlib.import_module("outer_part").outer
    print(outer(), sum(outer.stats.cache_hits.values()))
"""
OUTER = """
from numba import njit
from inner_part import inner
@njit(cache=True)
def outer():
    return inner() + 1
"""
INNER = """
from numba import njit
@njit(inline="always")
def inner():
    return {}
"""


def test_a_changed_function_of_another_module_is_compiled_again(tmp_path):
    (tmp_path / "outer_part.py").write_text(OUTER)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", f"INNER = {INNER!r}{PROGRAM}", str(tmp_path)]
    printed = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert printed.splitlines() == ["11 0", "11 1", "21 0", "21 1"]  # compiled, kept, compiled again, kept


def test_sources_that_cannot_be_read_count_as_empty(tmp_path):
    (tmp_path / "one.py").write_text("")
    assert compiled_sources_hash(tmp_path, ("one.py",)) == compiled_sources_hash(tmp_path / "none", ("one.py",))


def compiling(module):
    """Return what numba tells when it begins to compile, or ends."""
    dispatcher = SimpleNamespace(py_func=SimpleNamespace(__module__=module))
    return SimpleNamespace(data={"dispatcher": dispatcher})


def test_a_second_of_compiling_is_told_once_for_rendering_and_once_for_matching(monkeypatch, capsys):
    monkeypatch.setattr(compile_notes, "_AFTER_S", 0.2)
    listener = compile_notes._Listener()

    def compile_for(module, seconds):
        listener.on_start(compiling(module))
        listener.on_start(compiling(module))  # a function that the first calls
        listener.on_end(compiling(module))
        time.sleep(seconds)
        listener.on_end(compiling(module))
        return capsys.readouterr().err

    assert compile_for("phasemark.render.renderer", 0.02) == ""
    assert compile_for("a_users.own_module", 0.3) == ""
    assert compile_for("phasemark.render.renderer", 0.3) == "compiling for rendering, once, about 60 s\n"
    assert compile_for("phasemark.render.direct.targets", 0.3) == ""
    # short pieces add up
    assert "".join(compile_for("phasemark.matcher.nearest.cells", 0.06) for _ in range(6)).startswith(
        "compiling for matching, once"
    )


@pytest.mark.parametrize("switch", ["0", "1", None])
def test_the_line_about_compiling_can_be_switched_off(monkeypatch, switch):
    registered = []
    monkeypatch.setattr("numba.core.event.register", lambda kind, listener: registered.append(kind))
    monkeypatch.delenv("PHASEMARK_COMPILE_NOTES")
    if switch is not None:
        monkeypatch.setenv("PHASEMARK_COMPILE_NOTES", switch)
    compile_notes.announce_compilation()
    assert registered == ([] if switch == "0" else ["numba:compile"])


def test_warm_prepares_what_is_asked_for_and_refuses_other_work(monkeypatch, capsys):
    # programs.compile_kernels does the work itself, before the tests
    done = []
    for name in ("_render", "_match", "_histograms"):
        monkeypatch.setattr(f"phasemark.matcher.warm.{name}", functools.partial(done.append, name))
    assert main(["warm", "--for", "match", "--for", "histograms"]) == 0
    assert done == ["_match", "_histograms"]
    rows = capsys.readouterr().out.splitlines()
    assert [row.split()[0] for row in rows[1:]] == ["match", "histograms"]
    assert main(["warm"]) == 0
    assert done[2:] == ["_render", "_match", "_histograms"]
    assert main(["warm", "--for", "flying"]) == 2
    assert "'flying' is not one of 'render', 'match', 'histograms'" in capsys.readouterr().err
