"""Count what is accepted of frames as a chip reports them, with the part's mesh and no other option, and what is wrong.

usage: python -m programs.chip_frames_table --sensor vl53l5cx-8x8 --frames 20 --exposures 1 --seed 1

Each part, four landmarks of the catalogue and a bracket, is seen from random views at 0.4 to 1.2 m, up to 5° aside and
up to 3° tilted, before a wall 0.3 to 2 m behind it or none, and above a floor or none. Of each it prints how many
answers are right, within 3 cm and 6°, how many of them are accepted, of how many of these D, δ and bearing lie in their
95 % ellipsoid, and how many wrong ones are accepted; and of the frames whose view the information of their zones
determines, how many are accepted. With --strangers frames are matched with another of the parts, and it prints how many
are accepted.
"""

import argparse
import math
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh
from scipy.stats import chi2

from phasemark.data import Bank, BankPlan, build_bank
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import build_mesh, catalog, export_mesh
from phasemark.matcher import Match, Matcher, kalman_filter
from phasemark.matcher.statistics import binomial_interval
from phasemark.render import Background, Views
from phasemark.render.direct import HistogramRenderer, capture_histograms

GROSS_M, GROSS_RAD = 0.03, math.radians(6.0)


def bracket() -> trimesh.Trimesh:
    """Return a foot with an upright plate, and a rib off the middle: it has no symmetry."""
    foot = trimesh.creation.box((0.16, 0.24, 0.03))
    foot.apply_translation((0, 0, 0.015))
    plate = trimesh.creation.box((0.03, 0.24, 0.25))
    plate.apply_translation((-0.065, 0, 0.125))
    rib = trimesh.creation.box((0.13, 0.03, 0.12))
    rib.apply_translation((0.015, 0.06, 0.09))
    whole: trimesh.Trimesh = trimesh.boolean.union([foot, plate, rib])
    whole.apply_translation((0, 0, -whole.bounds[:, 2].mean()))
    return whole


def scene(rng: np.random.Generator, mesh: trimesh.Trimesh) -> tuple[Views, Background | None]:
    """Return a random view of a part, and what stands behind it."""
    distance_m, radius_m = rng.uniform(0.4, 1.2), float(np.hypot(*mesh.vertices[:, :2].T).max())
    planes: dict[str, Any] = {}
    if rng.random() < 0.8:
        planes["wall_m"] = distance_m + radius_m + rng.uniform(0.3, 2.0)
    if rng.random() < 0.5:
        planes["floor_m"] = -float(mesh.bounds[0, 2]) + rng.uniform(0.05, 0.25) + 0.06 * distance_m
    bearing, pitch, roll = np.radians([rng.uniform(-most, most) for most in (5, 3, 3)])
    view = Views.broadcast(distance_m, rng.uniform(0, 2 * math.pi), bearing, 0.0, pitch, roll)
    return view, Background(**planes) if planes else None


def bank_of(name: str, mesh: trimesh.Trimesh, sensor: str, folder: Path) -> Bank:
    """Return a bank of one part."""
    path = folder / f"{name}.stl"
    path.write_bytes(export_mesh(mesh, "stl"))
    is_class = name in catalog()
    meshes = () if is_class else (MeshPlan(name=name, path=str(path), unit="m"),)
    classes = (name,) if is_class else ()
    return build_bank(
        BankPlan(sensor=sensor, classes=classes, landmarks=(), meshes=meshes, distance_m="0.3:1.5:0.01", layout="full")
    )


def is_right(match: Match, view: Views) -> bool:
    """Return whether distance and angle are right, the angle within the symmetry of the part."""
    if match.class_name is None:
        return False
    turn = math.remainder(match.delta_rad - float(view.delta_rad[0]), 2 * math.pi / max(match.symmetry or 1, 1))
    return abs(match.distance_m - float(view.distance_m[0])) <= GROSS_M and abs(turn) <= GROSS_RAD


def is_determined(match: Match) -> bool:
    """Return whether distance, angle and bearing are known within the tolerance by three standard deviations."""
    if match.covariance is None:
        return False
    return bool((3 * np.sqrt(np.diag(match.covariance))[:3] <= [GROSS_M, GROSS_RAD, GROSS_RAD]).all())


def is_in_ellipsoid(match: Match, view: Views) -> bool:
    """Return whether distance, angle and bearing lie in the ellipsoid that holds 95 % of them."""
    if match.covariance is None:
        return False
    turn = math.remainder(match.delta_rad - float(view.delta_rad[0]), 2 * math.pi / max(match.symmetry or 1, 1))
    error = [match.distance_m - float(view.distance_m[0]), turn, match.bearing_rad - float(view.bearing_rad[0])]
    return bool(error @ np.linalg.solve(match.covariance[:3, :3], error) <= chi2.ppf(0.95, 3))


def count(bank: Bank, mesh: trimesh.Trimesh, exposures: int, n: int, rng: np.random.Generator) -> Counter[str]:
    """Match n random frames of one part, and count."""
    matcher, renderer, counts = (
        Matcher(bank, "refine", on="reported", workers=1),
        HistogramRenderer(mesh, bank.sensor),
        Counter[str](),
    )
    for _ in range(n):
        view, behind = scene(rng, mesh)
        expected = renderer.render_views(view, background=behind).expected
        zones = expected.reshape(1, bank.sensor.rows * bank.sensor.cols, -1)
        ranges = capture_histograms(zones, bank.sensor, rng=rng, n_frames=exposures).ranges
        match = matcher.match(kalman_filter(ranges))[0]
        right, determined = is_right(match, view), is_determined(match)
        counts["frames"] += 1
        counts["right"] += right
        counts["accepted"] += match.accepted
        counts["right accepted"] += right and match.accepted
        counts["in their ellipsoid"] += right and match.accepted and is_in_ellipsoid(match, view)
        counts["determined"] += right and determined
        counts["determined accepted"] += right and determined and match.accepted
        counts["wrong accepted"] += match.accepted and not right
        if match.reason:
            counts[match.reason] += 1
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="vl53l5cx-8x8")
    parser.add_argument("--frames", type=int, default=20, help="of each part")
    parser.add_argument("--exposures", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--strangers", action="store_true", help="match with another part")
    options = parser.parse_args()
    meshes = {name: build_mesh(spec) for name, spec in catalog().items()} | {"bracket": bracket()}
    names, total = list(meshes), Counter[str]()
    for k, name in enumerate(names):
        of = names[(k + options.strangers) % len(names)]
        with TemporaryDirectory() as folder, bank_of(of, meshes[of], options.sensor, Path(folder)) as bank:
            begun, rng = time.perf_counter(), np.random.default_rng([options.seed, k])
            counts = count(bank, meshes[name], options.exposures, options.frames, rng)
        print(f"{name}: {dict(counts)}; {(time.perf_counter() - begun) / options.frames:.1f} s a frame", flush=True)
        total += counts
    wrong = "accepted" if options.strangers else "wrong accepted"
    most = binomial_interval(total[wrong], total["frames"]).high
    print(f"all: {dict(total)}; {wrong}: at most {most:.2%}")


if __name__ == "__main__":
    main()
