"""Read the fenced blocks of a Markdown page and run them as printed, in order, in one folder.

A process of its own takes three seconds to load the program. So commands and Python blocks run in this process, with
what they print redirected where ``>`` says; a command that asks the shell for more is given to a shell.

HTML comments directly above a block change how it is run:

``<!-- test: given FILE -->``
    make an input file that the reader would bring; :data:`GIVEN` knows how.
``<!-- test: phasemark CMD += OPTIONS -->``
    append options to that command: a later option overrides an earlier one, so a grid becomes small.
``<!-- test: as in PAGE -->``
    do not run the block, whose commands a block that is run on that page of the same folder or above prints too.
``<!-- test: prints -->``
    the text below the commands of a console block is their output.
``<!-- test: skip REASON -->``
    do not run the block.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from phasemark.cli import main

RUN = ("phasemark", "sha256sum")
SET_UP = (".", "cd", "git", "make", "pip", "python", "python3")
_SHELL_LANGUAGES = ("bash", "console", "sh")

_DIRECTIVE = re.compile(r"<!-- test: (.*) -->")
_FENCE = re.compile(r"```(\w*)")


@dataclass(frozen=True)
class Block:
    """One fenced block and what the comments above it ask for."""

    line: int
    language: str
    text: str
    directives: tuple[str, ...]

    @property
    def skipped(self) -> bool:
        return any(directive.startswith("skip ") for directive in self.directives)

    @property
    def twin(self) -> str | None:
        """The page that runs the same commands."""
        pages = [directive.removeprefix("as in ") for directive in self.directives if directive.startswith("as in ")]
        return pages[0] if pages else None

    @property
    def given(self) -> list[str]:
        return [directive.removeprefix("given ") for directive in self.directives if directive.startswith("given ")]

    @property
    def appended(self) -> list[tuple[list[str], str]]:
        pairs = [directive.split(" += ", 1) for directive in self.directives if " += " in directive]
        return [(command.split(), options) for command, options in pairs]


def read_blocks(markdown: str) -> list[Block]:
    """Return the fenced blocks of a page; the line is that of the opening fence."""
    blocks: list[Block] = []
    directives: list[str] = []
    body: list[str] | None = None
    opened, language = 0, ""
    for number, line in enumerate(markdown.splitlines(), start=1):
        fence, directive = _FENCE.fullmatch(line), _DIRECTIVE.fullmatch(line)
        if body is not None:
            if line == "```":
                blocks.append(Block(opened, language, "\n".join(body), tuple(directives)))
                body, directives = None, []
            else:
                body.append(line)
        elif fence:
            body, opened, language = [], number, fence[1]
        elif directive:
            begun = directive[1].startswith(("given ", "skip ", "as in "))
            known = begun or directive[1] == "prints" or " += " in directive[1]
            if not known:
                raise ValueError(f"line {number}: unknown directive '{directive[1]}'")
            directives.append(directive[1])
        elif line and directives:
            raise ValueError(f"line {number}: a directive stands directly above its block")
    return blocks


def shell_commands(block: Block) -> list[str]:
    """Return the commands of a shell block; in a console block those are the lines after ``$``."""
    text = block.text.replace("\\\n", " ")
    lines = [line.strip() for line in text.splitlines()]
    if block.language == "console":
        lines = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
    commands = [line for line in lines if line and not line.startswith("#")]
    return [_append(command, block.appended) for command in commands]


def _append(command: str, appended: list[tuple[list[str], str]]) -> str:
    words = shlex.split(command, comments=True)
    for prefix, options in appended:
        if words[: len(prefix)] == prefix:
            typed, gap, comment = command.partition("  # ")
            command = f"{typed} {options}{gap}{comment}"
    return command


def run_page(page: Path, folder: Path) -> Iterator[str]:
    """Run every block of a page in `folder`; yield what was run, and raise AssertionError where something fails."""
    for block in read_blocks(page.read_text(encoding="utf-8")):
        if block.skipped:
            continue
        if block.twin:
            _check_twin(block, page)
            continue
        _give(block, folder)
        if block.language == "python":
            _run_here(lambda text=block.text: _execute(text), folder, f"{page.name}:{block.line}", warn="error")
            yield block.text
        elif block.language in _SHELL_LANGUAGES:
            for command in shell_commands(block):
                program = shlex.split(command, comments=True)[0]
                if program in RUN:
                    _run_command(command, folder, f"{page.name}:{block.line}: {command}")
                    yield command
                elif program not in SET_UP:
                    raise AssertionError(f"{page.name}:{block.line}: no rule for '{command}'")


def printed_and_expected(page: Path, folder: Path) -> Iterator[tuple[str, str, str]]:
    """Run the commands of blocks marked ``prints``; yield each, what it printed, and what the page says it prints."""
    for block in read_blocks(page.read_text(encoding="utf-8")):
        if "prints" not in block.directives:
            continue
        _give(block, folder)
        for part in re.split(r"^\$ ", block.text.replace("\\\n", " "), flags=re.MULTILINE)[1:]:
            command, _, expected = part.partition("\n")
            printed = io.StringIO()
            words = shlex.split(command)
            assert words[0] == "phasemark", command
            with contextlib.chdir(folder), contextlib.redirect_stdout(printed):
                assert main(words[1:]) == 0, command
            yield command, printed.getvalue().rstrip(), expected.rstrip()


def _give(block: Block, folder: Path) -> None:
    """Write the files that a block is given, unless they are there."""
    for name in block.given:
        if not (folder / name).exists():
            (folder / name).parent.mkdir(exist_ok=True)
            GIVEN[name](folder / name)


def _check_twin(block: Block, page: Path) -> None:
    twins = [
        other
        for other in read_blocks((page.parent / block.twin).read_text(encoding="utf-8"))
        if not (other.skipped or other.twin)
    ]
    printed = [command for twin in twins for command in shell_commands(replace(twin, directives=()))]
    run = [shlex.split(command, comments=True) for command in printed]
    for command in shell_commands(block):
        what = f"{page.name}:{block.line}: {command}"
        assert shlex.split(command, comments=True) in run, f"{what}\nis not run in {block.twin}"


def _run_command(command: str, folder: Path, what: str) -> None:
    lexer = shlex.shlex(command, posix=True, punctuation_chars=True)
    lexer.whitespace_split = True
    words = list(lexer)
    printed_to = None
    if words[-2:-1] == [">"]:
        *words, _, printed_to = words
    if words[0] == "phasemark" and not any(set(word) & set("|&;<>()$`*?~") for word in words):
        _run_here(lambda: main(words[1:]), folder, what, printed_to=printed_to)
    else:
        _run_in_shell(command, folder, what)


def _run_here(
    function: Callable[[], int | None], folder: Path, what: str, *, warn: str = "default", printed_to: str | None = None
) -> None:
    """Call what a process of its own would run; the folder is the current one, and modules are looked for in it."""
    path, modules = list(sys.path), set(sys.modules)
    printed = io.StringIO()
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.chdir(folder))
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter(warn)  # type: ignore[arg-type]
        stack.enter_context(contextlib.redirect_stderr(printed))
        out = stack.enter_context(open(printed_to, "w", encoding="utf-8")) if printed_to else printed
        stack.enter_context(contextlib.redirect_stdout(out))
        code: object
        try:
            code = function()
        except SystemExit as end:
            code = end.code
        except Exception:
            code = 1
            traceback.print_exc()
        finally:
            sys.path[:] = path
            for name in set(sys.modules) - modules:
                if str(getattr(sys.modules[name], "__file__", None)).startswith(str(folder)):
                    del sys.modules[name]  # another page may have another module of the name
    assert not code, f"{what}\nexit code {code}\n{printed.getvalue()}"


def _execute(text: str) -> None:
    sys.path.insert(0, "")
    exec(compile(text, "<block>", "exec"), {"__name__": "__main__"})


def _run_in_shell(command: str, folder: Path, what: str) -> None:
    bin_folder = str(Path(sys.executable).parent)
    environment = {**os.environ, "PATH": os.pathsep.join([bin_folder, os.environ["PATH"]])}
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", command],
        cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, f"{what}\nexit code {done.returncode}\n{done.stdout}{done.stderr}"


def _write_part(path: Path) -> None:
    """Write a CAD part: a block of 120 × 80 × 60 mm."""
    import trimesh

    trimesh.creation.box(extents=(120, 80, 60)).export(path)


def _write_measured(path: Path) -> None:
    """Write 50 frames of the cylinder at 1 m from 30°, before nothing."""
    import numpy as np

    from phasemark.landmarks import build_mesh, catalog
    from phasemark.render import Renderer, capture, preset

    sensor = preset("pmd-16x16")
    image = Renderer(build_mesh(catalog()["cylinder"]), sensor, albedo=0.8).render(distance_m=1.0, delta_rad=np.pi / 6)
    frames = capture(image, sensor, rng=np.random.default_rng(1), n_frames=50)
    np.savetxt(path, frames.range_m.reshape(50, -1), delimiter=",", fmt="%.6f")


def _write_board(path: Path) -> None:
    """Write 50 frames of a flat board; its distance stands in the file's name."""
    import numpy as np

    from phasemark.render import Background, Renderer, capture, preset

    sensor, distance_m = preset("pmd-16x16"), float(path.stem.removeprefix("board_").removesuffix("m"))
    board = Renderer(None, sensor).render(0.5, background=Background(wall_m=distance_m, wall_albedo=0.8))
    frames = capture(board, sensor, rng=np.random.default_rng(1), n_frames=50)
    arrays: dict[str, Any] = {"range": frames.range_m, "amplitude": frames.amplitude_e, "intensity": frames.intensity_e}
    np.savez(path, **arrays, unit="m", quantity="range")


