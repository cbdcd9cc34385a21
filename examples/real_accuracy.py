"""Measure the accuracy on copies of public recordings, and write it as one page beside the bars that should be held.

``python examples/real_accuracy.py --panel panel.csv --tmf8820 FOLDER --out out/real``

``--panel`` takes recordings before a panel, as ``examples/split_recording.py`` reads them, through the steps of
``docs/recordings.md``: the first calibrates on its first half and matches its second, and calibrates on the whole and
matches itself with ``--same-recording``; each other one is matched with the calibration of the whole first one and a
delay of its own. ``--tmf8820`` takes a folder for ``examples/direct_sensor.py --data``. Either may be left out.

Written are ``accuracy.html``, ``accuracy.json``, ``accuracy.csv`` and ``errors.png``; the first table is printed.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import direct_sensor
import numpy as np
import score_recording
import split_recording
import trimesh
from matplotlib.figure import Figure

from phasemark import PhasemarkError
from phasemark.cli import main as phasemark
from phasemark.data.files.csv_cell import csv_text
from phasemark.data.files.json_text import finite_or_none
from phasemark.data.files.provenance import versions
from phasemark.data.pages.page import embedded_png, figure_png, page_template
from phasemark.matcher.accuracy.pose_errors import PoseScore
from phasemark.render import Sensor
from phasemark.render.charts import explain, legend_above, panels, style

READ = ("--valid-status", "5", "--quantity", "z", "--moving")
PANEL_M, WIDE_M = (0.01, 0.61, 0.49), (0.01, 4.0, 4.0)
NEAR_MM = 1300.0
POSES = 16
PANEL_BARS = (
    ("truth inside the 95 % ellipse", "90–98 %"),
    ("MAD of the distance", "≤ 3 mm"),
    ("r.m.s. of the heading about its bias", "≤ 1°"),
    ("accepted beyond 30 mm or 6°", "0"),
    ("answered, of frames that face the panel within 1.3 m", "≥ 60 %"),
    ("median σ of the distance", "≤ 6 mm"),
    ("median σ of the heading", "≤ 1.2°"),
)
Bar = tuple[str, str, str, str, bool]
"""Recording, quantity, bar, number found, and whether it holds the bar."""


@dataclass(frozen=True)
class Run:
    """A recording that was matched: its name, the delay with its standard deviation (ms), and what was compared."""

    name: str
    delay_ms: tuple[float, float]
    compared: score_recording.Compared

    @property
    def score(self) -> PoseScore:
        """The score of the frames that face the panel."""
        return self.compared.score

    def bars(self) -> list[Bar]:
        """Return each bar with what was found."""
        score, (answered, near) = self.score, self.compared.answered(NEAR_MM)
        share = answered / near if near else math.nan
        found = (
            (_with_interval(score), 0.9 <= score.inside.value <= 0.98),
            (f"{score.mad[0]:.2f} mm", score.mad[0] <= 3),
            (f"{score.rms[1]:.2f}°", score.rms[1] <= 1),
            (f"{score.gross}", score.gross == 0),
            (f"{100 * share:.0f} %, {answered} of {near}", share >= 0.6),
            (f"{score.std[0]:.2f} mm", score.std[0] <= 6),
            (f"{score.std[1]:.2f}°", score.std[1] <= 1.2),
        )
        return [(self.name, *bar, *one) for bar, one in zip(PANEL_BARS, found, strict=True)]


class StepError(Exception):
    """A command failed; its message is the command's own."""


def run(*arguments: object, program: Callable[[list[str]], int] = phasemark) -> None:
    """Run a command of phasemark, or another program, quietly."""
    error = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(error):
        code = program([str(one) for one in arguments])
    if code:
        lines = error.getvalue().splitlines() or [f"error: exit code {code}"]
        raise StepError(next((line for line in lines if line.startswith("error: ")), lines[-1]))


