"""A rig calibrated from stops with measured poses: simulated rigs are found again, within what is stated."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rig_trials import free_poses, ring_rig, room

from phasemark import UsageError
from phasemark.cli import main
from phasemark.matcher.locate import Rig, read_rig
from phasemark.matcher.locate.rig_calibration import calibrate_rig
from phasemark.matcher.locate.simulated import recording_bytes, simulated_recording

TRUE = {
    "yaw_deg": [0.8, -1.1, 1.4, -1.1],
    "delay_s": [0.05, 0.04, 0.03, 0.01],
    "range_offset_m": [0.004, -0.006, 0.008, 0.002],
}
TURN = np.column_stack([np.zeros(8), np.zeros(8), 0.6 * np.arange(8) / 7])


def recorded(stops=30, seed=1):
    """A rig that is off, the assumed one, and recordings with poses of a marker frame that is turned by 2°."""
    assumed, one = ring_rig(4), room(wall=[{"from": [1.6, 1.1], "to": [1.9, 1.3]}])
    sensors = []
    for k, sensor in enumerate(assumed.sensor):
        values = sensor.model_dump() | {name: getattr(sensor, name) + off[k] for name, off in TRUE.items()}
        sensors.append(values | {"range_scale": 1.006, "fov_deg": 46.5, "columns": 8})
    true = Rig(sensor=sensors, noise=assumed.noise, stop=assumed.stop)
    rng = np.random.default_rng(seed)
    poses = free_poses(one, stops, rng)
    recording = simulated_recording(one, true, poses, rng, time_s=np.arange(8) / 7.5, moved=TURN)
    measured = poses + np.array([0.002, 0.002, math.radians(0.15)]) * rng.standard_normal(poses.shape)
    measured[:, 2] -= math.radians(2.0)
    return true, assumed, one, recording, measured


def test_a_rig_is_found_within_what_is_stated():
    true, assumed, one, recording, measured = recorded()
    found = calibrate_rig(assumed, [recording], [one], [measured])
    assert found.doubts == ()
    assert found.rms[1] < 1.05
    for name, by in (("yaw_deg", "yaw_deg"), ("delay_s", "delay_s"), ("range_offset_m", "range_offset_m")):
        for sensor, expected in zip(found.rig.sensor, true.sensor, strict=True):
            std = getattr(sensor.std, by)
            assert abs(getattr(sensor, name) - getattr(expected, name)) < 4 * std + 1e-6
            assert std < 0.5 * getattr(assumed.sensor[0].std, by)
    assert abs(found.rig.sensor[0].fov_deg - 46.5) < 4 * found.rig.sensor[0].std.fov_deg
    assert abs(found.rig.sensor[0].range_scale - 1.006) < 4 * found.rig.sensor[0].std.range_scale
    ((_, _, marker),) = found.markers
    assert abs(math.degrees(marker[2]) - 2.0) < 0.3  # 30 stops of 0.15° each, and of the sensors' mean yaw


def test_poses_of_another_point_of_the_robot_and_a_silent_sensor_are_doubted():
    """Ten centimetres became 20 mm of range offset, trusted."""
    rng, one, rig = np.random.default_rng(3), room(), ring_rig(4)
    poses = free_poses(one, 15, rng)
    recording = simulated_recording(one, rig, poses, rng, time_s=np.arange(8) / 7.5, moved=TURN)
    beside = poses + 0.1 * np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2]), np.zeros(15)])
    (doubt,) = calibrate_rig(rig, [recording], [one], [beside]).doubts
    assert doubt.startswith("poses of simulated, robot 0, are of a point")
    ranges = recording.depth_m * np.hypot(1, np.tan((3.5 - np.arange(8)) * math.radians(45 / 8)))
    (doubt,) = calibrate_rig(rig, [replace(recording, depth_m=ranges)], [one], [poses]).doubts
    assert doubt.endswith("is 'quantity' of the rig right, and [noise]?")
    recording.depth_m[:, :, 1] = np.nan
    assert calibrate_rig(rig, [recording], [one], [poses]).doubts == ("s1 has no depths",)


def test_a_rig_that_is_right_is_not_doubted_for_residuals_that_come_and_go():
    for seed in range(4):
        rng = np.random.default_rng([7, seed])
        one, rig = room(), ring_rig(4)
        poses = free_poses(one, 15, rng)
        recording = simulated_recording(one, rig, poses, rng, time_s=np.arange(8) / 7.5, moved=TURN)
        measured = poses + np.array([0.002, 0.002, math.radians(0.15)]) * rng.standard_normal(poses.shape)
        assert calibrate_rig(rig, [recording], [one], [measured]).doubts == ()


def test_one_sensor_of_eight_that_looks_elsewhere_is_named():
    rng, one, rig = np.random.default_rng(8), room(), ring_rig(8)
    turned = rig.sensor[2].model_copy(update={"yaw_deg": rig.sensor[2].yaw_deg + 180})
    true = rig.model_copy(update={"sensor": (*rig.sensor[:2], turned, *rig.sensor[3:])})
    poses = free_poses(one, 15, rng)
    recording = simulated_recording(one, true, poses, rng, time_s=np.arange(8) / 7.5, moved=TURN)
    found = calibrate_rig(rig, [recording], [one], [poses])
    assert any(doubt.endswith("% of the columns of s2 are explained, 70 % are needed") for doubt in found.doubts)


def test_walls_that_stand_elsewhere_are_found():
    _, assumed, one, recording, measured = recorded(seed=2)
    believed = one.model_copy(update={"std_m": 0.03}).with_walls_moved(np.array([0.02, *[0.0] * 6]))
    believed = believed.model_copy(update={"wall": tuple(w.model_copy(update={"std_m": 0.03}) for w in believed.wall)})
    found = calibrate_rig(assumed, [recording], [believed], [measured],
                          ("yaw", "delay", "offset", "scale", "fov", "walls"))  # fmt: skip
    assert abs(found.wall_m[0][0] + 0.02) < 0.008
    assert np.abs(found.wall_m[0][1:]).max() < 0.012  # beside an offset of all sensors, 10 mm before


def test_a_calibration_that_cannot_be_is_refused():
    _, assumed, one, recording, measured = recorded(stops=6)
    with pytest.raises(UsageError, match=r"'free' must be of yaw, position, .* got 'tilt'"):
        calibrate_rig(assumed, [recording], [one], [measured], ("tilt",))
    with pytest.raises(UsageError, match="at least 5 stops must have a pose, got 2"):
        calibrate_rig(assumed, [recording], [one], [np.where(np.arange(6)[:, None] < 2, measured, np.nan)])
    with pytest.raises(UsageError, match="'std_m' of a map's walls must be positive"):
        calibrate_rig(assumed, [recording], [one], [measured], ("yaw", "walls"))
    with pytest.raises(UsageError, match="1 recordings, 1 maps and 2 tables"):
        calibrate_rig(assumed, [recording], [one], [measured, measured])


def test_the_command_writes_a_rig_that_locate_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    _, assumed, one, recording, measured = recorded(stops=12)
    (tmp_path / "rig.toml").write_text(assumed.to_toml())
    (tmp_path / "room.toml").write_text(one.to_toml())
    (tmp_path / "drive.npz").write_bytes(recording_bytes(recording, assumed))
    rows = [f"{k},{x},{y},{math.degrees(a)}" for k, (x, y, a) in enumerate(measured)]
    (tmp_path / "poses.csv").write_text("\n".join(["stop,x_m,y_m,yaw_deg", *rows]))
    drive, out = str(tmp_path / "drive.npz"), tmp_path / "calibrated.toml"
    rig = ["--rig", str(tmp_path / "rig.toml")]
    command = ["calibrate", drive, *rig, "--map", str(tmp_path / "room.toml"), "--poses", str(tmp_path / "poses.csv")]
    assert main([*command, "-o", str(out)]) == 0
    assert "a turn of all of them is one of the marker frames" in capsys.readouterr().out
    assert read_rig(out).sensor[0].std.yaw_deg < 1.0
    table = str(tmp_path / "found.csv")
    assert (
        main(
            [
                "locate",
                str(tmp_path / "room.toml"),
                str(out),
                drive,
                "--start",
                str(tmp_path / "poses.csv"),
                "-o",
                table,
            ]
        )
        == 0
    )
    assert main(["calibrate", drive, *rig, "--poses", str(tmp_path / "poses.csv"), "-o", str(tmp_path / "b.toml")]) == 2
    assert "--rig needs --map" in capsys.readouterr().err
    assert main(["calibrate", "cylinder", "--poses", str(tmp_path / "poses.csv"), "-o", str(tmp_path / "b.toml")]) == 2
    assert "missing argument FRAMES" in capsys.readouterr().err
