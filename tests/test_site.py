"""What the site is made of is complete and true: links, public names, notebooks, figures, the README's output."""

import importlib
import importlib.util
import json
import re
import sys
import tomllib
import unicodedata
from pathlib import Path

import pytest
from readme_commands import printed_and_expected

import phasemark

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parent.parent
SITE = ROOT / "docs" / "site"
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / ".github").rglob("*.md")])
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.md"))


@pytest.fixture(scope="module", autouse=True)
def site_modules():
    """Let the modules that build the site import one another."""
    sys.path.insert(0, str(SITE))
    yield
    sys.path.remove(str(SITE))


def module(name):
    return importlib.import_module(name)


def figures():
    spec = importlib.util.spec_from_file_location("documentation_figures", ROOT / "docs" / "figures.py")
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


def prose(page):
    """Return a page without its fenced blocks."""
    return re.sub(r"^(`{3,}).*?^\1$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def anchors(page):
    """Return the anchors of a page's headings, as a code host makes them."""
    found = set()
    for heading in re.findall(r"^#{1,6} (.+)$", prose(page), flags=re.MULTILINE):
        text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
        kept = "".join(c for c in text if c in " -_" or unicodedata.category(c)[0] in "LN")
        found.add(kept.replace(" ", "-"))
    return found


# --- links ---


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_file_and_an_anchor(page):
    for target, anchor in re.findall(r"\]\((?!\w+:)([^)#\s]*)#?([^)\s]*)\)", prose(page)):
        file = (page.parent / target).resolve() if target else page
        assert file.exists(), target
        if anchor and file.suffix == ".md":
            assert anchor in anchors(file), f"{target}#{anchor}"


def test_every_page_stands_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    pages = [str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")]
    assert [page for page in pages if f": {page}\n" not in navigation] == []


# --- public names ---


def test_every_public_name_says_what_it_is():
    missing = []
    for place, names in module("public_names").public_names().items():
        for name in names:
            thing = getattr(importlib.import_module(place), name)
            if callable(thing) and not module("generated_pages").first_line(thing):
                missing.append(f"{place}.{name}")
    assert missing == []


def test_every_public_name_gets_a_page():
    pages = module("generated_pages").reference_pages()
    for place, names in module("public_names").public_names().items():
        page = pages[f"reference/{place}.md"]
        described = [module("public_names").described_at(place, name) for name in names]
        assert [name for name in described if f"\n::: {name}\n" not in page] == []


def test_a_name_of_a_room_that_the_root_module_gives_too_is_listed_once():
    names = module("public_names").public_names()
    assert all(issubclass(getattr(phasemark, name), phasemark.PhasemarkError) for name in names["phasemark"])
    assert "preset" in names["phasemark.render"]
    assert "`pm.preset`" in module("generated_pages").reference_page(linked=False)


def test_a_function_beside_a_module_of_its_name_is_described_itself():
    found = module("public_names").described_at
    assert found("phasemark.landmarks", "catalog") == "phasemark.landmarks.catalog.catalog"
    assert found("phasemark.landmarks", "build_mesh") == "phasemark.landmarks.build_mesh"


@pytest.mark.parametrize("name", ["reference.md", "plans.md"])
def test_a_page_made_from_the_program_is_up_to_date(name):
    # mend with: make pages
    assert (ROOT / "docs" / name).read_text(encoding="utf-8") == module("generated_pages").WRITTEN[name]()


def test_every_key_of_every_plan_has_a_meaning():
    items = [line for line in module("generated_pages").plans_page().splitlines() if line.startswith("- `")]
    assert len(items) > 100
    assert [item for item in items if not item.partition("): ")[2].strip()] == []


@pytest.mark.parametrize(
    ("value", "written"), [(2**64, "2⁶⁴"), (2**31 - 1, "2³¹ − 1"), (1_000_000, "1 000 000"), (-45, "−45"), (0.5, "0.5")]
)
def test_limits_are_written_as_a_person_would(value, written):
    assert module("generated_pages").limit(value) == written


def test_no_limit_of_a_plan_has_an_exponent():
    assert re.findall(r"\de[+-]\d", module("generated_pages").plans_page()) == []


def test_comments_of_example_plans_fit_a_line_of_100_characters():
    plans = [*ROOT.glob("data/plans/**/*.toml"), *ROOT.glob("matcher/**/*.toml"), *ROOT.glob("examples/*.toml")]
    assert len(plans) > 6
    assert [
        line for plan in plans for line in plan.read_text("utf-8").splitlines() if "#" in line and len(line) > 100
    ] == []


def test_code_in_the_readme_fits_a_line_of_88_characters():
    from readme_commands import read_blocks

    blocks = read_blocks((ROOT / "README.md").read_text(encoding="utf-8"))
    lines = [line for block in blocks for line in block.text.splitlines() if not line.startswith(("position", "0 "))]
    assert [line for line in lines if len(line) > 88] == []


def test_an_undocumented_name_would_be_noticed(monkeypatch):
    monkeypatch.setattr(phasemark, "__all__", [*phasemark.__all__, "undocumented"])
    assert "undocumented" in module("public_names").public_names()["phasemark"]


def test_messages_are_found_with_their_exit_codes():
    found = module("generated_pages").messages()
    assert all(found.values())
    assert sum(map(len, found.values())) > 300


# --- notebooks ---


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown = module("notebooks").run_notebook(path)
    assert len(shown) == len(re.findall(r"^```python$", path.read_text(encoding="utf-8"), flags=re.MULTILINE)) > 3
    assert any(cell.images or cell.html for cell in shown)


def test_a_failing_cell_is_no_page(tmp_path):
    (tmp_path / "wrong.md").write_text("# Wrong\n\n```python\nx = 1\n```\n\n```python\nx.no_such_name\n```\n")
    with pytest.raises(AttributeError, match="no_such_name"):
        module("notebooks").notebook_page(tmp_path / "wrong.md")


def test_a_cell_that_warns_fails(tmp_path):
    (tmp_path / "warns.md").write_text("```python\nimport warnings\nwarnings.warn('old')\n```\n")
    with pytest.raises(UserWarning, match="old"):
        module("notebooks").run_notebook(tmp_path / "warns.md")


def test_what_a_cell_shows_stands_below_it(tmp_path):
    (tmp_path / "adds.md").write_text("---\nkernel: x\n---\n# Adds\n\n```python\nx = 2\nprint('two')\nx + 1\n```\n")
    page = module("notebooks").notebook_page(tmp_path / "adds.md")["notebooks/adds.md"]
    assert page == "# Adds\n\n```python\nx = 2\nprint('two')\nx + 1\n```\n\n```text\ntwo\n3\n```\n"


# --- the reference ---

MODEL = '''
class Base:
    def __init__(self, **data): ...
    size: int = 3


class Plan(Base):
    """A plan.

    Parameters
    ----------
    size : int
    name : str
    shares : dict
    step : {1, 2}
    """

    name: str
    shares: dict = Field(default_factory=lambda: {"a": 1})
    step: int = Field(default=STEP, gt=0)


def read(path, *, unit=None, up="z", down="y"):
    """Read.

    Parameters
    ----------
    path : str
    unit : {'m', 'mm'}
    up, down : str
    """
'''


def test_defaults_are_those_of_signatures_and_fields(tmp_path):
    griffe = pytest.importorskip("griffe")
    (tmp_path / "planned.py").write_text(MODEL)
    extensions = griffe.load_extensions("dataclasses", str(SITE / "stated_defaults.py"))
    loader = griffe.GriffeLoader(extensions=extensions, search_paths=[tmp_path], docstring_parser="numpy")
    found = {
        f"{member}.{parameter.name}": None if parameter.value is None else str(parameter.value)
        for member in ("Plan", "read")
        for section in loader.load("planned")[member].docstring.parsed
        if section.kind is griffe.DocstringSectionKind.parameters
        for parameter in section.value
    }
    assert found == {
        "Plan.size": "3",
        "Plan.name": None,
        "Plan.shares": "{'a': 1}",
        "Plan.step": "STEP",
        "read.path": None,
        "read.unit": "None",
        "read.up": "'z'",
        "read.down": "'y'",
    }


# --- the dialect of the site's builder ---


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("words:\n- a\n- b", "words:\n\n- a\n- b"),
        ("- a\n  more\n\n      code", "- a\n    more\n\n        code"),
        ("- a\n\n  more\n- b", "- a\n\n    more\n\n- b"),
        ("1. a\n   more", "1. a\n    more"),
        ("```\n- a\n  b\n```", "```\n- a\n  b\n```"),
        ("- a\n\ntext\n\n    code", "- a\n\ntext\n\n    code"),
        (r"| `a\|b` | \|S\| |", r"| `a|b` | \|S\| |"),
        (
            r"| `ranges\|phasors\|histograms\|targets` |",
            "| <code>ranges&#124;phasors&#124;histograms&#124;targets</code> |",
        ),
        (
            "| `test_folders.py::test_a_folder_is_kept` |",
            "| <code>test&#95;<wbr>folders.py::<wbr>test&#95;<wbr>a&#95;<wbr>folder&#95;<wbr>is&#95;<wbr>kept</code> |",
        ),
        ("```\n| `a\\|b` |\n```", "```\n| `a\\|b` |\n```"),
    ],
)
def test_lists_and_tables_are_written_as_the_sites_builder_reads_them(text, expected):
    assert module("markdown_dialect").for_site(text) == expected


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("as :func:`read_frames` reads", "as `read_frames` reads"),
        ("of :class:`~phasemark.render.Sensor`", "of `Sensor`"),
        ("in `~/.cache/phasemark/banks`", "in `~/.cache/phasemark/banks`"),
    ],
)
def test_marks_of_sphinx_are_not_shown(text, shown):
    assert module("markdown_dialect").without_roles(text) == shown
    html = re.sub("`([^`]+)`", r"<code>\1</code>", text)
    expected = re.sub("`([^`]+)`", r"<code>\1</code>", shown)
    assert module("markdown_dialect").without_roles(html, code=("<code>", "</code>")) == expected