@dataclass(frozen=True)
class Panel:
    """The steps of docs/recordings.md in a folder."""

    folder: Path
    distance: str
    delta: str

    def split(self, path: Path) -> Path:
        """Split a recording; return the folder of its tables."""
        out = self.folder / path.stem
        run(path, "--out", out, program=split_recording.main)
        return out

    def banks(self, name: str, size: Sequence[float], *options: object) -> Path:
        """Build the bank of a box."""
        trimesh.creation.box(size).export(self.folder / f"{name}.stl")
        bank, mesh = self.folder / f"{name}.h5", f"{name}={self.folder / f'{name}.stl'}"
        run("bank", "build", "--mesh", mesh, "--unit", "m", "--origin", "center", *options, "--out", bank, "--force")
        return bank

    def calibrated(self, part: Path, sensor: Path, *options: object) -> tuple[float, float]:
        """Calibrate on a part of a recording; return its delay and standard deviation, ms."""
        run(
            "calibrate", self.folder / "panel.h5", f"{part}.csv", *READ, "--poses", f"{part}_poses.csv",
            "--landmark-xy", 0.005, 0, *options, "--out", sensor, "--force",
        )  # fmt: skip
        found = Sensor.from_toml(sensor)
        k = found.calibration_fields.index("delay_s")
        return 1e3 * found.delay_s, 1e3 * math.sqrt(found.calibration_matrix[k, k])

    def matched(self, bank: Path, part: Path, *options: object) -> score_recording.Compared:
        """Match a part of a recording, and compare it with its poses."""
        estimates = self.folder / f"{bank.stem}_{part.parent.name}_{part.name}.csv"
        run(
            "match", bank, f"{part}.csv", *READ, "--fix", "bearing", "--unknown-background", "--no-diagnosis", *options,
            "--estimates", estimates, "--force",
        )  # fmt: skip
        read = score_recording.columns
        return score_recording.compared(read(estimates), read(Path(f"{part}_poses.csv")))

    def runs(self, paths: Sequence[Path]) -> Iterator[Run]:
        """Match halves, the whole, and other recordings."""
        first, *others = map(self.split, paths)
        self.banks("panel", PANEL_M, "--sensor", "vl53l5cx-8x8", "--distance", "0.4:1.2:0.02", "--delta", "0:180:4")
        grid = ("--symmetry", 2, "--distance", self.distance, f"--delta={self.delta}")
        for part, matched, name, options in (
            ("first", "second", f"{first.name}: second half, calibrated on the first", ()),
            ("whole", "whole", f"{first.name}: whole, calibrated on itself, --same-recording", ("--same-recording",)),
        ):
            sensor = self.folder / f"{part}.toml"
            delay_ms = self.calibrated(first / part, sensor, "--fix", "height")
            bank = self.banks(f"wide_{part}", WIDE_M, "--sensor", sensor, *grid)
            yield Run(name, delay_ms, self.matched(bank, first / matched, *options))
        for other in others:
            own = ("--sensor", sensor, "--free", "delay")
            delay_ms = self.calibrated(other / "whole", self.folder / f"{other.name}.toml", *own)
            compared = self.matched(bank, other / "whole", "--delay-ms", delay_ms[0])
            yield Run(f"{other.name}: whole, calibrated on {first.name}", delay_ms, compared)


def _with_interval(score: PoseScore) -> str:
    inside = score.inside
    return f"{100 * inside.value:.0f} % [{100 * inside.low:.0f}, {100 * inside.high:.0f}]"


def measured(runs: Sequence[Run]) -> list[list[str]]:
    """Return the table of what was found, a column for each recording."""

    def four(score: PoseScore, k: int, digits: int) -> str:
        numbers = (score.bias[k], score.mad[k], score.rms[k], score.std[k])
        return ", ".join(f"{value:.{digits}f}".replace("-", "−") for value in numbers)

    rows = {
        "delay (ms)": [f"{one.delay_ms[0]:.0f} ± {one.delay_ms[1]:.0f}".replace("-", "−") for one in runs],
        "distance (mm): bias, MAD, r.m.s. about its bias, median σ": [four(one.score, 0, 1) for one in runs],
        "heading (°): bias, MAD, r.m.s. about its bias, median σ": [four(one.score, 1, 2) for one in runs],
        "truth inside the 95 % ellipse [interval of 95 %]": [_with_interval(one.score) for one in runs],
        "answered, of frames that face the panel": [f"{one.score.answered} of {one.score.expected}" for one in runs],
        "accepted beyond 30 mm or 6°": [
            f"{one.score.gross} of {one.score.accepted}: at most {100 * one.score.gross_at_most:.1f} % at 95 %"
            for one in runs
        ],
        "longest run without one, reliability that it shows at 95 %": [
            f"{one.score.run}, {100 * one.score.reliability:.1f} %" for one in runs
        ],
    }
    return [[title, *cells] for title, cells in rows.items()]