_WORKSHOP_POSES = [(0.8 + 0.2 * (k % 4), 40.0 * k, 4.0 * (k % 3 - 1)) for k in range(8)]


def _write_poses(path: Path) -> None:
    """Write where a camera stood before a cylinder on a workshop's floor: distance, side, bearing."""
    lines = [f"{distance:.3f},{delta:.1f},{bearing:.1f}" for distance, delta, bearing in _WORKSHOP_POSES]
    path.write_text("\n".join(["distance_m,delta_deg,bearing_deg", *lines, ""]), encoding="utf-8")


def _write_workshop(path: Path) -> None:
    """Write 20 frames from each of those poses, of a camera that looks 1° down, in a row: 160 frames."""
    import numpy as np

    from phasemark.landmarks import build_mesh, catalog
    from phasemark.render import Renderer, capture, preset

    distance, delta, bearing = np.array(_WORKSHOP_POSES).T
    sensor = preset("pmd-16x16").with_(pitch_deg=1.0, range_offset_m=0.01)
    image = Renderer(build_mesh(catalog()["cylinder"]), sensor).render(distance, np.radians(delta), np.radians(bearing))
    frames = capture(image, sensor, rng=np.random.default_rng(1), n_frames=20)
    ranges = np.where(frames.valid, frames.range_m, np.nan).reshape(1, -1, 16, 16)
    amplitude, intensity = (values.reshape(ranges.shape) for values in (frames.amplitude_e, frames.intensity_e))
    np.savez(path, range=ranges, amplitude=amplitude, intensity=intensity, unit="m", quantity="range")


