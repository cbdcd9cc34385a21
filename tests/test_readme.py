"""What the documentation prints can be typed: commands run, and make targets exist."""

import re
import subprocess
from pathlib import Path

import pytest
from readme_commands import RUN, Block, read_blocks, run_page, shell_commands

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = ROOT / "docs" / "notebooks"  # their cells share names: tests/test_site.py runs them
PAGES = sorted({*ROOT.glob("*.md"), *(ROOT / "docs").glob("**/*.md")} - {*NOTEBOOKS.glob("*.md")})


@pytest.mark.usefixtures("one_example_of_each_method")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_printed_command_runs(page: Path, tmp_path: Path) -> None:
    run = list(run_page(page, tmp_path))
    assert run or page.name != "README.md"  # a reader that finds no block would pass otherwise


def test_every_printed_make_target_exists() -> None:
    texts = [page.read_text(encoding="utf-8") for page in PAGES]
    printed = [block.text for text in texts for block in read_blocks(text)]
    printed += [code for text in texts for code in re.findall(r"`([^`\n]+)`", text)]
    targets = {target for code in printed for target in re.findall(r"^make ([\w-]+)", code, flags=re.MULTILINE)}
    assert {"test", "docs"} <= targets
    done = subprocess.run(["make", "-n", "-C", ROOT, *targets], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_console_block_yields_its_prompted_lines() -> None:
    (block,) = read_blocks("```console\n$ phasemark a \\\n    --b\noutput\n$ phasemark c\n```\n")
    assert [command.split() for command in shell_commands(block)] == [["phasemark", "a", "--b"], ["phasemark", "c"]]


def test_options_are_appended_to_the_named_command_alone() -> None:
    directive = "<!-- test: phasemark bank build += --delta 0:90:45 -->"
    (block,) = read_blocks(f"{directive}\n```bash\nphasemark bank build\nphasemark bank info\n```")
    assert shell_commands(block) == ["phasemark bank build --delta 0:90:45", "phasemark bank info"]


def test_options_are_appended_before_a_comment() -> None:
    (block,) = read_blocks("<!-- test: phasemark a += --b -->\n```bash\nphasemark a    # first\n```")
    assert shell_commands(block)[0].split() == ["phasemark", "a", "--b", "#", "first"]


def test_a_directive_belongs_to_the_next_block_alone() -> None:
    first, second = read_blocks("<!-- test: skip slow -->\n```bash\na\n```\n\n```bash\nb\n```")
    assert (first.skipped, second.skipped) == (True, False)


@pytest.mark.parametrize(("other", "runs"), [("a --b", True), ("a --c", False)])
def test_commands_said_to_run_elsewhere_do(tmp_path: Path, other: str, runs: bool) -> None:
    (tmp_path / "one.md").write_text(f"<!-- test: as in two.md -->\n```bash\n{RUN[0]} a --b   # words\n```\n")
    (tmp_path / "two.md").write_text(f"```bash\n{RUN[0]} {other}\n```\n")
    if runs:
        assert list(run_page(tmp_path / "one.md", tmp_path)) == []
    else:
        with pytest.raises(AssertionError, match=r"one\.md:2: .*\nis not run in two\.md"):
            list(run_page(tmp_path / "one.md", tmp_path))


@pytest.mark.parametrize(
    "text", ["<!-- test: skipp it -->\n```bash\na\n```", "<!-- test: skip x -->\ntext\n```bash\na\n```"]
)
def test_a_misspelt_or_misplaced_directive_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="directive"):
        read_blocks(text)


@pytest.mark.parametrize("language", ["bash", "python"])
def test_a_failing_block_fails_with_its_line(language: str, tmp_path: Path) -> None:
    text = {"bash": f"{RUN[0]} no-such-command", "python": "raise SystemExit(1)"}[language]
    (tmp_path / "page.md").write_text(f"text\n\n```{language}\n{text}\n```\n", encoding="utf-8")
    with pytest.raises(AssertionError, match=r"page\.md:3"):
        list(run_page(tmp_path / "page.md", tmp_path))


def test_what_a_command_prints_goes_where_it_says(tmp_path: Path) -> None:
    text = "```bash\nphasemark sensor show pmd-16x16 > a.toml  # words\nphasemark sensor list | wc -l > b.txt\n```\n"
    (tmp_path / "page.md").write_text(text, encoding="utf-8")
    assert len(list(run_page(tmp_path / "page.md", tmp_path))) == 2
    assert "modulation_hz" in (tmp_path / "a.toml").read_text(encoding="utf-8")
    assert int((tmp_path / "b.txt").read_text(encoding="utf-8")) > 3


def test_an_unknown_program_is_not_passed_over(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text("```bash\nphasemrk sensor list\n```\n", encoding="utf-8")
    with pytest.raises(AssertionError, match="no rule"):
        list(run_page(tmp_path / "page.md", tmp_path))


def test_the_block_keeps_its_given_files() -> None:
    assert Block(1, "bash", "", ("given a.csv", "given b.stl")).given == ["a.csv", "b.stl"]
