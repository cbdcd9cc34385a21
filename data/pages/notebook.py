"""Tables for notebooks: what ``_repr_html_`` of banks, frame sets and matches returns."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence


def table_html(header: Sequence[str], rows: Iterable[Sequence[object]], *, caption: str = "") -> str:
    """Return a table as HTML; every text is escaped.

    Parameters
    ----------
    header : sequence of str
        Titles of the columns; without any the table has no head.
    rows : iterable of sequences
        Cells, shown as ``str`` has them.
    caption : str
        What stands above it.

    Returns
    -------
    str
    """

    def line(cells: Iterable[object], tag: str) -> str:
        style = ' style="text-align:left"'
        return f"<tr>{''.join(f'<{tag}{style}>{html.escape(str(cell))}</{tag}>' for cell in cells)}</tr>"

    head = f"<thead>{line(header, 'th')}</thead>" if header else ""
    title = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    return f"<table>{title}{head}<tbody>{''.join(line(row, 'td') for row in rows)}</tbody></table>"


def facts_html(title: str, facts: Mapping[str, object]) -> str:
    """Return names and values, one a line, as an HTML table with a caption; every text is escaped.

    Parameters
    ----------
    title : str
    facts : mapping of str to object

    Returns
    -------
    str
    """
    return table_html((), facts.items(), caption=title)
