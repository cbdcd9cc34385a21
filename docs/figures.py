"""Draw the figures of the documentation into docs/images: ``make figures``, or ``python docs/figures.py --runs``.

Some show what a run of a minute or more has left in out/. Without ``--runs``, where that is not there they stay as they
are, and the command is named.

docs/images/drawn.json records from which sources each figure was drawn, so that a test notices a figure that is older
than its plan or the code that draws it. ``--accept`` records all figures as they are, after somebody has looked at
them.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import hashlib
import io
import json
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imread

from phasemark.data.files import write_atomically
from phasemark.data.seeds import stream
from phasemark.landmarks import build_mesh, catalog, mesh_figure
from phasemark.matcher import kalman_filter
from phasemark.matcher.drive import default_drive, drive_figure, run_drive
from phasemark.matcher.locate import Locator, smoothed
from phasemark.matcher.locate.figures import locate_figure
from phasemark.render import Background, Renderer, SceneRenderer, capture, preset
from phasemark.render.figures import draw_range, landmark_limits_m

IMAGES = Path(__file__).parent / "images"
ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "out"
PHASEMARK = (sys.executable, "-c", "import sys; from phasemark.cli import main; sys.exit(main())")
LEFT_BY = {
    "phasemark sweep run paper --out out/paper": {
        "accuracy-distance.png": "paper/figures/rmse-distance-m.png",
        "accuracy-position.png": "paper/figures/position-in-cell.png",
    },
    "phasemark sweep run distance-angle-noise --out out/dan": {
        "accuracy-noise.png": "dan/figures/rmse-noise-factor.png",
        "accuracy-frames.png": "dan/figures/rmse-n-frames.png",
        "accuracy-map.png": "dan/figures/map-ratio.png",
        "accuracy-risk.png": "dan/figures/risk.png",
    },
    "phasemark sweep run robustness --out out/robustness": {
        "accuracy-bearing.png": "robustness/figures/rmse-bearing-deg.png",
        "accuracy-models.png": "robustness/figures/models.png",
    },
    "phasemark sweep run multipath --out out/multipath": {
        "accuracy-bounces.png": "multipath/figures/rmse-bounces.png",
    },
    "phasemark landmark design --out out/design": {
        "design-bound.png": "design/bound.png",
        "design-pareto.png": "design/pareto.png",
    },
}
"""Pictures that are those of a run, by its command."""
_SWEEP = ("matcher/sweep/figures", "render/charts.py")
SOURCES = {
    "accuracy-bearing.png": ("matcher/sweep/plans/robustness.toml", *_SWEEP),
    "accuracy-bounces.png": ("matcher/sweep/plans/multipath.toml", *_SWEEP),
    "accuracy-distance.png": ("matcher/sweep/plans/paper.toml", *_SWEEP),
    "accuracy-frames.png": ("matcher/sweep/plans/distance-angle-noise.toml", *_SWEEP),
    "accuracy-map.png": ("matcher/sweep/plans/distance-angle-noise.toml", *_SWEEP),
    "accuracy-models.png": ("matcher/sweep/plans/robustness.toml", *_SWEEP),
    "accuracy-noise.png": ("matcher/sweep/plans/distance-angle-noise.toml", *_SWEEP),
    "accuracy-position.png": ("matcher/sweep/plans/paper.toml", *_SWEEP),
    "accuracy-risk.png": ("matcher/sweep/plans/distance-angle-noise.toml", *_SWEEP),
    "cost.png": ("docs/figures.py",),
    "demo.png": ("docs/figures.py", "landmarks/catalog.py", "landmarks/figures.py", "render/figures.py"),
    "design-bound.png": ("matcher/design/plan.toml", "matcher/design/figures.py", "render/charts.py"),
    "design-pareto.png": ("matcher/design/plan.toml", "matcher/design/figures.py", "render/charts.py"),
    "direct_error.png": ("examples/direct_sensor.py",),
    "direct_histograms.png": ("examples/direct_sensor.py",),
    "locate.png": ("docs/figures.py", "docs/locate.md", "matcher/locate/figures.py", "render/charts.py"),
    "live_docking.png": ("examples/live_docking.py",),
    "multipath.png": ("docs/figures.py", "docs/multipath.md", "render/figures.py"),
    "scenes.png": ("docs/figures.py", "docs/scenes.md", "render/figures.py"),
    "drive.png": ("matcher/drive/plan.toml", "matcher/drive/figures.py", "render/charts.py"),
}
"""What decides how a figure looks, beside the physics: plans, and the code that draws."""
RECORD = IMAGES / "drawn.json"


def _content(path: Path) -> bytes:
    """Return what counts of a source: of Python the code, without comments and docstrings."""
    if path.suffix != ".py":
        return path.read_bytes()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [  # type: ignore[attr-defined]
                each for each in body if not (isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant))
            ]
    return ast.unparse(tree).encode()


def drawn_from(name: str) -> str:
    """Return the digest of a figure's sources.

    Parameters
    ----------
    name : str
        A file of docs/images.

    Returns
    -------
    str
    """
    digest = hashlib.sha256()
    for source in SOURCES[name]:
        path = ROOT / source
        for file in sorted(path.glob("*.py")) if path.is_dir() else (path,):
            digest.update(_content(file))
    return digest.hexdigest()


def record(names: Sequence[str]) -> None:
    """Record that figures were drawn from their sources as they are now."""
    known = json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.exists() else {}
    known |= {name: drawn_from(name) for name in names}
    write_atomically(RECORD, json.dumps(known, indent=2, sort_keys=True).encode() + b"\n", force=True)


def demo_figure() -> Figure:
    """Draw the four landmarks above what the camera sees of them: 1 m away, 30° turned, a wall at 3 m, 50 frames."""
    sensor = preset("pmd-16x16")
    figure = Figure(figsize=(12.6, 6.0), layout="constrained")
    above, below = figure.subplots(2, 4, height_ratios=(1.15, 1))
    shown = []
    for k, (name, spec) in enumerate(catalog().items()):
        mesh = build_mesh(spec)
        above[k].imshow(imread(io.BytesIO(mesh_figure(mesh))))
        above[k].set_axis_off()
        above[k].set_title(name)
        image = Renderer(mesh, sensor, albedo=spec.albedo).render(
            1.0, np.radians(30), background=Background(wall_m=3.0)
        )
        frames = capture(image, sensor, rng=stream(2005, "documentation", k), n_frames=50)
        shown.append((kalman_filter(frames).range_m[0], landmark_limits_m(image.range_m[0], image.coverage[0])))
    near, far = (np.array([limits for _, limits in shown])[:, end] for end in (0, 1))
    for k, (range_m, _) in enumerate(shown):
        draw_range(below[k], range_m, near_m=near.min(), far_m=far.max(), colour_bar=k == 3)
    return figure


def cost_figure(rows: list[dict[str, Any]]) -> Figure:
    """Draw the error of a frame against the time it takes, for each method, on each frame measured."""
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    frames = sorted({row["frame"] for row in rows})
    for k, (axes, frame) in enumerate(
        zip(figure.subplots(1, len(frames), sharey=True, squeeze=False)[0], frames, strict=True)
    ):
        for method, style in (("grid", "s:"), ("jitter", "o--"), ("phasemark", "*")):
            points = [row for row in rows if row["frame"] == frame and row["method"].startswith(method)]
            measured = [row for row in points if "extrapolated" not in row["method"]]
            (line,) = axes.loglog(
                [row["seconds/frame"] for row in measured],
                [row["ε"] for row in measured],
                style,
                markersize=11 if method == "phasemark" else 5,
                label={"grid": "point grid (Open3D)", "jitter": "jittered (Open3D)"}.get(method, method),
            )
            for row in measured if method != "phasemark" else ():
                axes.annotate(
                    row["rays a pixel"], (row["seconds/frame"], row["ε"]), (3, 4), textcoords="offset points", size=7
                )
            for row in points:
                if "extrapolated" in row["method"]:
                    last = measured[-1]
                    axes.loglog(
                        [last["seconds/frame"], row["seconds/frame"]], [last["ε"], row["ε"]],
                        "--", color=line.get_color(), alpha=0.4,
                    )  # fmt: skip
                    axes.loglog(row["seconds/frame"], row["ε"], "o", color=line.get_color(), fillstyle="none")
        axes.axhline(1e-4, color="0.6", lw=0.8)
        axes.set_title(f"reference frame {frame}", size=10)
        axes.set_xlabel("time of a frame (s), two threads")
        if k == 0:
            axes.set_ylabel("ε: largest error / brightest pixel")
            axes.legend(frameon=False, fontsize=8)
        axes.grid(alpha=0.3)
    return figure


def names_of_page(page: str) -> dict[str, Any]:
    """Run the first example of a page, and return its names."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]
    names: dict[str, Any] = {}
    exec(text, names)
    return names


