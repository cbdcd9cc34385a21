"""Count how many answers about random parts are accepted, and how many of these are grossly wrong.

usage: python -m programs.random_parts_table --banks 4 --per-bank 4 --frames 50 --seed 1 --settings fixed,default
       python -m programs.random_parts_table --again FILE [--settings fixed,…]

Each bank holds parts of random kinds. Each setting sees random views of them, and prints a line of counts and a line
for each accepted answer that is grossly wrong. `--keep FILE` pickles what reproduces these, and `--again FILE` matches
their frames again, with the settings that found them or with others.

A cost `a → b` is that of a view as it stands, and after a descent from there. The share of wrong answers is bounded by
the upper end of its 95 % interval (Clopper and Pearson).
"""

import argparse
import itertools
import math
import pickle
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from random_parts import KINDS, random_part

from phasemark.data import Bank, BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import export_mesh
from phasemark.matcher import Match, Matcher, kalman_filter, phasor_mean
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.likelihood_matcher import LikelihoodMatcher
from phasemark.matcher.likelihood.refine import costs_at, refine
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.nearest.bank_minima import Starts
from phasemark.matcher.statistics import binomial_interval
from phasemark.render import Background, PhasorImages, Renderer, Views, capture

WALL = Background(wall_m=2.5)
FIXED, BEARING = VIEW[:2], VIEW[:3]
UNKNOWN = {"free": FIXED, "background": "unknown"}
SETTINGS: dict[str, dict[str, Any]] = {
    "fixed": {"free": FIXED},
    "default": {},
    "bearing": {"free": BEARING},
    "wall": {"free": FIXED, "background": WALL},
    "auto": {"free": FIXED, "background": "auto"},
    "robust": {"free": FIXED, "robust": True},
    "phasors": {"free": FIXED, "on": "phasors"},
    "unknown": UNKNOWN,
    "unknown-post": UNKNOWN,
    "unknown-second": UNKNOWN,
    "unknown-behind": UNKNOWN,
    "unknown-before": UNKNOWN,
    "unknown-board": UNKNOWN,
    "unknown-default": {"background": "unknown"},
    "stranger": {"free": FIXED},
    "stranger-near": {"free": FIXED},
    "stranger-near-default": {},
    "stranger-default": {},
    "mirrored": {"free": FIXED},
    "mirrored-default": {},
    "auto-default": {"background": "auto"},
    "auto-nothing": {"background": "auto"},
}
"""Options of the matcher. New settings go to the end: the place of one is part of the seed of its frames."""
SCENES = {"wall": WALL, "auto": WALL, "auto-default": WALL}
"""What truly stands behind the landmark; nothing in the settings that are not here."""
THINGS = "post", "second", "behind", "before", "board"
"""What stands in view besides, by the last word of the setting: see :func:`things_in_view`."""
IMAGES = "phasor", "intensity", "coverage"
REASONS = ("no landmark", "poor fit", "undetermined", "ambiguous")
DISTANCES_M = (0.65, 1.45)
GROSS_M, GROSS_RAD = 0.03, math.radians(6.0)


@dataclass(frozen=True)
class Case:
    """A frame of a true view, and all that reproduces it; angles in radians, lengths in metres."""

    sensor: str
    bank_seed: tuple[int, ...]
    per_bank: int
    setting: str
    frame_seed: tuple[int, ...]
    number: int
    exposures: int
    class_name: str
    distance_m: float
    delta_rad: float
    bearing_rad: float

    @property
    def view(self) -> tuple[float, float, float]:
        return self.distance_m, self.delta_rad, self.bearing_rad


@dataclass
class Counts:
    """What became of the frames of one setting."""

    frames: int = 0
    accepted: int = 0
    seconds: float = 0.0
    refused: Counter[str] = field(default_factory=Counter)
    wrong: list[tuple[Case, str]] = field(default_factory=list)

    def line(self, setting: str) -> str:
        upper = binomial_interval(len(self.wrong), self.frames).high
        refused = ", ".join(f"{self.refused[reason]} {reason}" for reason in REASONS)
        return (
            f"{setting}: {self.frames} frames, {self.accepted} accepted, {len(self.wrong)} of them wrong (at most"
            f" {100 * upper:.2f} % of frames), refused: {refused}; {self.frames / max(self.seconds, 1e-9):.1f} frames/s"
        )


