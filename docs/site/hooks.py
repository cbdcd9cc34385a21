"""Hooks of MkDocs: the pages that are made from the program, and those of the repository's root."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from generated_pages import ROOT, SOURCES, reference_path, site_pages
from markdown_dialect import ROOT_PAGES, for_site, with_site_links, without_roles
from mkdocs.structure.files import File, Files
from notebooks import notebook_page
from public_names import public_names
from pymdownx.slugs import slugify

_ROOT_FILES = ("__init__.py", "__main__.py", "cli.py")
PACKAGE = ROOT / "out" / "package" / "phasemark"
"""Where mkdocs.yml has the reader of docstrings look: the package, which lies at the repository's root, by its name."""


def on_startup(**_: Any) -> None:
    """Lay links to the package's files."""
    PACKAGE.mkdir(parents=True, exist_ok=True)
    for name in (*_ROOT_FILES, *SOURCES):
        (PACKAGE / name).unlink(missing_ok=True)
        (PACKAGE / name).symlink_to(ROOT / name)


def on_config(config: Any) -> Any:
    """List the pages of the modules in the menu, below that of all public names."""
    for section in config.nav:
        for title, pages in section.items():
            if title == "Reference":
                modules = [{module: reference_path(module)} for module in public_names()]
                pages.insert(1, {"Modules": modules})
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add pages that are no files of docs/."""
    for name, page in ROOT_PAGES.items():
        if page and page != "index.md":
            text = (ROOT / name).read_text(encoding="utf-8")
            files.append(File.generated(config, page, content=with_site_links(text, root=True)))
    made: dict[str, str | bytes] = dict(site_pages())
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.md")):
        made |= notebook_page(path)
    for page, content in made.items():
        known = files.get_file_from_path(page)
        if known:
            files.remove(known)
        files.append(File.generated(config, page, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Bring a page of docs/ into the builder's dialect."""
    return for_site(with_site_links(markdown, root=False))


_EMPTY_DESCRIPTION = re.compile(r"\s*–\s*(?=(<div[^>]*>\s*</div>\s*)?</li>)")
"""The dash behind a type that has no description."""


def _with_breaks(cell: re.Match[str]) -> str:
    """Let long code in a cell of a table break behind its separators, so that the table fits on a phone."""
    return re.sub(
        r"(?<=<code>)[^<]+(?=</code>)",
        lambda code: re.sub(r"(?<=\w)(&#124;|[|_/]|(?<!\d)[.,:]|[.,:](?!\d))(?=\w)", r"\1<wbr>", code[0]),
        cell[0],
    )


def _set_in_type(html: str) -> str:
    """Set sub- and superscripts of formulas in running text, and keep numbers and options from breaking."""
    out, inside = [], 0
    for part in re.split(r"(<[^>]+>)", html):
        if part.startswith("<"):
            inside += bool(re.match(r"<(pre|code|script|style)\b", part)) - bool(
                re.match(r"</(pre|code|script|style)>", part)
            )
        elif not inside:
            part = re.sub(r"\^\{([^{}]+)\}", r"<sup>\1</sup>", part)
            part = re.sub(r"_\{([^{}]+)\}", r"<sub>\1</sub>", part)
            part = _SUBSCRIPT.sub(r"\1<sub>\2</sub>", part)
            part = _NUMBER.sub(r'<span class="whole">\g<0></span>', part)
        out.append(part)
    whole = r'<span class="whole">\g<0></span>'
    return re.sub(
        r"(?<=<code>)[^<]+(?=</code>)", lambda code: re.sub(r"(?<![\w-])--?[a-z][\w-]*", whole, code[0]), "".join(out)
    )


_SUBSCRIPT = re.compile(r"(?<![\w.])(?![xyz]_m\b)([A-Za-zα-ωΣ])_([A-Za-zα-ω0-9]{1,4})(?!\w)")
"""A letter with a short subscript; names of columns and fields stand in code."""
_NUMBER = re.compile(r"\d+(?: \d{3})+(?!\d)|\d[\d.]*e-\d+")
"""A number with thin groups of thousands or a negative exponent."""


def _sections_of_physics() -> dict[str, str]:
    """Return the anchors of physics.md by the numbers of its sections."""
    headings = re.findall(
        r"^## (\d+)\. (.+)$", (ROOT / "docs" / "physics.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    return {number: slugify(case="lower")(f"{number}. {title}", "-") for number, title in headings}


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Drop the marks of Sphinx from docstrings, and let what cites physics.md lead there."""
    html = without_roles(html, code=("<code>", "</code>"))
    html = re.sub(r"<td>.*?</td>", _with_breaks, html, flags=re.DOTALL)
    html = re.sub(
        r"(?<=>)phasemark\.[\w.]+(?=<a class=.headerlink|</h1>)",
        lambda name: re.sub(r"([._])", r"\1<wbr>", name[0]),
        html,
    )
    if page.url != "commands.html":  # names of columns stand in its running text
        html = _set_in_type(html)
    html = _EMPTY_DESCRIPTION.sub("", html)
    anchors = _sections_of_physics()
    root = "../" * page.url.count("/")

    def linked(match: re.Match[str]) -> str:
        anchor = anchors.get(match[1])
        return f'<a href="{root}physics.html#{anchor}">{match[0]}</a>' if anchor else match[0]

    return (
        re.sub(r"PHYSICS,?\s+sections?\s+(\d+)", linked, html) if page.url.startswith("reference/phasemark") else html
    )


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Take our own stand-in for workers, where the theme would load one from elsewhere."""
    root = "../" * page.url.count("/")
    return re.sub(r'src="https?://[^"]*/iframe-worker/shim"', f'src="{root}assets/search_worker.js"', output)


def on_post_build(config: Any, **_: Any) -> None:
    """Drop the page for unknown addresses: its links start at the root of a server, and the site may lie anywhere."""
    (Path(config.site_dir) / "404.html").unlink(missing_ok=True)
