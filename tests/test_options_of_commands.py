"""Options that commands have of their signatures and docstrings."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer

from phasemark.cli import app
from phasemark.data.commands.command import Commands, Shown, stated_flags

Metres = Annotated[float, Shown(metavar="M", help="A length.")]


@dataclass(frozen=True)
class Group:
    """Some options.

    Parameters
    ----------
    map_file
        A map.
    depth
        How deep.
    """

    map_file: Path | None = None
    depth: Metres = 2.0
    width: Metres | None = None


def command_of(function):
    commands = Commands()
    commands.command("one")(function)
    return typer.main.get_command(commands)


def test_signature_and_docstring_make_arguments_and_options():
    def one(plan_or_name: str, rest: list[Path] | None = None, *, top_: bool = False, group: Group) -> None:
        """Do it.

        In a [table].

        Parameters
        ----------
        rest
            Files,
            several.
        depth
            Its depth.
        """

    command = command_of(one)
    assert command.help == "Do it.\n\nIn a [table]."
    shown = {parameter.opts[0]: (parameter.metavar, parameter.help, parameter.default) for parameter in command.params}
    del shown["--install-completion"], shown["--show-completion"]
    assert shown == {
        "plan_or_name": ("PLAN|NAME", None, None),
        "rest": ("[REST]", "Files, several.", None),
        "--top": (None, None, False),
        "--map": (None, "A map.", None),
        "--depth": ("M", "Its depth.", 2.0),
        "--width": ("M", "A length.", None),
    }


def test_options_that_are_not_at_their_defaults_are_named_in_order():
    assert stated_flags(Group()) == []
    assert stated_flags(Group(Path("x"), width=0.0)) == ["--map", "--width"]
    assert stated_flags(Group(Path("x"), width=0.0), "width", "depth", "map_file") == ["--width", "--map"]


def test_every_option_has_a_help():
    def commands(command):
        return (
            [one for inner in command.commands.values() for one in commands(inner)]
            if hasattr(command, "commands")
            else [command]
        )

    assert [
        (command.name, parameter.opts)
        for command in commands(typer.main.get_command(app))
        for parameter in command.params
        if not parameter.help
    ] == []


@pytest.mark.parametrize("words", [["render"], ["frames", "simulate"]])
def test_help_shows_words_in_square_brackets(words, capsys):
    with pytest.raises(SystemExit):
        app([*words, "--help"])
    assert "[histogram]" in " ".join(capsys.readouterr().out.split())
