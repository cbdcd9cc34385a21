"""The command ``phasemark match``: measured frames against a bank."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from phasemark import UsageError
from phasemark.data.commands.console import LongWork, Table, echo_json, tell
from phasemark.data.commands.inputs import background_of, note_too_far, open_any_bank
from phasemark.data.commands.options import (
    FlipH,
    FlipV,
    Floor,
    Force,
    FramesUnit,
    InvalidMeans,
    Json,
    Quantity,
    Rotate,
    ValidStatus,
    Wall,
    one_of,
)
from phasemark.data.commands.outputs import refuse_unwritable_files
from phasemark.matcher.commands.diagnosis_flags import Given, diagnosis_text
from phasemark.matcher.commands.match_table import match_rows, pose_facts

if TYPE_CHECKING:
    from phasemark.data import Bank
    from phasemark.matcher import (
        FilteredFrames,
        LandmarkMap,
        Match,
    )
    from phasemark.render import Background, Frames


_DRAWN_ALL = 4
"""Most positions that are drawn unless the user says which; a picture takes two seconds."""

NEAREST_AT_ONCE, REFINED_AT_ONCE = 256, 64
"""Positions matched before their answers are printed; refinement takes up to 50 ms each."""


def match_frames(
    bank: Annotated[Path, typer.Argument(metavar="BANK", help="A bank.")],
    frames: Annotated[Path, typer.Argument(metavar="FRAMES", help="Measured frames: CSV, NPY, NPZ or HDF5.")],
    unit: FramesUnit = None,
    quantity: Quantity = None,
    invalid_means: InvalidMeans = "missing",
    valid_status: ValidStatus = None,
    flip_h: FlipH = False,
    flip_v: FlipV = False,
    rotate: Rotate = 0,
    filter_name: Annotated[
        str, typer.Option("--filter", help="kalman or phasor-mean.", autocompletion=one_of("kalman", "phasor-mean"))
    ] = "kalman",
    method: Annotated[
        str,
        typer.Option(
            "--method",
            autocompletion=one_of("nearest", "refine"),
            help="nearest: the paper's minimum-distance classifier. refine: maximum likelihood, with covariance.",
        ),
    ] = "nearest",
    free: Annotated[
        list[str] | None,
        typer.Option(
            "--free",
            help="With refine, estimate this with nothing known of it: bearing or height; repeatable.",
            autocompletion=one_of("bearing", "height"),
        ),
    ] = None,
    fix: Annotated[
        str | None,
        typer.Option(
            "--fix", help="With refine, leave this at 0: bearing.", autocompletion=one_of("bearing"), metavar="NAME"
        ),
    ] = None,
    bearing_std: Annotated[
        float | None,
        typer.Option(
            "--bearing-std",
            metavar="DEG",
            help="With refine, how well the camera points at the landmark (1.5 unless --free or --fix is given).",
        ),
    ] = None,
    on: Annotated[
        str,
        typer.Option(
            "--on",
            help="With refine: ranges, or phasors with the albedo free.",
            autocompletion=one_of("ranges", "phasors"),
        ),
    ] = "ranges",
    pixels: Annotated[
        str,
        typer.Option(
            "--pixels", help="With refine, what gives the view: all or lower.", autocompletion=one_of("all", "lower")
        ),
    ] = "all",
    robust: Annotated[bool, typer.Option("--robust", help="With refine, count residuals beyond 3 σ less.")] = False,
    false_alarm: Annotated[
        float, typer.Option("--false-alarm", help="Share of good frames that the test of the fit may refuse.")
    ] = 0.01,
    auto_background: Annotated[
        bool, typer.Option("--auto-background", help="With refine, estimate wall and floor from each frame.")
    ] = False,
    unknown_background: Annotated[
        bool,
        typer.Option("--unknown-background", help="With refine: other things may stand before, beside and behind it."),
    ] = False,
    wall: Wall = None,
    floor: Floor = None,
    landmark_xy: Annotated[
        tuple[float, float] | None,
        typer.Option("--landmark-xy", metavar="X Y", help="Where the landmark stands, metres."),
    ] = None,
    landmark_yaw: Annotated[float, typer.Option("--landmark-yaw", metavar="DEG", help="Heading of its x' axis.")] = 0.0,
    pan: Annotated[float, typer.Option("--pan", metavar="DEG", help="Pan angle of the camera on the robot.")] = 0.0,
    prior: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--prior", metavar="X Y DEG", help="Where the robot is thought to be; orders the solutions."),
    ] = None,
    prior_std: Annotated[
        tuple[float, float] | None,
        typer.Option("--prior-std", metavar="M DEG", help="How well: standard deviations of x and y, and of heading."),
    ] = None,
    map_file: Annotated[
        Path | None,
        typer.Option("--map", metavar="MAP", help="Where the landmarks stand (.toml), instead of --landmark-xy."),
    ] = None,
    moving: Annotated[
        bool, typer.Option("--moving", help="The camera moves: match every frame by itself instead of their mean.")
    ] = False,
    estimates: Annotated[
        Path | None,
        typer.Option("--estimates", metavar="FILE", help="Write a line for each position into this .csv."),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            "--plot", help="Draw measured, model and residual into this .png; of several positions, number K into -K."
        ),
    ] = None,
    plot_index: Annotated[
        str | None,
        typer.Option(
            "--plot-index",
            metavar="LIST",
            help=f"Positions to draw, such as 0,17,200:210. By default all, or the first of more than {_DRAWN_ALL}.",
        ),
    ] = None,
    no_diagnosis: Annotated[
        bool, typer.Option("--no-diagnosis", help="Do not look for the setting that makes a refused frame fit.")
    ] = False,
    as_json: Json = False,
    as_jsonl: Annotated[
        bool, typer.Option("--jsonl", help="Print each match as a line of JSON as soon as it is known.")
    ] = False,
    force: Force = False,
) -> None:
    """Match measured frames against a bank, and place the robot.

    All frames of a file are averaged: the camera stands still. A file of shape (n, frames, rows, cols) has n positions.
    With --moving every frame is a position of its own. A CSV file may have a header that names its columns: t_ms or
    t_s, mm_0 ... (or range_0 ..., z_0 ...), status_0 ...; for a VL53L5CX or VL53L8CX give --valid-status 5.
    """
    from phasemark.data import read_frames, write_atomically
    from phasemark.matcher import Matcher, diagnose, kalman_filter, load_map, phasor_mean
    from phasemark.matcher.likelihood.estimator import BEARING_STD_RAD
    from phasemark.matcher.recordings.estimates_table import EstimateTable, match_in_batches

    filters = {"kalman": kalman_filter, "phasor-mean": phasor_mean}
    if filter_name not in filters:
        raise UsageError(f"unknown filter '{filter_name}': give {' or '.join(filters)}")
    if map_file is not None and landmark_xy is not None:
        raise UsageError("--map and --landmark-xy both say where the landmark stands: give one of them")
    if prior is not None and landmark_xy is None and map_file is None:
        raise UsageError("--prior needs --landmark-xy or --map: without it there is no robot position")
    if prior_std is not None and prior is None:
        raise UsageError("--prior-std needs --prior, which it belongs to")
    if prior_std is not None and not min(prior_std) > 0:
        raise UsageError(f"--prior-std must be two positive numbers, got {prior_std[0]:g} {prior_std[1]:g}")
    landmarks = None if landmark_xy is None else _one_landmark(landmark_xy, landmark_yaw)
    if map_file is not None:
        landmarks = load_map(map_file)
    if plot is not None and plot.suffix.lower() != ".png":
        raise UsageError(f"the picture must be a .png file, got '{plot}'")
    if plot is None and plot_index is not None:
        raise UsageError("--plot-index needs --plot, the file to draw into")
    if estimates is not None and estimates.suffix.lower() != ".csv":
        raise UsageError(f"the estimates must be a .csv file, got '{estimates}'")
    if as_json and as_jsonl:
        raise UsageError("--json and --jsonl are two forms of the same output: give one of them")
    background = background_of(wall, floor)
    if auto_background and background is not None:
        raise UsageError("--auto-background estimates wall and floor: leave --wall and --floor out")
    if unknown_background and (auto_background or background is not None):
        raise UsageError(
            "--unknown-background takes nothing for known: leave --auto-background, --wall and --floor out"
        )
    if fix not in (None, "bearing"):
        raise UsageError(f"--fix must be bearing, got '{fix}'")
    if bearing_std is not None and (free or fix):
        raise UsageError("--bearing-std says how well the bearing is known: leave --free and --fix out")
    if fix and "bearing" in (free or ()):
        raise UsageError("--free and --fix both name bearing: give one of them")
    parameters = ["distance_m", "delta_rad"]
    for name in free or ():
        if name not in _FREE:
            raise UsageError(f"--free must be {' or '.join(_FREE)}, got '{name}'")
        parameters.append(_FREE[name])
    near_the_axis = method == "refine" and not free and not fix
    if near_the_axis:
        parameters.append(_FREE["bearing"])
    refined = (
        ("--free", bool(free)), ("--on", on != "ranges"), ("--pixels", pixels != "all"), ("--robust", robust),
        ("--auto-background", auto_background), ("--unknown-background", unknown_background),
        ("--fix", fix is not None), ("--bearing-std", bearing_std is not None),
    )  # fmt: skip
    for option, used in refined:
        if used and method == "nearest":
            raise UsageError(f"{option} goes with --method refine: the nearest image has nothing of the kind")
    with open_any_bank(bank) as opened:
        measured = read_frames(
            frames,
            sensor=opened.sensor,
            unit=unit,  # type: ignore[arg-type]  # read_frames says what is right
            quantity=quantity,  # type: ignore[arg-type]
            invalid_means=invalid_means,  # type: ignore[arg-type]
            valid_status=valid_status,
            flip_h=flip_h,
            flip_v=flip_v,
            rotate=rotate,
            untrusted=True,
        )
        note_too_far(opened.sensor, {"--wall": wall})
        positions = measured.each_a_position() if moving else measured
        plots = {} if plot is None else _plots_by_position(plot, plot_index, len(positions))
        refuse_unwritable_files([*plots.values(), *([] if estimates is None else [estimates])], force)
        matcher = Matcher(
            opened,
            method,
            free=None if near_the_axis else parameters,
            background="auto" if auto_background else "unknown" if unknown_background else background,
            bearing_std_rad=BEARING_STD_RAD if bearing_std is None else math.radians(bearing_std),
            false_alarm=false_alarm,
            on=on,  # type: ignore[arg-type]  # Matcher says what is right
            pixels=pixels,  # type: ignore[arg-type]
            robust=robust,
        )
        if not moving:
            _note_motion(measured, frames)
        answers: list[dict[str, Any]] = []  # all of them only for --json, whose answers are one list
        table, estimated = Table(), EstimateTable(parameters)
        drawn: dict[int, tuple[FilteredFrames, Match]] = {}
        refused: tuple[int, FilteredFrames] | None = None
        n_accepted = 0
        at_once = NEAREST_AT_ONCE if method == "nearest" else REFINED_AT_ONCE
        with LongWork("matching") if len(positions) > at_once else nullcontext() as progress:
            for batch in match_in_batches(matcher, positions, filters[filter_name], at_once=at_once):
                some = []
                for k, match in enumerate(batch.matches):
                    answer = match.as_dict()
                    if batch.filtered.time_s is not None:
                        answer["time_s"] = float(batch.filtered.time_s[k])
                    if landmarks is not None:
                        answer["poses"] = pose_facts(
                            match, landmarks, map_file is None, math.radians(pan), prior, prior_std
                        )
                    some.append(answer)
                    if batch.start + k in plots:
                        drawn[batch.start + k] = batch.filtered[k : k + 1], match
                    n_accepted += match.accepted
                    if refused is None and not match.accepted:
                        refused = batch.start + k, batch.filtered[k : k + 1]
                if estimates is not None:
                    estimated.add(batch)
                if as_json:
                    answers += some
                elif as_jsonl:
                    for k, answer in enumerate(some):
                        typer.echo(
                            json.dumps({"index": batch.start + k, **answer}, ensure_ascii=False, allow_nan=False)
                        )
                else:
                    table.echo(match_rows(some, batch.start, moving))
                sys.stdout.flush()
                if progress is not None:
                    progress(batch.start + len(some), len(positions))
        # among the frames of a moving camera some do not show the landmark: that needs no diagnosis
        if refused is not None and not (no_diagnosis or unknown_background or (moving and n_accepted)):
            diagnosis = replace(diagnose(matcher, refused[1], 0, background=background), index=refused[0])
            given = Given(unit, flip_h, flip_v, rotate, method == "nearest", fix == "bearing")
            message = diagnosis_text(diagnosis, given)
            tell(f"note: {message}")
            if as_json:
                answers[diagnosis.index]["diagnosis"] = {**diagnosis.as_dict(), "message": message}
        if as_json:
            echo_json({"bank": str(bank), "frames": str(frames), "matches": answers})
        if estimates is not None:
            write_atomically(estimates, estimated.to_csv().encode(), force=force)
        for k, path in plots.items():
            _save_match_picture(path, *drawn[k], opened, background, force)
    if not (as_json or as_jsonl):
        for path in [*([] if estimates is None else [estimates]), *plots.values()]:
            typer.echo(path)
        _note_plots(plots, plot_index, len(positions))


def _plots_by_position(plot: Path, chosen: str | None, n: int) -> dict[int, Path]:
    """Return which of n positions to draw, and into which files; those of several have a number before the suffix."""
    from phasemark.data.plans.grid_axis import parse_indices

    if chosen is not None:
        indices = parse_indices(chosen, n, "--plot-index")
    else:
        indices = list(range(n if n <= _DRAWN_ALL else 1))
    return {k: plot if n == 1 else plot.with_stem(f"{plot.stem}-{k}") for k in indices}


def _note_plots(plots: Mapping[int, Path], chosen: str | None, n: int) -> None:
    """Say how to have more positions drawn than the first."""
    if plots and chosen is None and len(plots) < n:
        tell(
            f"note: drew the first of {n} positions; --plot-index 0,{n // 2}:{min(n // 2 + 9, n - 1)} draws others"
            " (some seconds each)"
        )


def _note_motion(measured: Frames, file: Path) -> None:
    """Say that frames which are about to be averaged were not taken at rest."""
    import numpy as np

    from phasemark.matcher import motion_test

    moved = np.flatnonzero(motion_test(measured).moved())
    if moved.size:
        n = len(measured)
        where = "the file" if n == 1 else f"{len(moved)} of {n} positions, the first being {moved[0]}"
        tell(
            f"note: {file}: the camera or the scene moved during {where}, so that the mean of the frames is no single"
            " view; --moving matches every frame by itself"
        )


def _save_match_picture(
    path: Path, filtered: FilteredFrames, match: Match, bank: Bank, background: Background | None, force: bool
) -> None:
    """Draw one position."""
    import io as bytes_io

    from phasemark.data import write_atomically
    from phasemark.matcher.figures import match_picture

    buffer = bytes_io.BytesIO()
    match_picture(filtered, match, bank, background).savefig(buffer, format="png", dpi=120)
    write_atomically(path, buffer.getvalue(), force=force)


def _one_landmark(xy: tuple[float, float], yaw_deg: float) -> LandmarkMap:
    """Return the map of a landmark of any class."""
    from phasemark.matcher import LandmarkMap, MappedLandmark

    if not all(map(math.isfinite, (*xy, yaw_deg))):
        raise UsageError(
            f"--landmark-xy and --landmark-yaw must be finite numbers, got {xy[0]:g} {xy[1]:g} and {yaw_deg:g}"
        )
    only = MappedLandmark(name="landmark", class_name="any", x_m=xy[0], y_m=xy[1], yaw_deg=yaw_deg)
    return LandmarkMap(landmark=(only,))


_FREE = {"bearing": "bearing_rad", "height": "height_m"}