def located(data: Path, draws: int, out: Path) -> dict[str, list[dict[str, float]]]:
    """Return the table of each object whose histograms lie in a folder, by the example that locates them."""
    with contextlib.redirect_stdout(io.StringIO()):
        direct_sensor.main(["--data", str(data), "--draws", str(draws), "--out", str(out)])
    found = json.loads((out / "direct_sensor.json").read_text(encoding="utf-8"))
    return dict(found["poses"])


def histogram_bars(objects: dict[str, list[dict[str, float]]]) -> list[Bar]:
    """Return each bar of the histograms with what was found."""
    found: list[Bar] = []
    for name, table in objects.items():
        for row in table:
            if (k := int(row["poses"])) > 1:
                inside = row["inside_95"]
                what = f"{k} poses: truth inside the 95 % ellipsoid"
                found.append((name, what, "88–98 %", f"{100 * inside:.0f} %", 0.88 <= inside <= 0.98))
            if k == POSES:
                mm, deg = row["median_mm"], row["median_deg"]
                found.append((name, f"{k} poses: median error of the position", "≤ 2 mm", f"{mm:.2f} mm", mm <= 2))
                found.append((name, f"{k} poses: median error of the rotation", "≤ 0.9°", f"{deg:.2f}°", deg <= 0.9))
    return found


def errors_figure(runs: Sequence[Run]) -> Figure:
    """Draw errors of accepted frames that face the panel against the stated σ, with lines at 2 σ."""
    figure, (row,) = panels(2)
    for i, (panel, what) in enumerate(zip(row, ("distance (mm)", "heading (°)"), strict=True)):
        widest = 0.0
        for k, one in enumerate(runs):
            compared = one.compared
            used = compared.accepted & compared.faces
            std = np.sqrt(compared.covariance[used, i, i])
            widest = max(widest, 1.05 * float(std.max()))
            colour, mark, _ = style(k)
            look = {"color": colour, "marker": mark, "linestyle": "none", "markersize": 3, "alpha": 0.6}
            panel.plot(std, compared.error[used, i], label=one.name, **look)
        for sign in (-2, 2):
            panel.plot([0, widest], [0, sign * widest], color="black", linewidth=0.8, label="2 σ" if sign > 0 else None)
        panel.axhline(0, color="black", linewidth=0.4)
        panel.set_xlim(0, widest)
        explain(panel, f"stated σ of the {what}", f"error of the {what}")
    legend_above(figure, row[0])
    return figure


def page(runs: Sequence[Run], objects: dict[str, list[dict[str, float]]], bars: Sequence[Bar], command: str) -> str:
    """Return the page."""
    held = sum(bar[-1] for bar in bars)
    header = ("recording", "quantity", "bar", "found", "")
    tables = [
        {
            "title": "Bars",
            "header": header,
            "rows": [(*bar[:-1], "held" if bar[-1] else "NOT held") for bar in bars],
            "text": "A bar is held where the number found is within it, whatever its interval. Medians of σ are stated"
            " standard deviations of accepted answers.",
        }
    ]
    if runs:
        caption = "Errors of accepted frames that face the panel; 95 % should lie between the lines in each panel."
        tables.append({
            "title": "A zone sensor before a panel",
            "header": ("", *(one.name for one in runs)),
            "rows": measured(runs),
            "text": "Frames face the panel within 45° of its normal. The interval of the share inside counts frames as"
            " if they were independent. None of n leaves at most about 3/n at 95 %; a run of n shows a reliability R"
            " with confidence C by n = ln(1 − C)/ln R (ASTM F3499-21).",
            "figure": embedded_png(figure_png(errors_figure(runs)), "errors against stated standard deviations"),
            "caption": caption,
        })  # fmt: skip
    if objects:
        names = ("poses", "median_mm", "p90_mm", "median_deg", "p90_deg", "predicted_mm", "inside_95")
        tables.append({
            "title": "Histograms of objects from several poses",
            "header": ("object", *(name.replace("_", " ") for name in names)),
            "rows": [(one, *(f"{row[name]:.3g}" for name in names)) for one, table in objects.items() for row in table],
            "text": "Poses are not among those of the fit. Each number is over random draws of them; p90 is not"
            " exceeded by 90 % of the draws, and predicted is the median of the stated width.",
        })  # fmt: skip
    missed = "; ".join(f"{name}: {quantity} {found} ({bar})" for name, quantity, bar, found, fine in bars if not fine)
    return page_template("phasemark.data.pages", "recordings.html.j2").render(
        answer=f"{held} of {len(bars)} bars are held." + (f" Not held: {missed}." if missed else ""),
        contents=[*(table["title"] for table in tables), "How it was made", "Make this page again"],
        tables=tables,
        facts={"versions": ", ".join(f"{package} {version}" for package, version in versions().items())},
        commands=[command],
    )


