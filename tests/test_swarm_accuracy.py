"""The example that scores recordings of a swarm: on simulated runs in the layout of that data set."""

import io
import math

import numpy as np
import pytest
from rig_trials import free_poses, room
from test_examples import run

from phasemark.matcher.locate import Rig, recording_bytes, simulated_recording

pytestmark = pytest.mark.docs
SENSORS = {
    "front": (0.02, 0.0, 0.0),
    "back": (-0.02, 0.0, 180.0),
    "left": (0.0, 0.025, 90.0),
    "right": (0.0, -0.025, -90.0),
}


def a_run(folder, name, seed):
    """Write a run of eight stops; motion capture is 1° off, and swapped at the last stop."""
    rng, one = np.random.default_rng(seed), room()
    rig = Rig(sensor=[{"name": each, "x_m": x, "y_m": y, "yaw_deg": yaw} for each, (x, y, yaw) in SENSORS.items()])
    poses = free_poses(one, 8, rng)
    turn = np.column_stack([np.zeros(3), np.zeros(3), [0.0, 0.2, 0.4]])
    recording = simulated_recording(one, rig, poses, rng, time_s=np.arange(3) / 7.5, moved=turn)
    arrays = dict(np.load(io.BytesIO(recording_bytes(recording, rig))))
    arrays |= {"run": name, "drone": arrays.pop("robot"), "odometry_yaw_rad": poses[:, 2]}
    cos, sin = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    arrays |= {"odo_dx_m": 0 * cos * turn[:, 0], "odo_dy_m": 0 * sin * turn[:, 0]}
    arrays |= {f"odometry_{axis}_m": poses[:, k] for k, axis in enumerate("xy")}
    for who, off in (("vicon", math.radians(1.0)), ("slam", 0.05)):
        arrays |= {f"{who}_x_m": poses[:, 0], f"{who}_y_m": poses[:, 1], f"{who}_yaw_rad": poses[:, 2] - off}
    arrays |= {f"vicon_{axis}_rad": np.where(np.arange(8) == 7, 1.0, 0.0) for axis in ("pitch", "roll")}
    np.savez(folder / f"{name}.npz", **arrays)


def test_the_swarm_example_scores_runs_with_rigs_of_the_others(tmp_path):
    a_run(tmp_path, "one", 1)
    a_run(tmp_path, "two", 2)
    walls = ", ".join(str(list(map(float, wall.ends_m))) for wall in room().walls)
    (tmp_path / "maps.toml").write_text(f'runs.one = "a"\nruns.two = "a"\n[maps.a]\nwalls_m = [{walls}]\n')
    code, out, err = run("swarm_accuracy", tmp_path, "--out", tmp_path / "out")
    assert (code, err) == (0, "")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in out.splitlines()[2:]]
    by_name = {row[0]: row[1:] for row in rows}
    assert by_name["the authors' SLAM"][5] == "14 of 14"  # the stop with swapped markers is not scored
    best = by_name["+ calibrated rig"]
    assert best[5:] == ["14 of 14", "0", "14 of 14"]
    assert float(best[2]) < 20.0
    assert 0.5 < float(best[1]) < 1.5  # the motion capture's degree
    assert float(best[3]) < 0.5
    assert (tmp_path / "out" / "poses.png").read_bytes().startswith(b"\x89PNG")
    code, out, err = run("swarm_accuracy", tmp_path / "out")
    assert (code, out, err.count("\n")) == (3, "", 1)