def bank_of(
    seed: tuple[int, ...], per_bank: int, sensor: str, workers: int = 1, distance_m: str = "0.6:1.5:0.02"
) -> Bank:
    """Build the bank of some random parts; a class is named by its number and its kind."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory(prefix="random-parts-") as folder:
        plans = []
        for k in range(per_bank):
            kind = str(rng.choice(list(KINDS)))
            path = Path(folder) / f"{k}.ply"
            path.write_bytes(export_mesh(random_part(kind, rng), "ply"))
            plans.append(MeshPlan(name=f"{k}-{kind}", path=str(path), unit="m"))
        plan = BankPlan(meshes=tuple(plans), sensor=sensor, distance_m=distance_m, delta_deg="0:360:2", layout="full")
        return build_bank(plan, workers=workers)


def draw_cases(bank: Bank, like: dict[str, Any], n: int) -> list[Case]:
    """Draw random true views of the parts of a bank, class by class; `like` has what the cases have in common."""
    rng = np.random.default_rng(like["frame_seed"])
    drawn_rad = {"normal": rng.normal(0, math.radians(1), n), "bearing": rng.uniform(-1, 1, n) * math.radians(1.7)}
    kind = "normal" if like["setting"].endswith("default") else like["setting"]
    drawn = zip(
        np.sort(rng.integers(len(bank.classes), size=n)),
        rng.uniform(*DISTANCES_M, n).tolist(),
        rng.uniform(0, 2 * math.pi, n).tolist(),
        drawn_rad.get(kind, np.zeros(n)).tolist(),
        strict=True,
    )
    return [Case(**like, number=k, class_name=bank.classes[c], distance_m=d, delta_rad=a, bearing_rad=b)
            for k, (c, d, a, b) in enumerate(drawn)]  # fmt: skip


def moved(part: trimesh.Trimesh, turn_rad: float, offset_m: tuple[float, float, float]) -> trimesh.Trimesh:
    """Return a copy of a mesh, turned about its axis and then moved."""
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return trimesh.Trimesh(part.vertices @ turn.T + offset_m, part.faces, process=False)


def things_in_view(kind: str, case: Case, bank: Bank, rng: np.random.Generator) -> trimesh.Trimesh:
    """Return unknown things in the camera's frame: x ahead, y to the left, z up."""
    far, side = case.distance_m, rng.choice([-1.0, 1.0])
    if kind == "post":
        at = rng.uniform(0.5, 1.2) * far
        post = trimesh.creation.cylinder(rng.uniform(0.015, 0.04), 1.0, sections=16)
        return moved(post, 0.0, (at, at * math.tan(side * math.radians(rng.uniform(2.0, 10.0))), 0.0))
    if kind == "second":
        other = bank.mesh(str(rng.choice([name for name in bank.classes if name != case.class_name])))
        turn = rng.uniform(0, 2 * math.pi)
        return moved(other, turn, (far + rng.uniform(-0.1, 0.3), side * rng.uniform(0.3, 0.45), 0.0))
    board = moved(trimesh.creation.box((0.02, 0.8, 1.2)), 0.0, (0.0, side * 0.4, 0.0))
    turn = rng.uniform(-0.2, 0.2)
    at = far + rng.uniform(0.3, 0.6) if kind == "behind" else far * rng.uniform(0.5, 0.8)
    return moved(board, turn, (at, rng.uniform(-0.06, 0.06) * at / far, 0.0))


def rendered_with_things(bank: Bank, case: Case, renderer: Renderer) -> PhasorImages:
    """Render a landmark, or nothing, among unknown things."""
    kind = case.setting.removeprefix("unknown-")
    things = things_in_view(kind, case, bank, np.random.default_rng((*case.frame_seed, case.number)))
    bodies: tuple[list[NDArray[np.float64]], list[NDArray[np.int64]]] = [things.vertices], [things.faces]
    if kind != "board":
        landmark = bank.mesh(case.class_name)
        rotation, translation = (one[0] for one in Views.broadcast(*case.view).landmark2cam())
        bodies[0].append(landmark.vertices @ rotation.T + translation)
        bodies[1].append(landmark.faces + len(things.vertices))
    away = 10.0  # the axis of all bodies, far enough for the lens to stand outside them
    whole = trimesh.Trimesh(np.concatenate(bodies[0]) - (away, 0, 0), np.concatenate(bodies[1]), process=False)
    return Renderer(whole, renderer.sensor, albedo=renderer.albedo).render(away)


