"""Train a small network on exact frames and on centre rays, and judge both by frames of another renderer.

``python examples/train_baseline.py count --train 4000 --judged 1000``

The scenes are those of scene_generators.py; the input is the distance that each zone reports. Exact frames are a frame
set. Centre rays are what simulators give: the same scenes, sensor and noise, but one ray a zone. Other scenes judge:
32 x 32 rays of Embree a zone, which the depth adapter makes a frame of. A table is printed. PyTorch comes with ``pip
install -e '.[learn]'`` in the clone.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scene_generators import DOCK, PLANS, POSTURES

from phasemark import PhasemarkError, UsageError
from phasemark.data import build_frames
from phasemark.data.plans import SceneFramesPlan
from phasemark.matcher import cramer_rao
from phasemark.matcher.statistics import Interval, binomial_interval, rms_interval
from phasemark.render import Background, Renderer, Sensor, Views, capture, preset, zones_from_depth
from phasemark.render.view import wrap_delta_difference_rad

TASKS: dict[str, tuple[str, str, tuple[Any, ...]]] = {
    "count": ("people", "count", (0, 1, 2, 3, 4)),
    "posture": ("hand", "posture", (*POSTURES, "none")),
    "dock": ("dock", "", ()),
}
"""Generator, label and its values; without values D and δ of the dock are learnt."""
JUDGE = 32
"""Rays along each side of a zone in a judge's depth image."""


@dataclass(frozen=True)
class Seen:
    """Distances that a sensor reports of n scenes, (n, rows, cols), NaN where none is valid; and labels, (n,) each."""

    distance_m: NDArray[np.float64]
    labels: dict[str, NDArray[Any]]


# --- frames ----------------------------------------------------------------------------------------------------------


def plan_of(task: str, n: int, seed: int) -> SceneFramesPlan:
    """Return the plan of n scenes of a task."""
    about = PLANS[TASKS[task][0]]
    scenes = {**about["scenes"], "generator": f"scene_generators:{TASKS[task][0]}", "n": n}
    return SceneFramesPlan(sensor=about["sensor"], scenes=scenes, seed=seed, keep=("targets",), variants=())


def exact_frames(plan: SceneFramesPlan) -> Seen:
    """Build the frame set of a plan, and read it."""
    with tempfile.TemporaryDirectory() as folder, build_frames(plan, Path(folder) / "frames.h5") as frames:
        sample = frames[:]
    labels = {name.removeprefix("label_"): values for name, values in sample.items() if name.startswith("label_")}
    if "target_status" in sample:
        return labelled(np.where(sample["target_status"] == 0, sample["target_distance_m"], np.nan)[..., 0], labels)
    return labelled(sample["range_m"], labels)


def frames_of_rays(plan: SceneFramesPlan, per_side: int = 1) -> Seen:
    """Cast per_side × per_side rays a zone into each scene of a plan, and capture that with the noise of its sensor."""
    source, sensor, distances, labels = plan.source(), plan.build_sensor(), [], []
    for index in range(plan.n_scenes):
        scene = source.placed(index)
        depth_m, intrinsics, albedo, normals = depth_image(scene, sensor, per_side * sensor.cols)
        zones = zones_from_depth(depth_m, intrinsics, sensor, albedo, normals)
        rng = np.random.default_rng(plan.seed)
        if zones.histograms is not None:
            targets = capture(zones.histograms, sensor, rng=rng, first_view=index).targets
            distances.append(np.where(targets.status == 0, targets.distance_m, np.nan)[0, 0, ..., 0])
        else:
            distances.append(capture(zones.images, sensor, rng=rng, first_view=index).range_m[0, 0])
        labels.append({name: values[0] for name, values in scene.labels.items()})
    return labelled(np.array(distances), {name: np.array([each[name] for each in labels]) for name in labels[0]})