def multipath_figure() -> Figure:
    """Draw range, and what light that bounces adds to it, of both scenes of the page on multipath."""
    names = names_of_page("multipath.md")
    sensor = names["sensor"].with_(rows=48, cols=48)
    figure = Figure(figsize=(13.0, 3.2), layout="constrained")
    axes = figure.subplots(1, 4)
    for k, name in enumerate(("box", "corner")):
        images = [SceneRenderer(names[name], sensor, bounces=n).phasors(np.eye(4)) for n in (0, "all")]
        direct_m, all_m = (image.range_m[0] for image in images)
        draw_range(axes[2 * k], direct_m, near_m=float(np.nanmin(direct_m)), far_m=float(np.nanmax(direct_m)))
        axes[2 * k].set_title(f"{name}: range")
        farther = axes[2 * k + 1].imshow(1e3 * (all_m - direct_m), cmap="viridis", vmin=0, vmax=(30, 100)[k])
        figure.colorbar(farther, ax=axes[2 * k + 1], label="mm farther", extend="max")
        axes[2 * k + 1].set_title("all bounces less direct light")
        axes[2 * k + 1].set_xticks([])
        axes[2 * k + 1].set_yticks([])
    return figure


def located_figure() -> Figure:
    """Draw the drive of the page on a robot among walls."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # the page writes files
        names = names_of_page("locate.md")
    locator, recording = Locator(names["room"], names["rig"]), names["recording"]
    answers = smoothed(recording, locator.follow(recording), locator)
    return locate_figure([("", locator.model.outline, answers, names["path"])])


def scene_figure() -> Figure:
    """Draw the scene of the page on scenes: finely, what fills most of each zone, and zones beside centre rays."""
    names = names_of_page("scenes.md")
    scene, images = names["scene"], names["images"]
    sensor, finer = images.sensor, 15
    fine = sensor.with_(rows=sensor.rows * finer, cols=sensor.cols * finer, histogram=None)
    range_m = SceneRenderer(scene, fine).render(np.eye(4)).range_m[0]
    centre_m = range_m[finer // 2 :: finer, finer // 2 :: finer]
    zone_m = SceneRenderer(scene, sensor.with_(histogram=None)).render(np.eye(4)).range_m[0]
    figure = Figure(figsize=(13.0, 3.6), layout="constrained")
    left, shares, middle, right = figure.subplots(1, 4)
    near, far = float(np.nanmin(range_m)), float(np.nanmax(range_m))
    for axes, values, title in ((left, range_m, "range"), (middle, zone_m, "range of zones")):
        draw_range(axes, values, near_m=near, far_m=far, colour_bar=axes is middle)
        axes.set_title(title)
    largest = images.shares[0].argmax(axis=-1)
    drawn = shares.imshow(largest, cmap="tab10", vmin=-0.5, vmax=9.5)
    for (row, col), share in np.ndenumerate(images.shares[0].max(axis=-1)):
        shares.text(col, row, f"{100 * share:.0f}", ha="center", va="center", fontsize=6)
    bar = figure.colorbar(drawn, ax=shares, ticks=range(len(scene)), boundaries=np.arange(len(scene) + 1) - 0.5)
    bar.ax.set_yticklabels(scene.names)
    shares.set_title("largest body, % of zone")
    off = 1e3 * (centre_m - zone_m)
    drawn = right.imshow(off, cmap="coolwarm", vmin=-100, vmax=100)
    figure.colorbar(drawn, ax=right, label="mm, beyond 100 cut off", extend="both")
    right.set_title("centre ray less zone")
    for axes in (shares, right):
        axes.set_xticks([])
        axes.set_yticks([])
    return figure


def write(figure: Figure, name: str) -> None:
    """Write a figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90)
    IMAGES.mkdir(exist_ok=True)
    write_atomically(IMAGES / name, buffer.getvalue(), force=True)
    record([name])


