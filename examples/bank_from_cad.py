"""Bring a mesh file of your own into a bank: check it, draw it, build the bank, and match a frame of it.

``python examples/bank_from_cad.py my_part.stl --unit mm --out out/cad``

Without a file it makes one, as a CAD program would: a bracket of 160 × 100 × 60 mm with a mast off its middle.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import trimesh

import phasemark as pm
from phasemark.data.files import write_atomically
from phasemark.data.plans import parse_grid
from phasemark.landmarks import check_mesh, export_mesh, mesh_figure


def write_part(path: Path) -> None:
    """Write the bracket as STL, millimetres, standing on z = 0."""
    block = trimesh.creation.box(extents=(160, 100, 60))
    block.apply_translation((0, 0, 30))
    mast = trimesh.creation.box(extents=(40, 40, 120))
    mast.apply_translation((50, 10, 110))  # overlaps the block: a union leaves no face inside
    part = trimesh.boolean.union([block, mast])
    write_atomically(path, export_mesh(part, "stl"), force=True)


def main() -> int:
    """Build the bank and match one view with it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", type=Path, nargs="?", help="STL, PLY, OBJ or OFF; without one a bracket is made")
    parser.add_argument("--unit", choices=("m", "cm", "mm", "inch"), help="unit of the mesh file")
    parser.add_argument("--distance", default="0.8:1.2:0.1", help="grid of D, START:STOP:STEP, m (%(default)s)")
    parser.add_argument("--delta", default="0:360:10", help="grid of δ, START:STOP:STEP, degrees (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/cad"), help="folder of the results (%(default)s)")
    arguments = parser.parse_args()
    out: Path = arguments.out
    try:
        out.mkdir(parents=True, exist_ok=True)
        path, unit = arguments.mesh, arguments.unit
        if path is None:
            path, unit = out / "bracket.stl", "mm"
            write_part(path)
        # the middle of its bounding box becomes the origin, from which D counts
        mesh = pm.read_mesh(path, unit=unit, origin="center")
        report = check_mesh(mesh)
        print(f"{path}: {' × '.join(f'{100 * side:.1f}' for side in mesh.extents)} cm, {report.faces} faces")
        write_atomically(out / "part.png", mesh_figure(mesh, directions=True), force=True)

        plan = {
            "meshes": [{"name": "part", "path": str(path), "unit": unit, "origin": "center"}],
            "distance_m": arguments.distance,
            "delta_deg": arguments.delta,
            "layout": "full",
        }
        sensor = pm.preset("pmd-16x16")
        middle_m = float(np.median(parse_grid(arguments.distance, "distance")))
        with pm.build_bank(plan, out / "bank.h5", force=True) as bank:
            view = (middle_m + 0.013, np.radians(33.0))  # between the bank's images
            image = pm.Renderer(bank.mesh("part"), sensor, albedo=0.8).render(*view)
            frames = pm.capture(image, sensor, rng=np.random.default_rng(7), n_frames=50)
            match = pm.Matcher(bank, method="refine").match(pm.kalman_filter(frames))[0]
    except (pm.PhasemarkError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code if isinstance(error, pm.PhasemarkError) else pm.UsageError.exit_code
    print(f"true view: D = {view[0]:.4f} m, δ = {np.degrees(view[1]):.2f}°")
    print(
        f"matched:   D = {match.distance_m:.4f} m, δ = {np.degrees(match.delta_rad):.2f}°, accepted: {match.accepted}"
    )
    print(out / "bank.h5")
    print(out / "part.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
