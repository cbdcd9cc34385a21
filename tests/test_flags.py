"""Messages of the library name parameters; the command line, and it alone, turns them into flags."""

import ast
import functools
import re
from pathlib import Path

import pytest
import typer

import phasemark
from phasemark.cli import app
from phasemark.data.commands.flag_wording import FLAGS, PHRASES, in_flags

ROOT = Path(phasemark.__file__).parent
ROOMS = ("inputs", "landmarks", "render", "data", "matcher")
LIBRARY = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py") if path.parent.name != "commands")
FLAG = re.compile(r"(?<![\w-])--(?=[a-z])")
COMMAND = re.compile(r"(phasemark|frames export) [^'\"]*")
"""A whole command, with which a file that states it was made, may have flags."""


@functools.cache
def texts(path):
    """Return the strings of a module that are no docstrings, values within them left out, with their lines."""
    found = []
    tree = ast.parse(path.read_text(encoding="utf-8"))
    skipped = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    skipped |= {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.append((node.lineno, node.value))
        elif isinstance(node, ast.JoinedStr):
            text = "".join(p.value if isinstance(p, ast.Constant) else "{}" for p in node.values)
            found.append((node.lineno, text))
    return found


def with_flags(path):
    return [line for line, text in texts(path) if FLAG.search(COMMAND.sub("", text).replace("--{}", "--x"))]


def test_no_message_of_the_library_names_a_flag():
    assert len(LIBRARY) > 100
    assert {str(path.relative_to(ROOT)): found for path in LIBRARY if (found := with_flags(path))} == {}


def test_a_flag_in_a_message_is_found(tmp_path):
    path = tmp_path / "module.py"
    path.write_text(
        '"""Of --force."""\na = f"{name}: use --force"\nb = f"--{name} is wrong"\nc = "phasemark demo --seed 1"\n'
        'd = "never--ending"\n'
    )
    assert with_flags(path) == [2, 3]


def test_every_parameter_that_becomes_a_flag_is_named_by_a_message_and_is_an_option():
    said = "\n".join(text for path in LIBRARY for _, text in texts(path))
    for name in FLAGS:
        assert re.search(rf"\b{name}=", said) or name in ("unit", "quantity")
    assert all(phrase in said for phrase in PHRASES)

    def options(command):
        if hasattr(command, "commands"):
            return {word for inner in command.commands.values() for word in options(inner)}
        return {word for option in command.params for word in option.opts}

    known = options(typer.main.get_command(app)) | {"--no-verify"}
    flags = re.findall(r"--[\w-]+", " ".join([*FLAGS.values(), *PHRASES.values()]))
    assert set(flags) <= known


@pytest.mark.parametrize(
    ("library", "command_line"),
    [
        ("b.h5: exists; use force=True to replace it", "b.h5: exists; use --force to replace it"),
        ("an unfinished run of it exists: resume=True continues it, force=True starts over",
         "an unfinished run of it exists: --resume continues it, --force starts over"),
        ("give unit=m|cm|mm and quantity=range (along the ray)|z",
         "give --unit m|cm|mm and --quantity range (along the ray)|z"),
        ("is unit=… right? All would fit with unit=mm (dividing by 1000)",
         "is --unit right? All would fit with --unit mm (dividing by 1000)"),
        ("say in which unit it is (unit=…); its extents", "say in which unit it is (--unit); its extents"),
        ("scheduler=… must be threads", "--scheduler must be threads"),
        ("part=… must be I/N", "--shard must be I/N"),
        ("part=3/8 would be empty", "--shard 3/8 would be empty"),
        ("give fixed=pitch or fixed=roll", "give --fix pitch or --fix roll"),
        ("takes bounces and a positive floor_albedo_std of the background",
         "takes --bounces, without --floor-albedo"),
        ("state it with Mounting(delay_s=…) and give fixed=delay", "state it with --delay-ms and give --fix delay"),
        ("(state yours with pose_std=…)", "(state yours with --position-std, --heading-std and --delta-std)"),
        ("says 1 (unverified() reads it all the same)", "says 1 (--no-verify reads it all the same)"),
        ("name it with trusted=a.b:c, or leave refuse_programs() out if",
         "name it with --matcher a.b:c, or give --trust-plan if"),
        ("build a full one (layout='full')", "build a full one (--full, layout = 'full')"),
        ("run_sweep(resume=True) goes on", "'phasemark sweep run --resume' goes on"),
        ("out/force=True.h5: is a folder; got 'unit=mm'", "out/force=True.h5: is a folder; got 'unit=mm'"),
    ],
)  # fmt: skip
def test_the_command_line_says_it_in_flags(library, command_line):
    assert in_flags(library) == command_line
