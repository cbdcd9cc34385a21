"""Frames as a BOP data set (scenewise): depth, grey images, masks, poses, models with their symmetries.

Units are millimetres, the camera frame is OpenCV's, and a model's origin is the centre of its bounding box, as the
format's page has it (bop_toolkit, docs/bop_datasets_format.md).
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from phasemark.data.export.images import scale_of, to_codes
from phasemark.data.export.samples import CAM2OPTICAL, blocks, landmark2cam, pinhole, quantity_m
from phasemark.data.frames.frame_set_file import FrameSet
from phasemark.data.measured.reading import RangeOrZ

IMAGES_PER_SCENE = 1000
_SPLITS = ("train", "val", "test")
_MM = 1000.0
_Picture = NDArray[Any]


def write_bop(frames: FrameSet, folder: Path, quantity: RangeOrZ) -> None:
    """Write models, camera, and one folder of scenes for each split."""
    centres = _write_models(frames, folder / "models")
    metres_per_unit = scale_of(frames, quantity)
    fx, fy, cx, cy = pinhole(frames)
    sensor = frames.sensor
    camera: dict[str, Any] = {
        "cx": cx, "cy": cy, "depth_scale": metres_per_unit * _MM, "fx": fx, "fy": fy, "height": sensor.rows,
        "width": sensor.cols,
    }  # fmt: skip
    if sensor.lens is not None:
        camera |= {"distortion_model": sensor.lens.model, "distortion": list(sensor.lens.distortion)}
    _write_json(folder / "camera.json", camera)
    _write_json(
        folder / "dataset_info.json", {"quantity": "z", "classes": list(frames.classes), "seed": frames.plan.seed}
    )
    projection = {"cam_K": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], "depth_scale": metres_per_unit * _MM}
    brightest = max(1.0, *(float(np.max(sample.get("amplitude_e", 1.0))) for _, sample in blocks(frames)))
    scenes: dict[str, _Scene] = {}
    counts = dict.fromkeys(frames.splits, 0)
    targets = []
    for _, sample in blocks(frames):
        z_m = quantity_m(frames, sample, quantity)
        for k in range(len(z_m)):
            split = frames.splits[int(sample["split_index"][k])]
            scene, image = divmod(counts[split], IMAGES_PER_SCENE)
            counts[split] += 1
            if image == 0:
                if split in scenes:
                    scenes[split].finish()
                kind = split if split.startswith(_SPLITS) else f"train_{split}"
                scenes[split] = _Scene(folder / kind / f"{scene:06d}")
            class_index = int(sample["class_index"][k])
            rotation, translation_m = _pose(frames, sample, k, centres[class_index])
            truth = {
                "cam_R_m2c": rotation.ravel().tolist(), "cam_t_m2c": (translation_m * _MM).tolist(),
                "obj_id": class_index + 1,
            }  # fmt: skip
            depth, grey = to_codes(z_m[k], metres_per_unit), _grey(sample, k, brightest)
            scenes[split].add(image, depth, grey, sample["coverage"][k] >= 0.5, projection, truth)
            if split == "test":
                targets.append({"im_id": image, "inst_count": 1, "obj_id": class_index + 1, "scene_id": scene})
    for last in scenes.values():
        last.finish()
    if targets:
        _write_json(folder / "test_targets_bop19.json", targets)


class _Scene:
    """One scene's folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        for name in ("depth", "gray", "mask", "mask_visib"):
            (folder / name).mkdir(parents=True)
        self._facts: dict[str, dict[str, Any]] = {"camera": {}, "gt": {}, "gt_info": {}}

    def add(
        self, image: int, depth: _Picture, grey: _Picture, mask: _Picture, camera: dict[str, Any], truth: dict[str, Any]
    ) -> None:
        Image.fromarray(depth).save(self._folder / "depth" / f"{image:06d}.png")
        Image.fromarray(grey).save(self._folder / "gray" / f"{image:06d}.png")
        for name in ("mask", "mask_visib"):  # nothing stands before the landmark
            Image.fromarray(mask.astype(np.uint8) * 255).save(self._folder / name / f"{image:06d}_000000.png")
        box, count = _bounding_box(mask), int(mask.sum())
        self._facts["camera"][str(image)] = camera
        self._facts["gt"][str(image)] = [truth]
        self._facts["gt_info"][str(image)] = [
            {
                "bbox_obj": box, "bbox_visib": box, "px_count_all": count,
                "px_count_valid": int((mask & (depth > 0)).sum()), "px_count_visib": count,
                "visib_fract": 1.0 if count else 0.0,
            }
        ]  # fmt: skip

    def finish(self) -> None:
        for name, facts in self._facts.items():
            _write_json(self._folder / f"scene_{name}.json", facts)