def test_links_to_the_repositorys_root_lead_to_pages_of_the_site():
    change = module("markdown_dialect").with_site_links
    text = "[a](../CHANGELOG.md) [b](physics.md#x) [c](../examples/own_matcher.py) [d](#here) [e](mailto:x)"
    expected = "[a](changelog.md) [b](physics.md#x) [c](reference/examples.md) [d](#here) [e](mailto:x)"
    assert change(text, root=False) == expected
    assert change("[a](docs/limits.md#sizes) [b](SECURITY.md)", root=True) == "[a](limits.md#sizes) [b](security.md)"


# --- figures ---


def test_every_figure_is_shown_and_no_older_than_its_sources():
    # mend with: make figures; or look at them, and python docs/figures.py --accept
    drawn = json.loads((ROOT / "docs" / "images" / "drawn.json").read_text(encoding="utf-8"))
    images = {path.name for path in (ROOT / "docs" / "images").iterdir()} - {"drawn.json"}
    assert images == set(drawn)
    assert [name for name in sorted(drawn) if figures().drawn_from(name) != drawn[name]] == []
    shown = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert [name for name in sorted(images) if f"images/{name})" not in shown] == []


def test_a_figure_is_older_than_a_plan_that_changed(monkeypatch, tmp_path):
    made = figures()
    before = made.drawn_from("accuracy-distance.png")
    for source in made.SOURCES["accuracy-distance.png"]:
        path = tmp_path / source
        path.parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / source).is_dir():
            path.symlink_to(ROOT / source)
        else:
            path.write_bytes((ROOT / source).read_bytes() + b"\n# another\n")
    monkeypatch.setattr(made, "ROOT", tmp_path)
    assert made.drawn_from("accuracy-distance.png") != before