def rendered_stranger(bank: Bank, case: Case, renderer: Renderer) -> PhasorImages:
    """Render a part that is in no bank: a random one, or one of the bank's with other width, depth or height."""
    rng = np.random.default_rng((*case.frame_seed, case.number, 1))
    if case.setting.startswith("stranger-near"):
        part = trimesh.Trimesh(bank.mesh(case.class_name).vertices, bank.mesh(case.class_name).faces, process=False)
        part.apply_transform(np.diag([*np.where(rng.permutation(3) < 1, 1.0, rng.choice([0.85, 1.15], 3)), 1.0]))
    else:
        part = random_part(str(rng.choice(list(KINDS))), rng)
    return Renderer(part, renderer.sensor, albedo=renderer.albedo).render(*case.view)


def frames_of(bank: Bank, renderers: dict[str, Renderer], cases: Sequence[Case]) -> FilteredFrames:
    """Render consecutive cases of one class and setting, add noise and filter; the noise of a case is its own."""
    first = cases[0]
    renderer = renderers[first.class_name]
    views = Views.broadcast(*np.array([case.view for case in cases]).T)
    kind, _, things = first.setting.partition("-")
    if things in THINGS or kind == "stranger":
        rendered = rendered_stranger if kind == "stranger" else rendered_with_things
        alone = [rendered(bank, case, renderer) for case in cases]
        parts: dict[str, Any] = {part: np.concatenate([getattr(one, part) for one in alone]) for part in IMAGES}
        image = replace(alone[0], views=views, **parts)
    else:
        image = renderer.render_views(views, background=SCENES.get(first.setting))
    if kind == "mirrored":
        mirrored: dict[str, Any] = {part: getattr(image, part)[..., ::-1] for part in IMAGES}
        image = replace(image, **mirrored)
    phasors = SETTINGS[first.setting].get("on") == "phasors"
    sensor = renderer.sensor.with_(max_phase_std_rad=None) if phasors else renderer.sensor
    rng = np.random.default_rng(first.frame_seed)
    frames = capture(image, sensor, rng=rng, n_frames=first.exposures, first_view=first.number)
    return (phasor_mean if phasors else kalman_filter)(frames)


def renderers_of(bank: Bank) -> dict[str, Renderer]:
    meshes = {name: bank.mesh(name) for name in bank.classes}
    return {name: Renderer(mesh, bank.sensor, albedo=mesh.metadata["albedo"]) for name, mesh in meshes.items()}


def is_grossly_wrong(bank: Bank, case: Case, match: Match) -> bool:
    """Return True if class, distance or angle are grossly wrong, the angle within the symmetry of the true part."""
    symmetry = int(bank.mesh(case.class_name).metadata["symmetry"])
    turn = abs(math.remainder(match.delta_rad - case.delta_rad, 2 * math.pi / symmetry))
    if case.setting == "unknown-board" or case.setting.startswith("stranger"):
        return True  # no part of the bank is in view
    return match.class_name != case.class_name or abs(match.distance_m - case.distance_m) > GROSS_M or turn > GROSS_RAD


def costs_of(
    matcher: Matcher, case: Case, frames: FilteredFrames, views: Sequence[tuple[str | None, Sequence[float]]]
) -> list[str]:
    """Return what the matcher's own cost function makes of classes and views: cost there, and after a descent."""
    method = matcher._method
    assert isinstance(method, LikelihoodMatcher)
    setup = method.setup
    behind = [SCENES[case.setting]] if case.setting in SCENES else []
    scene = method.scenes.before(behind) if setup.auto else method.scenes.stated
    evidence = Evidence.from_frames(matcher.read_out(frames).without_offset().with_pooled_noise(), setup.on)
    texts = []
    for name, view in views:
        if name is None:
            texts.append("none")
            continue
        class_index = np.array([matcher.bank.classes.index(name)])
        start = Starts(np.zeros(1, np.int64), class_index, np.array([[*view, 0.0, 0.0, 0.0]]))
        arguments = (scene.final, evidence, start, scene.settings())
        texts.append(f"{costs_at(*arguments)[0]:.1f} → {refine(*arguments).cost[0]:.1f}")
    return texts


def described(name: str | None, distance_m: float, delta_rad: float, bearing_rad: float) -> str:
    turn = math.degrees(delta_rad) % 360
    return f"{name} {distance_m:.4f} m {turn:.2f}° bearing {math.degrees(bearing_rad):.2f}°"