def depth_image(scene: Any, sensor: Sensor, side: int) -> tuple[Any, ...]:
    """Return depth, intrinsics, albedo and normals of what side × side rays of Embree hit first, for the depth adapter.

    The sensor is a square pinhole camera, the scene as a plan's source places it; a wall stands behind all bodies.
    """
    tangent = sensor.tan_half_angles[0]
    across = tangent * (1 - (2 * np.arange(side) + 1) / side)
    y, z = (values.ravel() for values in np.meshgrid(across, across))
    rays = np.column_stack([np.ones(side**2), y, z])  # one metre along the axis: their lengths are depths
    wall = scene.background or Background()
    depth_m, albedo = np.full(side**2, wall.wall_m or 0.0), np.full(side**2, wall.wall_albedo)
    normals = np.tile([-1.0, 0.0, 0.0], (side**2, 1))
    if scene.scene is not None:
        in_camera = np.linalg.inv(scene.camera2world[0]) @ scene.bodies2world[0]
        parts = [trimesh.Trimesh(body.mesh.vertices, body.mesh.faces, process=False) for body in scene.scene]
        for part, pose in zip(parts, in_camera, strict=True):
            part.apply_transform(pose)
        whole: Any = trimesh.util.concatenate(parts)
        face = whole.ray.intersects_first(np.zeros_like(rays), rays)
        hit, face = face >= 0, face[face >= 0]
        normal = whole.face_normals[face]
        towards = (normal * rays[hit]).sum(axis=1)
        depth_m[hit] = (normal * whole.triangles[face, 0]).sum(axis=1) / towards
        normals[hit] = normal * -np.sign(towards)[:, None]
        albedo[hit] = np.repeat([body.albedo for body in scene.scene], [len(part.faces) for part in parts])[face]
    optical = np.column_stack([-normals[:, 1], -normals[:, 2], normals[:, 0]])
    focal_px, middle_px = side / (2 * tangent), (side - 1) / 2
    intrinsics = (focal_px, focal_px, middle_px, middle_px)
    return depth_m.reshape(side, side), intrinsics, albedo.reshape(side, side), optical.reshape(side, side, 3)


def labelled(distance_m: NDArray[Any], labels: dict[str, NDArray[Any]]) -> Seen:
    """Return the frames whose labels are there, texts as str."""
    texts = {name: values.astype(str) if values.dtype.kind == "S" else values for name, values in labels.items()}
    there = np.all([values == values for values in texts.values()], axis=0)
    return Seen(np.asarray(distance_m[there], np.float64), {name: values[there] for name, values in texts.items()})


# --- learning --------------------------------------------------------------------------------------------------------


def targets_of(task: str, seen: Seen) -> NDArray[Any]:
    """Return what a network is to answer: numbers of classes, or D and δ as three numbers about one.

    The box looks the same after half a turn, so δ enters as 2δ.
    """
    _, label, classes = TASKS[task]
    if classes:
        return np.array([classes.index(value) for value in seen.labels[label].tolist()])
    turned = 2 * seen.labels["delta_rad"]
    near = (seen.labels["distance_m"] - 1.25) / 0.2
    return np.column_stack([near, np.cos(turned), np.sin(turned)]).astype(np.float32)