# --- the README and the release ---


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 1200


def test_the_readme_prints_what_the_program_prints(tmp_path):
    compared = list(printed_and_expected(ROOT / "README.md", tmp_path))
    assert len(compared) >= 3
    for command, printed, expected in compared:
        assert printed == expected, command


def test_the_citation_has_the_programs_version():
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {phasemark.__version__}\n" in text


@pytest.mark.parametrize("name", ["README.md", "SECURITY.md", "RELEASING.md", "CODE_OF_CONDUCT.md", "CITATION.cff"])
def test_no_page_of_a_release_names_an_index_of_packages(name):
    text = (ROOT / name).read_text(encoding="utf-8").lower()
    assert [word for word in ("pypi", "conda-forge", "docker.io", "anaconda") if word in text] == []


def test_the_conda_recipe_asks_for_what_the_project_asks_for():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    recipe = (ROOT / "packaging" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    stated = set(re.findall(r"^    - ([\w-]+) >=([\w.]+)$", recipe.partition("  run:\n")[2], flags=re.MULTILINE))
    asked = {tuple(re.match(r"([\w-]+)>=([\w.]+)", each).groups()) for each in project["dependencies"]}
    names = {"matplotlib": "matplotlib-base"}  # matplotlib without windows
    assert stated - {("python", "3.11")} == {(names.get(name, name), version) for name, version in asked}
    assert f'version: "{phasemark.__version__}"' in recipe
