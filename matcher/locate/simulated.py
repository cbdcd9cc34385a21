"""Recordings of a rig in a map as the model has them: for trials, and to try a rig before it is built."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark.matcher.locate.kernel_arguments import Scan
from phasemark.matcher.locate.plane import relative_pose
from phasemark.matcher.locate.recording import RigRecording, reduced_rows
from phasemark.matcher.locate.rig import OdometryDrift, Rig
from phasemark.matcher.locate.scan_fit import StopModel
from phasemark.matcher.locate.wall_map import WallMap
from phasemark.matcher.locate.zones_in_space import SpaceModel

_Float = NDArray[np.float64]


def simulated_recording(
    wall_map: WallMap,
    rig: Rig,
    poses: ArrayLike,
    rng: np.random.Generator,
    *,
    time_s: ArrayLike = (0.0,),
    moved: ArrayLike | None = None,
) -> RigRecording:
    """Draw a recording: noise, outliers and the unknowns of each stop as the rig states them.

    Parameters
    ----------
    wall_map : WallMap
    rig : Rig
    poses : (n, 3) or (n, 6) array_like
        True x, y (m), yaw (rad) at the first frame of each stop; with height above the map's zero (m), pitch and roll
        (rad) the recording has the rows of the presets.
    rng : numpy.random.Generator
    time_s : (F,) array_like
        Times of the frames of a stop.
    moved : (F, 3) array_like, optional
        How the odometry moves within each stop, in the body's frame. None: not at all.

    Returns
    -------
    RigRecording
    """
    truth, times = np.asarray(poses, np.float64), np.asarray(time_s, np.float64)
    track = np.zeros((len(times), 3)) if moved is None else np.asarray(moved, np.float64)
    parts, noise, rows = (rig, rig.outline_of(wall_map, in_space=truth.shape[1] == 6), rig.numbers()), rig.noise, 1
    model = StopModel(*parts)
    if truth.shape[1] == 6:
        rows = max(rows for rows, _ in rig.rows())
        model = SpaceModel(*parts, wall_map)
    std, columns = model.unknowns_std, model.numbers.columns
    shape = (len(times), len(columns), rows * int(columns.max()))
    depth = np.empty((len(truth), *shape))
    for k, pose in enumerate(truth):
        theta = np.concatenate([pose[:3], std * rng.standard_normal(len(std))])
        if len(pose) == 6:
            theta[-3:] = pose[3:] - [wall_map.height_m, 0.0, 0.0]
        seen = model.prediction(theta, Scan(times, np.empty(shape), times, track))
        own = seen.depth_m + model.sigma_m(seen) * rng.standard_normal(shape)
        elsewhere = rng.random(shape) < noise.outliers
        own = np.where(elsewhere, rng.uniform(0.0, noise.max_range_m, shape), own)
        depth[k] = np.where((own > 0) & (seen.depth_m < noise.max_range_m), own, np.nan)
    n, zones = len(truth), None
    if truth.shape[1] == 6:
        zones = depth.reshape(*depth.shape[:3], rows, -1)
        depth = reduced_rows(zones, rig)
    return RigRecording(
        depth, np.tile(times, (n, 1)), np.tile(track, (n, 1, 1)), _odometry(truth[:, :3], rig.odometry, rng),
        np.arange(n), np.zeros(n, np.int64), "simulated", None, "robot", ("",) * n, zones,
    )  # fmt: skip


def _odometry(truth: _Float, drift: OdometryDrift, rng: np.random.Generator) -> _Float:
    """Return the odometry of a path: true steps with errors of the drift's covariance."""
    odometry = truth.copy()
    for k in range(1, len(truth)):
        step = relative_pose(truth[k - 1], truth[k])
        step = step + rng.multivariate_normal(np.zeros(3), drift.covariance(step))
        odometry[k], _ = drift.moved(odometry[k - 1], np.zeros((3, 3)), step)
    return odometry


def recording_bytes(recording: RigRecording, rig: Rig) -> bytes:
    """Return a recording as the content of an NPZ file that :func:`~.recording.read_rig_recording` reads."""
    yaw = np.zeros(len(recording)) if recording.odometry is None else recording.odometry[:, 2]
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y, turned = np.moveaxis(recording.moved, -1, 0)
    arrays: dict[str, Any] = {
        "run": recording.run,
        "sensor": np.array(rig.names),
        "z_m": (recording.depth_m if recording.zone_m is None else recording.zone_m).astype(np.float32),
        "frame_time_s": recording.time_s,
        "stop": recording.stop,
        recording.robot_key: recording.robot,
    }
    if recording.odometry is not None:
        arrays |= {f"odometry_{name}": recording.odometry[:, k] for k, name in enumerate(("x_m", "y_m", "yaw_rad"))}
        arrays |= {"odo_dx_m": cos * x - sin * y, "odo_dy_m": sin * x + cos * y, "odo_dyaw_rad": turned}
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()
