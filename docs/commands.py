"""Write docs/commands.md, every command with its options, from the program itself: ``python docs/commands.py``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import typer

from phasemark.cli import app

PAGE = Path(__file__).parent / "commands.md"
TITLE = "Options of several commands"
ANCHOR = TITLE.lower().replace(" ", "-")
TYPES = {str: "TEXT", int: "INTEGER", float: "NUMBER", Path: "PATH"}
INTRODUCTION = """\
# Every command

Generated from the program by `python docs/commands.py`; do not edit. `phasemark COMMAND --help` prints the same for one
command; [the tour by task](tour.md) shows them at work. Results go to standard output, messages and progress
to standard error; [exit codes](errors.md) say what went wrong.

`phasemark` alone says what to do first, `phasemark --version` prints the version, and `phasemark --install-completion`
teaches commands and options to bash, zsh, fish or PowerShell (`--show-completion` prints what it would install).
`--no-verify`, before a command or behind it, reads files [that contradict their checksum](formats.md) all the same.
"""


def commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Return every command that does something, with the words that call it."""
    if not hasattr(command, "commands"):
        yield path, command
        return
    for name, inner in command.commands.items():
        yield from commands(inner, f"{path} {name}")


def one_line(text: str) -> str:
    """Return text on one line."""
    return " ".join(text.split())


def choices(annotation: Any) -> list[str]:
    """Return the words that an option chooses among, of ``Literal[...]``, ``list`` of it, or it and None."""
    if get_origin(annotation) is Literal:
        return [str(word) for word in get_args(annotation)]
    return next(filter(None, map(choices, get_args(annotation))), [])


def kind(option: Any) -> str:
    """Return what an option takes, a repeatable one what it takes each time."""
    annotation = option.type_descriptor.annotation
    words = choices(annotation)
    if words:
        return "|".join(words)
    return TYPES[next(iter(get_args(annotation)), annotation)]


def options(command: Any) -> list[Any]:
    """Return the options of a command that its help shows."""
    return [one for one in command.params if one.param_type_name == "option" and not one.hidden]


def option_names(option: Any) -> str:
    """Return the words that state an option, and what it takes."""
    takes = "" if option.is_flag else f" {option.metavar or kind(option)}"
    *others, last = (*option.opts, *option.secondary_opts)
    return ", ".join(f"`{name}`" for name in (*others, f"{last}{takes}"))


def option_line(option: Any) -> str:
    """Return one item of the list of options."""
    if option.required:
        default = " (required)"
    elif option.is_flag or option.default in (None, [], ()) or callable(option.default):
        default = ""
    else:
        default = f" (`{option.default}`)"
    return f"- {option_names(option)}{default}: {one_line(option.help or '')}"


def shared_lines(found: list[tuple[str, Any]]) -> list[str]:
    """Return the lines of options that several commands have; of one with several meanings the most frequent one."""
    of_commands = [option for _, command in found for option in options(command) if not option.required]
    lines = Counter((option_names(option), option_line(option)) for option in of_commands)
    shared: dict[str, str] = {}
    for (names, line), count in lines.most_common():
        if count > 1:
            shared.setdefault(names, line)
    return [shared[names] for names in sorted(shared)]


def section(path: str, command: Any, shared: list[str]) -> str:
    """Return what the page says of one command; options with a shared line are named only."""
    arguments = [one for one in command.params if one.param_type_name == "argument"]
    words = [one.metavar or one.name.upper() for one in arguments]
    lines = [f"## {path}", ""]
    if arguments:
        lines += [f"    {' '.join([path, *words, '[OPTIONS]'])}", ""]
    for paragraph in (command.help or "").split("\n\n"):
        lines += [one_line(paragraph), ""]
    own = [
        f"- `{word}`: {one_line(getattr(one, 'help', None) or '')}" for word, one in zip(words, arguments, strict=True)
    ]
    own += [line for line in map(option_line, options(command)) if line not in shared]
    named = [option_name(option, shared) for option in options(command) if option_line(option) in shared]
    if own:
        lines += [*own, ""]
    if named:
        lines += [f"[Shared options](#{ANCHOR}): {', '.join(named)}.", ""]
    return "\n".join(lines)


def option_name(option: Any, shared: list[str]) -> str:
    """Return the name of an option with a shared line, and what it takes if another shared option has the name."""
    name = f"`{option.opts[0]}"
    alone = sum(line.startswith((f"- {name}`", f"- {name} ")) for line in shared) == 1
    return f"{name}`" if alone else option_names(option)


def page() -> str:
    """Return the whole page."""
    found = list(commands(typer.main.get_command(app), "phasemark"))
    shared = shared_lines(found)
    common = [f"## {TITLE}", "", "In brackets: the default.", "", *shared, ""]
    return "\n".join([INTRODUCTION, *common, *(section(*one, shared) for one in found)])


def main() -> None:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
