"""Damaged files of every kind that a command reads, and the commands that read them."""

import os
import random
import shutil

import numpy as np
from programs.fuzzing import mutate

from phasemark.cli import main
from phasemark.data import BankPlan, FramePlan, build_bank, build_frames
from phasemark.data.export import export_frames
from phasemark.data.partial_outputs import build_part

SENSOR_OPTIONS = ["--unit", "m", "--quantity", "range"]
EXPORTS = ("npz", "csv", "png16", "ply", "bop", "rosbag")
COMMANDS = {
    "bank": [
        ["bank", "info", "{file}"],
        ["bank", "verify", "{file}"],
        ["match", "{file}", "{good}/frames.h5"],
        ["bank", "merge", "{file}", "-o", "{out}/merged.h5"],
    ],
    "frames": [
        ["frames", "info", "{file}"],
        ["frames", "verify", "{file}"],
        ["frames", "show", "{file}", "-o", "{out}/frame.png"],
        ["frames", "import", "{file}", "-o", "{out}/frames.npz"],
        ["match", "{good}/bank.h5", "{file}"],
        ["frames", "merge", "{file}", "-o", "{out}/merged.h5"],
        *(["frames", "export", "{file}", "--to", to, "-o", "{out}/exported"] for to in EXPORTS),
    ],
    "part": [["frames", "merge", "{file}", "{good}/part2.h5", "-o", "{out}/merged.h5"]],
    **{
        kind: [
            ["frames", "show", "{file}", "-o", "{out}/frame.png", *options],
            ["frames", "import", "{file}", "-o", "{out}/frames.npz", *options],
            ["match", "{good}/bank.h5", "{file}", *options],
            ["sensor", "fit", "{file}", "--distance", "1", "-o", "{out}/sensor.toml", *options],
        ]
        for kind, options in (
            ("csv", SENSOR_OPTIONS),
            ("npy", SENSOR_OPTIONS),
            ("npz", []),
            ("png", []),
            ("bag", []),
        )
    },
}
"""For each kind of file, the commands that read it."""


def make_good_files(folder):
    """Write one small file of each kind; return their names by kind. A bag is a folder."""
    plan = FramePlan(classes=["cone"], views=3, frames_per_view=2)
    bank = BankPlan(classes=["cone"], distance_m="1", delta_deg="0:90:45", model="planar")
    build_bank(bank, folder / "bank.h5").close()
    for k in (1, 2):
        build_part(plan, (k, 2), folder / f"part{k}.h5")
    with build_frames(plan, folder / "frames.h5") as frames:
        export_frames(frames, folder / "frames.csv", "csv", quantity="range")
        export_frames(frames, folder / "frames.npz", "npz")
        export_frames(frames, folder / "png", "png16")
        export_frames(frames, folder / "bag", "rosbag")
        np.save(folder / "frames.npy", frames[:]["range_m"])
    return {
        "bank": folder / "bank.h5", "frames": folder / "frames.h5", "part": folder / "part1.h5",
        "csv": folder / "frames.csv", "npy": folder / "frames.npy", "npz": folder / "frames.npz",
        "png": folder / "png" / "00000000.png", "bag": folder / "bag",
    }  # fmt: skip


def write_mutant(good, path, rng):
    """Write a mutant of a file, or of one file of a folder."""
    if good.is_dir():
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(good, path)
        files = sorted(entry for entry in path.iterdir() if entry.is_file())
        good, path = (rng.choice(files),) * 2
    content = good.read_bytes()
    path.write_bytes(mutate(content, [content], rng))


def busy_seconds():
    """Processor time of this process and its children: other programs' load does not count."""
    return sum(os.times()[:4])


def check_mutants(folder, n, seed):
    """Have commands read n mutants of each kind; return how many runs there were, were refused, and the longest.

    Parameters
    ----------
    folder : Path
        An empty one.
    n : dict of str to int
        By kind.
    seed : int

    Notes
    -----
    Each run must end within 5 s of processor time, with an answer or with exit code 3, and leave nothing behind when it
    refuses. A mutant that passes the first command goes to all of its kind; one that is refused to one more, in turn.
    """
    good, out = folder / "good", folder / "out"
    good.mkdir()
    files = make_good_files(good)
    rng = random.Random(seed)
    runs, refused, longest = 0, 0, 0.0
    for kind, k in [(each, k) for each, count in n.items() for k in range(count)]:
        path = folder / f"mutant{files[kind].suffix}"
        write_mutant(files[kind], path, rng)
        first, *others = COMMANDS[kind]
        waiting = [first]
        while waiting:
            command = waiting.pop()
            shutil.rmtree(out, ignore_errors=True)
            out.mkdir()
            begun = busy_seconds()
            code = main([part.format(file=path, good=good, out=out) for part in command])
            took = busy_seconds() - begun
            what = f"mutant {k} of {kind}, seed {seed}: {' '.join(command[:2])}"
            # what is left of a file that was cut may be sound, and too few frames to know a sensor by
            assert code in ((0, 2, 3) if command[1] == "fit" else (0, 3)), f"{what} ended with {code}"
            assert took < 5, f"{what} took {took:.1f} s"
            assert code == 0 or not list(out.iterdir()), f"{what} left {list(out.iterdir())}"
            runs, refused, longest = runs + 1, refused + (code == 3), max(longest, took)
            if command is first and others:
                waiting = list(others) if code == 0 else [others[k % len(others)]]
    return runs, refused, longest
