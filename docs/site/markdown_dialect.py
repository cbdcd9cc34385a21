"""From the Markdown of the repository, which a code host shows, to that of the site's builder."""

from __future__ import annotations

import html
import re

_ITEM = re.compile(r"(-|\d+\.) ")


def _kept_lines(text: str) -> list[tuple[str, bool]]:
    """Return lines, and whether each stands inside a fenced block."""
    lines, fence = [], ""
    for line in text.split("\n"):
        mark = re.match(r" *(`{3,}|~{3,})", line)
        inside = bool(fence) or bool(mark)
        if mark and not fence:
            fence = mark[1]
        elif mark and fence and line.strip() == fence:
            fence = ""
        lines.append((line, inside))
    return lines


_LONG_CODE = 30


def _in_a_table(code: str) -> str:
    """Return code as a table of the site holds it: a long name may break at its underscores and slashes."""
    if len(code) <= _LONG_CODE or " " in code:
        return f"`{code}`"
    breakable = re.sub("(::|/|_)", r"\1<wbr>", html.escape(code))
    # an underscore would be read as emphasis, and a bar as the border of a cell
    return f"<code>{breakable.replace('_', '&#95;').replace('|', '&#124;')}</code>"


def for_site(text: str) -> str:
    """Return Markdown whose lists and tables the site's builder reads as a code host does.

    CommonMark takes what is indented as far as an item's text for a part of the item, and a list may follow a
    paragraph without an empty line. Python-Markdown wants four columns and the empty line. In code within a table a
    code host wants the bar escaped; Python-Markdown would show the backslash.

    Parameters
    ----------
    text : str
        Markdown; items of lists begin in column 0.

    Returns
    -------
    str
    """
    done: list[str] = []
    width = 0  # columns that belong to the item that is open
    loose = False  # whether that item has more than one paragraph
    for line, fenced in _kept_lines(text):
        item = _ITEM.match(line)
        if item and not fenced:
            if done and done[-1].strip() and (loose or not width):
                done.append("")
            width, loose = item.end(), False
        elif line.strip() and not line.startswith(" ") and not (width and done[-1].strip() and not fenced):
            width = 0
        loose = loose or bool(width and not line.strip())
        if width and line.startswith(" " * width):
            line = " " * (4 - width) + line
        if line.startswith("|") and not fenced:
            line = re.sub(r"`([^`]+)`", lambda code: _in_a_table(code[1].replace(r"\|", "|")), line)
        done.append(line)
    return "\n".join(done)


def without_roles(text: str, code: tuple[str, str] = ("`", "`")) -> str:
    """Drop the marks of Sphinx: the role before code, and of a name that begins with a tilde all but its last part.

    Parameters
    ----------
    text : str
    code : (str, str), optional
        What stands before code and after it.

    Returns
    -------
    str
    """
    before, after = map(re.escape, code)
    text = re.sub(rf":(?:mod|class|func|meth|data|attr):(?={before})", "", text)
    return re.sub(rf"{before}~(?:\w+\.)+(\w+){after}", lambda name: f"{code[0]}{name[1]}{code[1]}", text)


ROOT_PAGES = {
    "CHANGELOG.md": "changelog.md",
    "CITATION.cff": None,
    "CODE_OF_CONDUCT.md": "conduct.md",
    "CONTRIBUTING.md": "contributing.md",
    "README.md": "index.md",
    "RELEASING.md": "releasing.md",
    "SECURITY.md": "security.md",
}
"""Pages of the repository's root, and where the site has them."""


def with_site_links(text: str, *, root: bool) -> str:
    """Return a page whose links lead to where the site has their targets.

    Parameters
    ----------
    text : str
        Markdown.
    root : bool
        Whether the page lies in the repository's root, and not in docs/.

    Returns
    -------
    str
    """

    def moved(match: re.Match[str]) -> str:
        target, anchor = match[1], match[2] or ""
        path = target.removeprefix("../") if not root else target
        if root and path.startswith("docs/"):
            path = path.removeprefix("docs/")
        elif (root or target.startswith("../")) and path.split("/")[0] == "examples":
            path, anchor = "reference/examples.md", ""
        elif (root or target.startswith("../")) and path in ROOT_PAGES:
            path = ROOT_PAGES[path] or "index.md"
        else:
            path = target
        return f"]({path}{anchor})"

    return re.sub(r"\]\((?!\w+:|#)([^)#\s]+)(#[^)\s]*)?\)", moved, text)