def _write_large_sensor(path: Path) -> None:
    """Write a phase camera of many pixels."""
    fields = {"rows": 171, "cols": 224, "half_angle_h_deg": 31.0, "half_angle_v_deg": 22.5, "max_phase_std_rad": 0.2}
    path.write_text("".join(f"{name} = {value}\n" for name, value in fields.items()), encoding="utf-8")


def _write_zones(path: Path) -> None:
    """Write the plan of a frame set of a direct sensor."""
    path.write_text(
        """classes = ["cylinder", "cone"]
sensor = "vl53l5cx-8x8"
views = 100
frames_per_view = 2
distance_m = { uniform = [0.6, 1.2] }
wall_m = 1.8
floor_m = 0.5
""",
        encoding="utf-8",
    )


def _copy_example(path: Path) -> None:
    """Copy a file of the examples of that name."""
    path.write_bytes((Path(__file__).parent.parent / "examples" / path.name).read_bytes())


def _write_camera_info(path: Path) -> None:
    """Write what ROS's calibration writes of a camera."""
    path.write_text(
        "image_width: 224\nimage_height: 171\ncamera_name: own\n"
        "camera_matrix: {rows: 3, cols: 3, data: [211.5, 0, 111.2, 0, 211.8, 86.1, 0, 0, 1]}\n"
        "distortion_model: plumb_bob\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [-0.28, 0.11, 0.001, -0.0005, 0]}\n"
    )


def _copy_block(path: Path) -> None:
    """Write the block of docs/formats.md of the file's language that names its stem."""
    language = {".py": "python", ".toml": "toml"}[path.suffix]
    page = (Path(__file__).parent.parent / "docs" / "formats.md").read_text(encoding="utf-8")
    (text,) = [b.text for b in read_blocks(page) if b.language == language and path.stem in b.text]
    path.write_text(text, encoding="utf-8")


GIVEN: dict[str, Callable[[Path], None]] = {
    "balls.py": _copy_block,
    "balls.toml": _copy_block,
    "board_1m.npz": _write_board,
    "board_2m.npz": _write_board,
    "board_3m.npz": _write_board,
    "camera_info.yaml": _write_camera_info,
    "examples/simulated_cone.csv": _copy_example,
    "large.toml": _write_large_sensor,
    "measured.csv": _write_measured,
    "my_part.stl": _write_part,
    "own_matcher.py": _copy_example,
    "own_matcher.toml": _copy_example,
    "poses.csv": _write_poses,
    "workshop.npz": _write_workshop,
    "zones.toml": _write_zones,
}
