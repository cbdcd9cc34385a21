"""Checks of the files and folders that a command is about to write."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from phasemark import OutputExistsError, UsageError
from phasemark.data.commands.command import inputs_given

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pydantic import BaseModel


def refuse_input_files(outputs: Iterable[Path], plan: BaseModel | None = None) -> None:
    """Refuse outputs that are the same file as an argument of the running command, or as one that a plan names."""
    from phasemark.data.files.same_file import named_files, refuse_inputs

    of_plan = () if plan is None else named_files(plan.model_dump())
    refuse_inputs(outputs, [*inputs_given.get(), *of_plan])


@contextmanager
def output_folder(
    folder: Path, command: str, names: Sequence[str], force: bool, plan: BaseModel | None = None
) -> Iterator[None]:
    """Lock a folder while a command writes files into it; a file that another program wrote is not replaced.

    `names` must not exist unless they are ours and `force` is set.
    """
    from phasemark.data.files.folder_marker import adding_to_folder

    refuse_existing([folder / name for name in names], force, plan)
    with adding_to_folder(folder, command) as ours:
        ours.claim(*names)
        yield


def refuse_existing(paths: Sequence[Path], force: bool, plan: BaseModel | None = None) -> None:
    """Refuse outputs that are inputs, or exist, before any work is done."""
    refuse_input_files(paths, plan)
    for path in paths:
        if path.is_dir():
            raise UsageError(f"{path}: is a folder, give the name of a file")
        if path.exists() and not force:
            raise OutputExistsError(f"{path}: exists already; --force replaces it")


def refuse_other_files(path: Path, suffix: str, what: str = "the figure") -> None:
    """Refuse the name of an output that does not end as files of its kind do."""
    if path.suffix.lower() != suffix:
        raise UsageError(f"{what} must be a {suffix} file, got '{path}'")


def write_file(path: Path, content: str | bytes, force: bool) -> Path:
    """Write a whole file, text as UTF-8."""
    from phasemark.data.files.atomic_write import write_atomically

    return write_atomically(path, content.encode() if isinstance(content, str) else content, force=force)


def write_figure(path: Path, figure: Figure, force: bool, *, dpi: float = 120) -> Path:
    """Write a figure as PNG."""
    from phasemark.render.png import figure_png

    return write_file(path, figure_png(figure, dpi=dpi), force)


def refuse_unwritable_files(paths: Iterable[Path], force: bool) -> None:
    """Refuse outputs that exist or cannot be written, before any work is done."""
    from phasemark.data.files.atomic_write import refuse_unwritable

    refuse_existing(paths := list(paths), force)
    for path in paths:
        refuse_unwritable(path, force=force)