def write(folder: Path, runs: Sequence[Run], objects: dict[str, list[dict[str, float]]], command: str) -> None:
    """Write page, figure and numbers."""
    bars = [*(bar for one in runs for bar in one.bars()), *histogram_bars(objects)]
    panel = {one.name: {"delay_ms": one.delay_ms, **one.score.as_dict()} for one in runs}
    keys = ("recording", "quantity", "bar", "found", "held")
    numbers = {"panel": panel, "histograms": objects, "bars": [dict(zip(keys, bar, strict=True)) for bar in bars]}
    text = json.dumps(finite_or_none(numbers), indent=1, ensure_ascii=False)
    (folder / "accuracy.json").write_text(text, encoding="utf-8")
    lines = [(*bar[:-1], "true" if bar[-1] else "false") for bar in bars]
    (folder / "accuracy.csv").write_text(csv_text([keys, *lines]), encoding="utf-8")
    (folder / "accuracy.html").write_text(page(runs, objects, bars, command), encoding="utf-8")
    if runs:
        (folder / "errors.png").write_bytes(figure_png(errors_figure(runs)))
    print()
    for bar in bars:
        print(f"{'held' if bar[-1] else 'NOT held'}: {bar[0]}: {bar[1]}: {bar[3]} ({bar[2]})")


def main(argv: list[str] | None = None) -> int:
    """Run what the recordings allow."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--panel", type=Path, nargs="+", default=[], metavar="CSV", help="recordings before a panel")
    parser.add_argument("--tmf8820", type=Path, metavar="FOLDER", help="logs of histograms of a plane and of objects")
    parser.add_argument("--draws", type=int, default=200, help="random draws of poses of histograms")
    parser.add_argument("--distance", default="0.4:1.2:0.01", help="distances of the panel's bank, metres")
    parser.add_argument("--delta", default="-60:60:1", help="headings of the panel's bank, degrees")
    parser.add_argument("--out", type=Path, default=Path("out/real"), help="folder of page and numbers")
    options = parser.parse_args(argv)
    if not options.panel and options.tmf8820 is None:
        parser.error("nothing to measure: give --panel CSV, --tmf8820 FOLDER or both")
    command = shlex.join(["python", "examples/real_accuracy.py", *(sys.argv[1:] if argv is None else argv)])
    objects: dict[str, list[dict[str, float]]] = {}
    try:
        for path in (*options.panel, *([] if options.tmf8820 is None else [options.tmf8820 / "ladder.npz"])):
            if not path.is_file():
                raise StepError(f"error: {path}: no such file")
        runs = []
        if options.panel:
            (options.out / "panel").mkdir(parents=True, exist_ok=True)
            runs = list(Panel(options.out / "panel", options.distance, options.delta).runs(options.panel))
            table = measured(runs)
            rows = [["", *(one.name for one in runs)], ["---"] * (1 + len(runs)), *table]
            print(*(f"| {' | '.join(row)} |" for row in rows), sep="\n")
        if options.tmf8820 is not None:
            objects = located(options.tmf8820, options.draws, options.out / "tmf8820")
        options.out.mkdir(parents=True, exist_ok=True)
        write(options.out, runs, objects, command)
    except StepError as error:
        print(error, file=sys.stderr)
        return 3
    except (PhasemarkError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    print(options.out / "accuracy.html")
    return 0


if __name__ == "__main__":
    sys.exit(main())