def _grey(sample: dict[str, Any], k: int, brightest: float) -> NDArray[np.uint8]:
    if "amplitude_e" not in sample:
        return np.where(sample["flags"][k] == 0, 255, 0).astype(np.uint8)
    return np.asarray(np.clip(np.rint(255 * sample["amplitude_e"][k] / brightest), 0, 255), np.uint8)


def _bounding_box(mask: NDArray[np.bool_]) -> list[int]:
    """Return x, y, width and height of what is set; −1 throughout if nothing is, as the toolkit does."""
    if not mask.any():
        return [-1, -1, -1, -1]
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return [int(cols[0]), int(rows[0]), int(cols[-1] - cols[0] + 1), int(rows[-1] - rows[0] + 1)]


def _pose(
    frames: FrameSet, sample: dict[str, Any], k: int, centre_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation and translation from a model's frame to the optical one."""
    rotation, translation_m = landmark2cam(frames, sample, k)
    to_optical = CAM2OPTICAL @ frames.sensor.cam2level.T
    turned = to_optical @ rotation
    return turned, to_optical @ translation_m + turned @ centre_m


def _write_models(frames: FrameSet, folder: Path) -> list[NDArray[np.float64]]:
    """Write the models and what is known of them; return where each has its origin in the landmark frame."""
    folder.mkdir(parents=True)
    infos: dict[str, dict[str, Any]] = {}
    centres = []
    for number, name in enumerate(frames.classes, start=1):
        mesh = frames.mesh(name)
        centre = mesh.bounds.mean(axis=0)
        centres.append(np.asarray(centre, float))
        vertices = (np.asarray(mesh.vertices, float) - centre) * _MM
        model = trimesh.Trimesh(vertices, mesh.faces, process=False)
        content = trimesh.exchange.ply.export_ply(model, encoding="ascii", vertex_normal=True)
        (folder / f"obj_{number:06d}.ply").write_bytes(content)
        low, size = vertices.min(axis=0), np.ptp(vertices, axis=0)
        infos[str(number)] = {
            "diameter": float(pdist(vertices[ConvexHull(vertices).vertices]).max()),
            **{f"min_{axis}": float(low[k]) for k, axis in enumerate("xyz")},
            **{f"size_{axis}": float(size[k]) for k, axis in enumerate("xyz")},
        }
        turns = _symmetries(int(mesh.metadata["symmetry"]), centre * _MM)
        if turns:
            infos[str(number)]["symmetries_discrete"] = turns
    _write_json(folder / "models_info.json", infos)
    return centres


def _symmetries(fold: int, centre_mm: NDArray[np.float64]) -> list[list[float]]:
    """Return the turns about the landmark's axis that change nothing, as 4 × 4 matrices row by row, in mm."""
    found = []
    for k in range(1, fold):
        angle = 2 * math.pi * k / fold
        turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
        matrix = np.eye(4)
        matrix[:3, :3] = turn
        matrix[:3, 3] = turn @ centre_mm - centre_mm  # the axis passes the landmark's origin, not the model's
        found.append(matrix.ravel().tolist())
    return found


def _write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
