"""The notebooks of docs/notebooks: their cells run in this process, and what the cells show becomes part of a page.

A notebook is Markdown as jupytext reads it: every block of Python is a cell, and all cells of a notebook share their
names.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import hashlib
import io
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl

_CELL = re.compile(r"^```python\n(.*?)^```$", flags=re.MULTILINE | re.DOTALL)
_HEADER = re.compile(r"\A---\n.*?^---\n", flags=re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Shown:
    """Output of a cell.

    Parameters
    ----------
    text : str
        What it prints.
    html : str
        What its last expression is as HTML, or nothing.
    images : tuple of bytes
        PNG images.
    """

    text: str
    html: str
    images: tuple[bytes, ...]


def _shown_value(value: object) -> tuple[str, str, tuple[bytes, ...]]:
    """Return text, HTML and images of the last expression of a cell, as a notebook would show it."""
    for name in ("_repr_png_", "_repr_html_"):
        method = getattr(value, name, None)
        found = method() if method is not None else None
        if isinstance(found, str) and name == "_repr_png_":
            found = base64.b64decode(found)
        if found:
            return ("", "", (found,)) if name == "_repr_png_" else ("", found, ())
    return ("", "", ()) if value is None else (repr(value), "", ())


def run_cell(code: str, names: dict[str, Any], title: str) -> Shown:
    """Run one cell.

    Parameters
    ----------
    code : str
    names : dict
        Names that cells share; they are changed.
    title : str
        What stands in a traceback instead of a file.

    Returns
    -------
    Shown
    """
    import matplotlib.pyplot as plt

    tree = ast.parse(code)
    last = ast.Expression(tree.body.pop().value) if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed, value = io.StringIO(), None
    with contextlib.redirect_stdout(printed), warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="FigureCanvasAgg is non-interactive")
        exec(compile(tree, title, "exec"), names)
        if last is not None:
            value = eval(compile(last, title, "eval"), names)
    figures = []
    for number in plt.get_fignums():
        buffer = io.BytesIO()
        plt.figure(number).savefig(buffer, format="png", dpi=110)
        figures.append(buffer.getvalue())
    plt.close("all")
    text, html, images = _shown_value(value)
    return Shown("\n".join(filter(None, (printed.getvalue().rstrip(), text))), html, (*images, *figures))


def run_notebook(path: Path) -> list[Shown]:
    """Run the cells of a notebook in order; what a cell raises passes.

    Parameters
    ----------
    path : Path
        A notebook as Markdown.

    Returns
    -------
    list of Shown
        One for each cell.
    """
    mpl.use("agg")
    names: dict[str, Any] = {"__name__": "__main__"}
    text = path.read_text(encoding="utf-8")
    cells = [(cell[1], text.count("\n", 0, cell.start()) + 2) for cell in _CELL.finditer(text)]
    return [run_cell("\n" * (line - 1) + code, names, path.name) for code, line in cells]


def notebook_page(path: Path) -> dict[str, str | bytes]:
    """Run a notebook and return it as a page.

    Parameters
    ----------
    path : Path
        A notebook as Markdown.

    Returns
    -------
    dict of str to str or bytes
        The page and the images it shows, by their paths in the site.
    """
    files: dict[str, str | bytes] = {}
    shown = iter(run_notebook(path))

    def with_output(cell: re.Match[str]) -> str:
        output = next(shown)
        parts = [cell[0]]
        if output.text:
            parts.append(f"```text\n{output.text}\n```")
        if output.html:
            parts.append(f'<div class="cell-output">\n{output.html}\n</div>')
        for image in output.images:
            name = f"{path.stem}-{hashlib.sha256(image).hexdigest()[:12]}.png"
            files[f"notebooks/{name}"] = image
            parts.append(f"![What the cell draws]({name})")
        return "\n\n".join(parts)

    text = _HEADER.sub("", path.read_text(encoding="utf-8"))
    return {f"notebooks/{path.name}": _CELL.sub(with_output, text), **files}