def explained(matcher: Matcher, case: Case, frames: FilteredFrames, match: Match) -> str:
    """Return one line about an answer and the truth."""
    answer = match.distance_m, match.delta_rad, match.bearing_rad
    others = "; ".join(
        f"{described(other.class_name, other.distance_m, other.delta_rad, other.bearing_rad)} cost {other.cost:.1f}"
        for other in match.alternatives[:4]
    )
    verdict = "accepted" if match.accepted else match.reason
    truth, own = costs_of(matcher, case, frames, [(case.class_name, case.view), (match.class_name, answer)])
    return (
        f"bank {case.bank_seed} ({', '.join(matcher.bank.classes)}) frame {case.number}:"
        f" truth {described(case.class_name, *case.view)}, cost {truth};"
        f" answer {described(match.class_name, *answer)}, cost {own}, {verdict},"
        f" chi2 {match.chi2:.1f} of {match.dof}, p {match.p_value:.3g}; alternatives: {others or 'none'}"
    )


def count(matcher: Matcher, cases: Sequence[Case], renderers: dict[str, Renderer], counts: Counts) -> None:
    """Match the frames of some cases, all of a class at once, and count."""
    for _, group in itertools.groupby(cases, key=lambda case: case.class_name):
        alike = list(group)
        frames = frames_of(matcher.bank, renderers, alike)
        begun = time.perf_counter()
        matches = matcher.match(frames)
        counts.seconds += time.perf_counter() - begun
        counts.frames += len(alike)
        for k, (case, match) in enumerate(zip(alike, matches, strict=True)):
            if not match.accepted:
                counts.refused[match.reason] += 1
                continue
            counts.accepted += 1
            if is_grossly_wrong(matcher.bank, case, match):
                counts.wrong.append((case, explained(matcher, case, frames[k : k + 1], match)))


def table(arguments: argparse.Namespace) -> list[Case]:
    """Print the table, and return the cases whose answers are accepted and grossly wrong."""
    counts = {name: Counts() for name in arguments.settings or ["fixed"]}
    for b in range(arguments.banks):
        seed = (arguments.seed, b)
        with bank_of(seed, arguments.per_bank, arguments.sensor, arguments.workers) as bank:
            renderers = renderers_of(bank)
            for name, found in counts.items():
                like = {
                    "sensor": arguments.sensor,
                    "bank_seed": seed,
                    "per_bank": arguments.per_bank,
                    "setting": name,
                    "frame_seed": (*seed, list(SETTINGS).index(name)),
                    "exposures": arguments.exposures,
                }
                matcher = Matcher(bank, "refine", workers=arguments.workers, **SETTINGS[name])
                count(matcher, draw_cases(bank, like, arguments.frames), renderers, found)
    for name, found in counts.items():
        print(found.line(name))
        for _, text in found.wrong:
            print(f"  {text}")
    return [case for found in counts.values() for case, _ in found.wrong]


def again(cases: Sequence[Case], settings: Sequence[str], workers: int) -> None:
    """Match the frames of kept cases again."""
    for case in cases:
        with bank_of(case.bank_seed, case.per_bank, case.sensor, workers) as bank:
            frames = frames_of(bank, renderers_of(bank), [case])
            for name in settings or [case.setting]:
                matcher = Matcher(bank, "refine", workers=workers, **SETTINGS[name])
                print(f"{name}: {explained(matcher, case, frames, matcher.match(frames)[0])}", flush=True)


def names(text: str) -> list[str]:
    """Return names of settings, separated by commas."""
    chosen = text.split(",")
    if unknown := set(chosen) - set(SETTINGS):
        raise argparse.ArgumentTypeError(
            f"unknown {', '.join(sorted(unknown))}: the settings are {', '.join(SETTINGS)}"
        )
    return chosen


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m programs.random_parts_table", description=__doc__.split("\n")[0])
    for option, default in (("banks", 4), ("per-bank", 4), ("seed", 1), ("exposures", 50), ("workers", 1)):
        parser.add_argument(f"--{option}", type=int, default=default)
    parser.add_argument("--frames", type=int, default=50, help="of each bank in each setting")
    parser.add_argument("--settings", type=names, help=f"some of {','.join(SETTINGS)}; 'fixed' unless stated")
    parser.add_argument("--sensor", default="pmd-16x16")
    parser.add_argument("--keep", type=Path, help="pickle the grossly wrong cases")
    parser.add_argument("--again", type=Path, help="match the cases of such a file again")
    arguments = parser.parse_args()
    if arguments.again:
        kept = [Case(**fields) for fields in pickle.loads(arguments.again.read_bytes())]
        again(kept, arguments.settings or [], arguments.workers)
        return
    wrong = table(arguments)
    if arguments.keep:
        arguments.keep.write_bytes(pickle.dumps([asdict(case) for case in wrong]))


if __name__ == "__main__":
    main()
