"""The prose of the program is plain English: no riddling words, and first lines that can be read alone."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("inputs", "data", "landmarks", "matcher", "render", "benchmarks", "docs", "examples", "tests", ".ci")
PROGRAMS = sorted(
    [ROOT / "cli.py", ROOT / "__init__.py", *(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))]
)
PAGES = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "examples/**/*.md", "**/*.j2", "**/*.toml", "mkdocs.yml")
    for path in ROOT.glob(pattern)
    if not {"out", "build", "corpus", "golden"} & set(path.relative_to(ROOT).parts)
    and not any(part.startswith(".") for part in path.relative_to(ROOT).parts)
)

AVOIDED = {
    "likewise": "say what is the same",
    "so many": "state the number, or write 'that number of'",
    "(?<!no )such(?! as| that)": "name the thing",
    "thought to be": "write 'assumed to be'",
    "(?:told|tell|tells|telling)(?: \\w+){0,3} apart": "write 'distinguish'",
    "says so": "say what is stated",
    "lest": "write 'so that … not'",
    "is what": "name the thing",
    "one for one": "write 'in the same proportion' or 'of equal length'",
    "anew": "write 'again'",
    "whoever": "name the reader, the caller or the user",
    "(?:hold|holds|held|holding) (?:it|them|each|\\w+s) against": "write 'compare with' or 'lock'",
    "held against": "write 'compared with'",
    "thereof|whereof|hence|albeit|whilst": "use a current word",
    "tells? of|told of": "write 'report' or 'show'",
}
"""Words of our prose that a reader has to decode, as regular expressions, and what to do instead."""
RIDDLES = re.compile("|".join(rf"\b(?:{word})\b" for word in AVOIDED), flags=re.IGNORECASE)
QUESTIONS = {"What", "Where", "How", "Who", "Which", "Whether", "Why", "When", "Whose"}
NAMES = ("classes told apart, d", "sides told apart, d")
"""Names of results, which stand in files."""
NO_VERBS = QUESTIONS | {"The", "A", "An", "It", "If", "One", "Names", "Sides", "That", "This", "These", "There"}


MENDED = (
    *("inputs/", "data/", "landmarks/", "render/"),
    *(f"matcher/{package}/" for package in ("calibration", "commands", "design", "drive", "sweep")),
)
"""Folders whose functions name their result."""


def _words(text: str) -> list[str]:
    """Return the avoided words of a text, a line break counting as a space."""
    return [found[0] for found in RIDDLES.finditer(re.sub(r"\s*\n[ #>]*", " ", text))]


def _prose(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of each docstring, message and block of comments of a program."""
    source = path.read_text(encoding="utf-8")
    if not RIDDLES.search(re.sub(r"\s*\n[ #\"']*", " ", source)):
        return
    # other strings of tests are data, and repeat messages
    docstrings_alone = ROOT / "tests" in path.parents
    for node in ast.walk(ast.parse(source)):
        if docstrings_alone and isinstance(node, ast.Expr):
            node = node.value
        elif docstrings_alone:
            continue
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value not in NAMES:
            yield node.lineno, node.value
    block: list[tuple[int, str]] = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            if block and token.start[0] > block[-1][0] + 1:
                yield block[0][0], " ".join(text for _, text in block)
                block = []
            block.append((token.start[0], token.string.lstrip("# ")))
    if block:
        yield block[0][0], " ".join(text for _, text in block)


def _page_without_code(path: Path) -> str:
    """Return the text of a page, with blocks and spans of code taken out and lines kept."""
    text = path.read_text(encoding="utf-8")
    text = re.sub(r"^```.*?^```$", lambda block: "\n" * block[0].count("\n"), text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"`[^`\n]+`", "`…`", text)


@cache
def _first_lines() -> list[tuple[ast.Module | ast.ClassDef | ast.FunctionDef, str, str]]:
    """Return each documented module, class and function of the program, its place and its docstring's first line."""
    return [
        (node, f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}", docstring.splitlines()[0])
        for path in PROGRAMS
        if ROOT / "tests" not in path.parents
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (docstring := ast.get_docstring(node))
    ]


def _is_property(node: ast.AST) -> bool:
    decorators = getattr(node, "decorator_list", [])
    return any("property" in ast.unparse(decorator) for decorator in decorators)


def test_no_docstring_message_or_comment_has_a_riddling_word() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {', '.join(words)}"
        for path in PROGRAMS
        if path != Path(__file__)
        for line, text in _prose(path)
        if (words := _words(text))
    ]
    assert found == []


def test_no_page_has_a_riddling_word() -> None:
    assert len(PAGES) > 40
    found = [
        f"{path.relative_to(ROOT)}: {text[max(0, hit.start() - 30) : hit.end() + 20]!r}"
        for path in PAGES
        for text in [re.sub(r"\s*\n[ #>]*", " ", _page_without_code(path))]
        for hit in RIDDLES.finditer(text)
    ]
    assert found == []


def test_the_first_line_of_a_function_is_an_imperative() -> None:
    found = [
        f"{place}: {line}"
        for node, place, line in _first_lines()
        if isinstance(node, ast.FunctionDef) and not _is_property(node) and line.split()[0] in NO_VERBS
    ]
    assert found == []


def test_a_result_is_named_and_not_paraphrased() -> None:
    # "Return the fitted values", not "Return what was fitted"; private functions too
    found = [
        f"{place}: {line}"
        for node, place, line in _first_lines()
        if isinstance(node, ast.FunctionDef) and line.startswith("Return what ") and place.startswith(MENDED)
    ]
    assert found == []


def test_modules_and_classes_are_described_by_a_statement_and_not_by_a_question() -> None:
    found = [
        f"{place}: {line}"
        for node, place, line in _first_lines()
        if not isinstance(node, ast.FunctionDef) and line.split()[0] in QUESTIONS
    ]
    assert found == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("Classes are told\n    apart by shape.", ["told apart"]),
        ("Frames such as these, and n such that n < 3.", []),
        ("No such file; but such a file.", ["such"]),
        ("The latest atlas.", []),
    ],
)
def test_words_are_found_across_line_breaks(text: str, words: list[str]) -> None:
    assert _words(text) == words