def main() -> None:
    """Write every figure."""
    parser = argparse.ArgumentParser(description="Draw the figures of the documentation into docs/images.")
    parser.add_argument("--runs", action="store_true", help="make the runs that are missing in out/, ten minutes")
    parser.add_argument("--accept", action="store_true", help="record all figures as they are, and draw none")
    arguments = parser.parse_args()
    if arguments.accept:
        record(list(SOURCES))
        return
    runs = arguments.runs
    write(demo_figure(), "demo.png")
    write(scene_figure(), "scenes.png")
    write(multipath_figure(), "multipath.png")
    write(located_figure(), "locate.png")
    write(drive_figure(run_drive(default_drive())), "drive.png")
    for command, figures in LEFT_BY.items():
        made = made_by(f"{command} --force", [OUT / source for source in figures.values()], runs, *PHASEMARK)
        for name, source in figures.items() if made else ():
            write_atomically(IMAGES / name, (OUT / source).read_bytes(), force=True)
            record([name])
    bench = OUT / "bench.json"
    if runs and bench.exists() and "peer" not in json.loads(bench.read_text(encoding="utf-8")):
        bench.unlink()  # it has other sections alone, and would be replaced
    if made_by("benchmarks/run.py peer", [bench], runs, sys.executable):
        measured = json.loads(bench.read_text(encoding="utf-8"))
        if "peer" in measured:
            write(cost_figure(measured["peer"]["rows"]), "cost.png")
        else:
            sys.stderr.write("cost.png stays as it is: out/bench.json has other sections\n")


def made_by(command: str, files: Sequence[Path], run: bool, *program: str) -> bool:
    """Return whether a command has left its files; with `run` it is run if it has not."""
    if all(file.exists() for file in files):
        return True
    if not run:
        missing = ", ".join(str(file.relative_to(OUT.parent)) for file in files if not file.exists())
        sys.stderr.write(f"pictures stay as they are: no {missing}; --runs makes it by: {command}\n")
        return False
    sys.stderr.write(f"running: {command}\n")
    arguments = shlex.split(command.removeprefix("phasemark "))
    subprocess.run([*program, *arguments], check=True, cwd=OUT.parent)
    return True


if __name__ == "__main__":
    main()
