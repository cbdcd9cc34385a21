"""Count how often the orientation of a recording is learnt right, left undecided, and learnt wrong.

usage: python -m programs.orientation_table --parts 20 --recordings 4 --seed 1

Each random part is recorded by a sensor of 8 × 8 zones, from 0.41 to 0.59 m, in turn by one at rest and by one that
moves, ten frames each; the images are then printed in one of the eight orientations. Of wrong ones the share is bounded
by the upper end of its 95 % interval (Clopper and Pearson).
"""

import argparse
import math
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from random_parts import KINDS, random_part

from phasemark.data import Bank, BankPlan, build_bank
from phasemark.data.measured.recording import ORIENTATIONS, Orientation
from phasemark.data.plans import MeshPlan
from phasemark.landmarks import export_mesh
from phasemark.matcher import Matcher
from phasemark.matcher.recordings import learn_orientation
from phasemark.matcher.statistics import binomial_interval
from phasemark.render import Frames, Renderer, Views, capture

SENSOR = "vl53l5cx-8x8"
N_FRAMES = 10


def recording(bank: Bank, at_rest: bool, true: Orientation, rng: np.random.Generator) -> Frames:
    """Return frames as a board in some orientation prints them."""
    distance_m, turn_rad = rng.uniform(0.41, 0.59, 2), rng.uniform(-1, 1)
    if at_rest:
        distance_m[1], turn_rad = distance_m[0], 0.0
    delta_rad = rng.uniform(0, 2 * math.pi) + np.linspace(0, turn_rad, N_FRAMES)
    views = Views.broadcast(np.linspace(distance_m[0], distance_m[1], N_FRAMES), delta_rad)
    images = Renderer(bank.mesh(bank.classes[0]), bank.sensor).render_views(views)
    frames = capture(images, bank.sensor, rng=rng, n_frames=1)
    back = true if true.flip_h else Orientation(rotate=(360 - true.rotate) % 360)
    return Frames(back.apply(frames.range_m), flags=back.apply(frames.flags), sensor=bank.sensor)


def count(bank: Bank, n: int, rng: np.random.Generator) -> Counter[str]:
    """Learn the orientations of n recordings of one part, and count."""
    matcher, counts = Matcher(bank, "refine", free=("distance_m", "delta_rad")), Counter[str]()
    for k in range(n):
        true = ORIENTATIONS[rng.integers(len(ORIENTATIONS))]
        left = learn_orientation(matcher, recording(bank, k % 2 == 0, true, rng)).left
        if len(left) > 1:
            counts["undecided" if true in left else "undecided without the true one"] += 1
        else:
            counts["right" if left[0] == true else "wrong"] += 1
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", type=int, default=20)
    parser.add_argument("--recordings", type=int, default=4, help="of each part")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    total, begun = Counter[str](), time.perf_counter()
    for k in range(options.parts):
        rng = np.random.default_rng([options.seed, k])
        kind = str(rng.choice(list(KINDS)))
        with TemporaryDirectory() as folder:
            path = Path(folder) / "part.ply"
            path.write_bytes(export_mesh(random_part(kind, rng), "ply"))
            plan = BankPlan(
                meshes=(MeshPlan(name="part", path=str(path), unit="m"),),
                sensor=SENSOR,
                distance_m="0.40:0.60:0.02",
                delta_deg="0:360:2",
                layout="full",
            )
            with build_bank(plan) as bank:
                total += count(bank, options.recordings, rng)
        print(f"{kind}: {dict(total)}, {time.perf_counter() - begun:.0f} s", flush=True)
    most = binomial_interval(total["wrong"], total.total()).high
    print(f"all: {dict(total)}, wrong: at most {most:.2%}")


if __name__ == "__main__":
    main()