def train(task: str, seen: Seen, epochs: int, seed: int) -> Any:
    """Train a network of fewer than 200 000 weights; return a function from distances to its answers."""
    import torch
    from torch import nn

    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    torch.manual_seed(seed)
    mean, std = np.nanmean(seen.distance_m), np.nanstd(seen.distance_m)

    def channels(distance_m: NDArray[np.float64]) -> torch.Tensor:
        valid = np.isfinite(distance_m)
        near = np.where(valid, (distance_m - mean) / std, 0.0)
        return torch.from_numpy(np.stack([near, valid], axis=1).astype(np.float32))

    x, y = channels(seen.distance_m), torch.from_numpy(targets_of(task, seen))
    outputs, smaller = len(TASKS[task][2]) or 3, seen.distance_m.shape[-1] // 8
    network = nn.Sequential(
        nn.Conv2d(2, 32, 3, padding=1), nn.ReLU(),
        nn.Conv2d(32, 48, 3, padding=1, stride=smaller), nn.ReLU(),
        nn.Conv2d(48, 32, 3, padding=1), nn.ReLU(),
        nn.Flatten(), nn.Linear(32 * 8 * 8, 64), nn.ReLU(), nn.Linear(64, outputs),
    )  # fmt: skip
    loss = nn.CrossEntropyLoss() if TASKS[task][2] else nn.MSELoss()
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, epochs=epochs, steps_per_epoch=-(-len(x) // 64))
    for _ in range(epochs):
        for batch in torch.randperm(len(x)).split(64):
            optimiser.zero_grad()
            loss(network(x[batch]), y[batch]).backward()
            optimiser.step()
            schedule.step()

    def answers(distance_m: NDArray[np.float64]) -> NDArray[np.float64]:
        with torch.no_grad():
            return network(channels(distance_m)).double().numpy()

    answers.weights = sum(each.numel() for each in network.parameters())  # type: ignore[attr-defined]
    return answers


# --- the table -------------------------------------------------------------------------------------------------------


def scores(task: str, answers: NDArray[np.float64], seen: Seen, bound: NDArray[np.float64]) -> dict[str, Interval]:
    """Return the numbers of a line of the table with their 95 % intervals; the bound is that of D and δ, (n, 2)."""
    if TASKS[task][2]:
        right = answers.argmax(axis=1) == targets_of(task, seen)
        return {"accuracy": binomial_interval(int(right.sum()), len(right), law="student")}
    distance = 1.25 + 0.2 * answers[:, 0] - seen.labels["distance_m"]
    turned = np.arctan2(answers[:, 2], answers[:, 1]) / 2
    turn = wrap_delta_difference_rad(turned - seen.labels["delta_rad"], math.pi)
    return {
        "D, mm": rms_interval(distance).scaled(1e3),
        "D / bound": rms_interval(distance / bound[:, 0]),
        "δ, °": rms_interval(np.degrees(turn)),
        "δ / bound": rms_interval(turn / bound[:, 1]),
    }


def bound_of_dock(seen: Seen) -> NDArray[np.float64]:
    """Return the Cramér–Rao bound of D and δ, (n, 2), of a frame whose bearing is unknown too; no clutter."""
    renderer = Renderer(DOCK.mesh, preset(PLANS["dock"]["sensor"]), albedo=DOCK.albedo)
    names = ("distance_m", "delta_rad", "bearing_rad")
    views = Views.broadcast(*(seen.labels[name] for name in names))
    bound = cramer_rao(renderer, views, free=names, n_frames=1, background=Background(wall_m=3.0))
    return np.column_stack([bound.std(name) for name in names[:2]])


def main(argv: list[str] | None = None) -> int:
    """Train on both, judge, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("--train", type=int, default=4000, help="scenes to learn from (%(default)s)")
    parser.add_argument("--judged", type=int, default=1000, help="scenes to judge by (%(default)s)")
    parser.add_argument("--epochs", type=int, default=30, help="times that each is shown (%(default)s)")
    parser.add_argument("--seed", type=int, default=7, help="root of all random numbers (%(default)s)")
    arguments = parser.parse_args(argv)
    task = arguments.task
    try:
        import torch  # noqa: F401
    except ImportError:
        print("error: training needs PyTorch: pip install -e '.[learn]' in the clone of phasemark", file=sys.stderr)
        return UsageError.exit_code
    try:
        plans = [plan_of(task, arguments.train, arguments.seed), plan_of(task, arguments.judged, arguments.seed + 1)]
        exact, rays = ([make(plan) for plan in plans] for make in (exact_frames, frames_of_rays))
        judge = frames_of_rays(plans[1], JUDGE)
        bound = np.empty((0, 2)) if TASKS[task][2] else bound_of_dock(judge)
    except PhasemarkError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    lines: list[str] = []
    for name, (learnt, own) in {"exact frames": exact, "centre rays": rays}.items():
        answers = train(task, learnt, arguments.epochs, arguments.seed)
        for judged_by, seen in {"the same kind": own, "another renderer": judge}.items():
            found = scores(task, answers(seen.distance_m), seen, bound)
            if not lines:
                print(f"{len(learnt.distance_m)} frames learnt, {len(own.distance_m)} judge, {answers.weights} weights")
                lines = [f"| trained on | judged by | {' | '.join(found)} |", "|---|---|" + "---|" * len(found)]
            lines.append(f"| {name} | {judged_by} | {' | '.join(map(str, found.values()))} |")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
