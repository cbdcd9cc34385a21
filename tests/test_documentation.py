"""Pages that are made from the program are up to date, and every page can be found."""

import itertools
import pydoc
import re
import runpy
from pathlib import Path

import pytest

from phasemark.data.commands.command import OUTPUTS
from phasemark.render import preset, preset_names
from phasemark.render.sensor.shipped_sensors import preset_sources
from phasemark.render.sensor.sources import kind_of_source

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def commands():
    return runpy.run_path(str(ROOT / "docs" / "commands.py"))


def test_the_page_of_commands_is_what_the_program_says(commands):
    # mend with: python docs/commands.py
    assert (ROOT / "docs" / "commands.md").read_text(encoding="utf-8") == commands["page"]()


def test_the_page_of_commands_has_every_command_that_help_lists(commands):
    listed = {
        path for path, _ in commands["commands"](commands["typer"].main.get_command(commands["app"]), "phasemark")
    }
    assert {"phasemark demo", "phasemark bank build", "phasemark landmark design", "phasemark calibrate"} <= listed
    page = commands["page"]()
    assert all(f"## {path}\n" in page for path in listed)


def test_the_index_leads_to_every_page():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    pages = sorted(page.name for page in (ROOT / "docs").glob("*.md") if page.name != "index.md")
    assert [page for page in pages if f"({page})" not in index] == []


PAGES = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("tests/**/*.md")} - {ROOT / "CHANGELOG.md"})
FOLDERS = ("benchmarks", "data", "docs", "examples", "inputs", "landmarks", "matcher", "packaging", "render", "tests")

MODULES = {path.name for top in FOLDERS for path in (ROOT / top).rglob("*.py")}


def is_there(word):
    """Return True unless a word is a path of this repository, or the name of a module, that does not exist.

    Words in capitals are placeholders.
    """
    word = re.sub(r"\b[A-Z]+\b", "*", word.rstrip("./"))
    if "/" in word and word.split("/")[0] in FOLDERS:
        return any(ROOT.glob(word))
    if not re.fullmatch(r"[\w-]+\.py", word) or (ROOT / word).exists():
        return True
    return word in MODULES


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_that_a_page_names_exists(page):
    prose = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    words = {word for span in re.findall(r"`([^`\n]+)`", prose) for word in re.findall(r"[\w./*-]+", span)}
    assert sorted(word for word in words if not is_there(word)) == []


def test_a_file_that_does_not_exist_is_noticed():
    assert is_there("render/integral/light.py")
    assert is_there("tests/corpus/KIND")
    assert is_there("a/b.py")
    assert not is_there("render/integral/footprint.py")
    assert not is_there("footprint.py")


def table_below(page, first):
    """Return the rows of the table of a page whose header begins with a cell."""
    lines = (ROOT / "docs" / page).read_text(encoding="utf-8").partition(f"| {first} |")[2].splitlines()[2:]
    rows = itertools.takewhile(lambda line: line.strip().startswith("|"), lines)
    return [[cell.strip() for cell in row.strip().strip("|").split("|")] for row in rows]


def test_every_equation_of_the_paper_has_a_function_and_a_page():
    rows = table_below("physics.md", "equation of the paper")
    assert {int(n) for equation, *_ in rows for n in re.findall(r"\((\d+)\)", equation)} == {1, 5, 6, 8, 9, 10, 14}
    for _, function, link in rows:
        assert callable(pydoc.locate(function.strip("`"))), function
        page, _, anchor = re.fullmatch(r"\[.+\]\((.+)\)", link)[1].partition("#")
        text = (ROOT / "docs" / page).read_text(encoding="utf-8")
        assert not anchor or re.search(rf"^#+ {anchor.replace('-', ' ')}$", text, re.MULTILINE | re.IGNORECASE), link


def test_the_page_of_direct_sensors_says_what_is_published_of_each_chip():
    always = {"estimator", "estimator_bins", "threshold"}
    rows = table_below("direct.md", "preset")
    stated = {name: row[1:] for row in rows for name in re.findall(r"`([^`]+)`", row[0])}
    assert set(stated) == {name for name in preset_names() if preset(name).histogram is not None}
    for name, cells in stated.items():
        sources = {k.removeprefix("histogram."): v for k, v in preset_sources(name).items() if "histogram." in k}
        assert {kind_of_source(sources[field]) for field in always} == {"assumed"}
        for kind, cell in zip(("published", "measured", "assumed"), cells, strict=True):
            of_kind = {field for field, source in sources.items() if kind_of_source(source) == kind}
            assert set(re.findall(r"\w+", cell)) == of_kind & (REPORTED - always), (name, kind)


REPORTED = {
    "bins", "bin_width_m", "estimator", "estimator_bins", "max_targets", "min_separation_m", "reports", "threshold"
}  # fmt: skip


def test_every_test_that_a_promise_names_exists():
    page = (ROOT / "tests" / "promises.md").read_text(encoding="utf-8")
    named = re.findall(r"`(test_\w+\.py)(?:::(test_\w+))?`", page)
    assert len(named) > 15
    for file, test in named:
        text = (ROOT / "tests" / file).read_text(encoding="utf-8")
        assert f"def {test}(" in text if test else "def test_" in text, f"{file}::{test}"


def test_every_command_that_writes_has_its_promises(commands):
    page = (ROOT / "tests" / "promises.md").read_text(encoding="utf-8")
    found = commands["commands"](commands["typer"].main.get_command(commands["app"]), "phasemark")
    writing = {path.removeprefix("phasemark ") for path, command in found if writes(command)} | {"sweep report"}
    assert {path for path in writing if f"`{path}" not in page} == set()


def writes(command):
    return {parameter.name for parameter in command.params} & set(OUTPUTS)


def test_no_page_or_message_installs_extras_from_an_index():
    # The package is on none: extras come from the clone, as in pip install -e '.[ros]'.
    pages = [ROOT / "README.md", ROOT / "cli.py", *(ROOT / "docs").glob("*.md"), *(ROOT / "examples").glob("*")]
    pages += [path for room in ("data", "landmarks", "matcher", "render") for path in (ROOT / room).rglob("*.py")]
    texts = {path.name: path.read_text(encoding="utf-8") for path in pages if path.is_file()}
    assert [name for name, text in texts.items() if "phasemark[" in text or "pip install phasemark" in text] == []


def test_the_tutorials_explain_every_example():
    tutorials = (ROOT / "docs" / "tutorials.md").read_text(encoding="utf-8")
    assert [path.name for path in (ROOT / "examples").glob("*.py") if path.name not in tutorials] == []
