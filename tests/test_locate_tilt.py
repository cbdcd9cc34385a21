"""A tilted robot among walls: zones against rays, their slopes, height, pitch and roll with their covariance."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rig_trials import free_poses, random_room, ring_rig, room
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from phasemark import InputFileError, UsageError
from phasemark.cli import main
from phasemark.matcher.locate import Locator, Rig, WallMap, read_rig_recording
from phasemark.matcher.locate.kernel_arguments import Scan
from phasemark.matcher.locate.simulated import recording_bytes, simulated_recording
from phasemark.matcher.locate.smoothing import smoothed
from phasemark.matcher.locate.zones_in_space import SpaceModel

BOX = {"x_m": 2.2, "y_m": 0.9, "yaw_deg": 20, "size_m": [0.4, 0.3, 0.45]}
STEP = math.radians(45 / 8)


def in_space(rig, wall_map):
    return SpaceModel(rig, wall_map.outline(), rig.numbers(), wall_map)


def scan_of(sensors, frames=1):
    time_s = np.arange(frames) / 10
    track = np.column_stack([0.1 * time_s, -0.05 * time_s, 0.5 * time_s])
    return Scan(time_s, np.zeros((frames, sensors, 64)), time_s.copy(), track)


def triangles(wall_map):
    """Every face of walls, the box and the floor as triangles, by hand."""
    corners = []
    for wall in wall_map.walls:
        (ax, ay), (bx, by) = wall.from_m, wall.to_m
        corners.append([[ax, ay, 0], [bx, by, 0], [bx, by, 20], [ax, ay, 20]])
    for box in wall_map.box:
        turn = Rotation.from_euler("z", box.yaw_deg, degrees=True)
        low = turn.apply(np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.5 * np.array(box.size_m))
        low = low + np.array([box.x_m, box.y_m, box.z_m])
        high = low + np.array([0, 0, box.size_m[2]])
        corners += [high, *([low[k], low[k - 1], high[k - 1], high[k]] for k in range(4))]
    floor = wall_map.floor_m
    corners.append([[-9, -9, floor], [9, -9, floor], [9, 9, floor], [-9, 9, floor]])
    return np.array([[quad[i] for i in order] for quad in corners for order in ((0, 1, 2), (0, 2, 3))])


def zone_by_rays(faces, pose, row, column, rays=121):
    """Depth of a zone over a triangle of rays along rows and columns, weighted with the light that they return."""
    grid = (np.arange(rays) + 0.5 - rays / 2) / (rays / 2)
    (y, wide), (z, tall) = ((math.tan((3.5 - k) * STEP), 1.25 * STEP * (1 + math.tan((3.5 - k) * STEP) ** 2))
                            for k in (column, row))  # fmt: skip
    along = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    ray = np.column_stack([np.ones(len(along)), y + wide * along[:, 0], z + tall * along[:, 1]])
    world = ray @ pose[:3, :3].T
    nearest, light = np.full(len(ray), np.inf), np.zeros(len(ray))
    for a, b, c in faces:
        normal = np.cross(b - a, c - a)
        normal = normal / np.linalg.norm(normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = normal @ (a - pose[:3, 3]) / (world @ normal)  # along the boresight, for a ray has 1 there
        point = pose[:3, 3] + depth[:, None] * world
        inside = np.all([np.cross(q - p, point - p) @ normal >= -1e-12 for p, q in ((a, b), (b, c), (c, a))], axis=0)
        closer = inside & (depth > 0) & (depth < nearest)
        length = np.linalg.norm(ray, axis=1)
        nearest = np.where(closer, depth, nearest)
        light = np.where(closer, np.abs(world @ normal) / length / (depth * length) ** 2, light)
    weight = np.prod(1 - np.abs(along), axis=1) * light
    return np.average(nearest, weights=weight)


def test_the_depth_of_a_zone_is_the_mean_over_its_footprint_of_a_tilted_sensor():
    one = room(box=[BOX])
    rig = Rig(sensor=[{"name": "front", "x_m": 0.05, "y_m": -0.02, "z_m": 0.04, "yaw_deg": 10, "pitch_deg": 8}])
    theta = np.array([1.0, 0.8, 0.3, 0, 0, 0, 0, 0, 0.1, 0.05, -0.04])  # x, y, yaw; no others; height, pitch, roll
    seen = in_space(rig, one).prediction(theta, scan_of(1)).depth_m[0, 0].reshape(8, 8)
    body = Rotation.from_euler("ZYX", [0.3, 0.05, -0.04])
    pose = np.eye(4)
    pose[:3, :3] = (body * Rotation.from_euler("ZYX", [10, 8, 0], degrees=True)).as_matrix()
    pose[:3, 3] = np.array([1.0, 0.8, 0.6]) + body.apply([0.05, -0.02, 0.04])
    faces = triangles(one)
    rays = np.array([[zone_by_rays(faces, pose, row, column) for column in range(8)] for row in range(8)])
    assert_allclose(seen, rays, rtol=1.5e-2)  # at edges: weights are even over a quarter of a zone
    assert np.median(np.abs(seen - rays)) < 1e-3
    assert np.ptp(rays) > 1  # the top of the box, the floor and walls behind


def test_a_level_robot_sees_walls_as_the_plane_model_does_and_a_pitch_as_the_closed_form():
    wall = WallMap(walls_m=[[2, -9, 2, 9]])
    rig = Rig(sensor=[{"name": "front"}])
    theta = np.zeros(11)
    theta[9] = pitch = 0.1
    seen = in_space(rig, wall).prediction(theta, scan_of(1)).depth_m[0, 0].reshape(8, 8)
    up = np.tan((3.5 - np.arange(8)) * STEP)
    exact = 2 / (math.cos(pitch) + up * math.sin(pitch))  # the ray (1, y, up), looking down by the pitch
    assert_allclose(seen[:3], np.repeat(exact[:3, None], 8, axis=1), rtol=1e-3)  # the rows above the floor


def test_sensors_of_fewer_zones_have_them_in_the_first_rows_and_columns():
    wide, narrow = {"name": "a", "yaw_deg": 20}, {"name": "b", "yaw_deg": 20, "preset": "vl53l5cx-4x4"}
    one, theta = room(), np.zeros(13)
    theta[:3] = 1.0, 0.8, 0.3
    scan = Scan(np.zeros(1), np.zeros((1, 2, 64)), np.zeros(1), np.zeros((1, 3)))
    parts = [Rig(sensor=[wide, narrow]), Rig(sensor=[narrow])]
    both, alone = (
        SpaceModel(rig, one.outline(), rig.numbers(), one).prediction(theta[: 9 + 2 * len(rig.sensor)], part)
        for rig, part in zip(parts, (scan, scan._replace(depth_m=np.zeros((1, 1, 16)))), strict=True)
    )
    seen = both.depth_m[0, 1].reshape(8, 8)
    assert_allclose(seen[:4, :4], alone.depth_m[0, 0].reshape(4, 4))
    assert np.isnan(seen[4:]).all()
    assert np.isnan(seen[:, 4:]).all()


def test_slopes_of_zones_are_those_of_their_depths():
    rig, one = ring_rig(2), room(box=[BOX])
    model, step = in_space(rig, one), 2e-4
    theta = np.array([1.0, 0.8, 0.4, 0.02, -0.01, 0.003, 0.004, -0.002, 0.01, -0.005, 0.02, 0.03, -0.02])
    scan = scan_of(2, frames=2)
    slope = model.prediction(theta, scan).slope
    column = [0, 1, 2, 3, 4, 5, None, None, 6, 6, 11, 12, 13]
    for p, at in enumerate(column):
        up, down = (model.prediction(theta + sign * step * (np.arange(13) == p), scan).depth_m for sign in (1, -1))
        found = (up - down) / (2 * step)
        stated = np.ones_like(found) if at is None else slope[..., at]
        if 6 <= p < 10:
            found, stated = found[:, p % 2], stated[:, p % 2]
        off = np.abs(found - stated) / (np.abs(found).max() + 1e-3)
        assert np.median(off) < 1e-3
        assert (off > 0.03).sum() <= 1  # an edge along a border of cells, where weights step


def tilted_stops(maps, seed, sensors=4):
    """Errors of accepted poses and tilts over random rooms, and squared errors in their covariances."""
    rng = np.random.default_rng(seed)
    std = np.array([0.2, 0.2, 0.09])
    nees, of_tilt, off = [], [], []
    for _ in range(maps):
        one, rig = random_room(rng), ring_rig(sensors, noise={"outliers": 0.02})
        flat = free_poses(one, 1, rng)
        tilt = np.array([0.5, 0, 0]) + np.array([0.05, 0.05, 0.05]) * rng.standard_normal(3)
        truth = np.concatenate([flat, tilt[None]], axis=1)
        recording = simulated_recording(one, rig, truth, rng)
        (answer,) = Locator(one, rig, with_tilt=True).locate(recording, flat + std * rng.standard_normal((1, 3)), std)
        if not answer.accepted:
            continue
        wrong = answer.pose - flat[0]
        wrong[2] = math.remainder(wrong[2], math.tau)
        values, covariance = answer.tilt
        nees.append(wrong @ np.linalg.solve(answer.covariance, wrong))
        of_tilt.append((values - tilt) @ np.linalg.solve(covariance, values - tilt))
        off.append(values - tilt)
    return np.array(nees), np.array(of_tilt), np.array(off)


def test_height_pitch_and_roll_have_the_covariance_that_is_stated():
    nees, of_tilt, off = tilted_stops(maps=12, seed=4)
    assert len(nees) > 8
    high = chi2.ppf(0.999, 3 * len(nees))
    assert nees.sum() < 1.1 * high
    assert of_tilt.sum() < 1.2 * high
    height, pitch, roll = np.sqrt(np.mean(off**2, axis=0))
    assert height < 0.04  # drawn with 0.05 m and 2.9°
    assert max(pitch, roll) < math.radians(1.5)


@pytest.mark.soak
def test_height_pitch_and_roll_of_many_rooms_have_the_covariance_that_is_stated():
    nees, of_tilt, _ = tilted_stops(maps=300, seed=8)
    assert len(nees) > 270
    assert 0.9 < nees.mean() / 3 < 1.15
    assert 0.9 < of_tilt.mean() / 3 < 1.25


def test_a_tilt_that_the_plane_model_takes_for_a_wrong_pose_is_found(tmp_path, capsys):
    one, rig = room(box=[BOX]), ring_rig(4)
    truth = np.array([[1.0, 0.8, 0.3, 0.45, 0.12, -0.1]])
    recording = simulated_recording(one, rig, truth, np.random.default_rng(3))
    (tmp_path / "room.toml").write_text(one.to_toml())
    (tmp_path / "rig.toml").write_text(ring_rig(4, stop={"tilt_deg": 6.0}).to_toml())
    (tmp_path / "zones.npz").write_bytes(recording_bytes(recording, rig))
    (tmp_path / "start.csv").write_text("stop,x_m,y_m,yaw_deg\n0,1.1,0.9,20\n")
    files = [str(tmp_path / name) for name in ("room.toml", "rig.toml", "zones.npz")]
    out = tmp_path / "poses.csv"
    assert main(["locate", *files, "--start", str(tmp_path / "start.csv"), "--tilt", "-o", str(out)]) == 0
    head, row = (line.split(",") for line in out.read_text().splitlines())
    found = dict(zip(head, row, strict=True))
    assert found["accepted"] == "1"
    for name, value in (("z_m", 0.45), ("pitch_deg", math.degrees(0.12)), ("roll_deg", math.degrees(-0.1))):
        std = float(found[name.replace("_", "_std_")])
        assert abs(float(found[name]) - value) < 4 * std
        assert std < (0.05 if name == "z_m" else 3.0)
    capsys.readouterr()


def test_columns_alone_tell_no_tilt(tmp_path, capsys):
    one, rig = room(), ring_rig(2)
    recording = simulated_recording(one, rig, [[1.0, 0.8, 0.3]], np.random.default_rng(3))
    with pytest.raises(UsageError, match="z, pitch and roll need rows of zones, and 'simulated' has columns alone"):
        Locator(one, rig, with_tilt=True).locate(recording)


def test_ranges_of_zones_become_depths_by_the_angle_of_their_rays(tmp_path):
    one, rig = WallMap(walls_m=[[2, -9, 2, 9]]), Rig(sensor=[{"name": "front"}])
    tangent = np.tan((3.5 - np.arange(8)) * STEP)
    ranges = 2 * np.sqrt(1 + tangent[:, None] ** 2 + tangent**2)
    np.savez(tmp_path / "ranges.npz", range_m=ranges[None, None, None], frame_time_s=[0.0])
    recording = read_rig_recording(tmp_path / "ranges.npz", rig)
    assert_allclose(recording.zone_m, 2)
    assert_allclose(recording.depth_m, 2)
    assert len(one.scene()) == 2


def test_parts_of_a_recording_keep_its_rows(tmp_path):
    rig = ring_rig(2)
    recording = simulated_recording(room(), rig, [[1.0, 0.8, 0.3, 0.5, 0, 0]] * 3, np.random.default_rng(1),
                                    time_s=[0.0, 0.1])  # fmt: skip
    (tmp_path / "zones.npz").write_bytes(recording_bytes(recording, rig))
    again = read_rig_recording(tmp_path / "zones.npz", rig)
    assert_allclose(again.zone_m, recording.zone_m, atol=1e-6)
    assert_allclose(again.one(2).zone_m[0], again.zone_m[2])
    assert np.isnan(again.first_frames(1).zone_m[:, 1]).all()
    assert again.zones(0, 3).depth_m.shape == (2, 2, 64)
    wide = ring_rig(2, reduction={"rows": [0, 9]})
    with pytest.raises(InputFileError, match=r"zones.npz: 'reduction.rows' of the rig must be within its 8 rows"):
        read_rig_recording(tmp_path / "zones.npz", wide)


def test_a_stop_that_smoothing_locates_again_keeps_its_tilt():
    one, rig = room(box=[BOX]), ring_rig(4)
    truth = np.array([[1.0, 0.8, 0.3, 0.5, 0.05, -0.04], [1.2, 0.9, 0.4, 0.5, 0.05, -0.04]])
    recording = simulated_recording(one, rig, truth, np.random.default_rng(2))
    locator = Locator(one, rig, with_tilt=True)
    first, second = locator.follow(recording)
    assert first.accepted
    lost = replace(second, accepted=False, reason="ambiguous", tilt=None)
    again = smoothed(recording, [first, lost], locator)[1]
    assert again.accepted
    values, covariance = again.tilt
    assert (np.abs(values - truth[1, 3:]) < 4 * np.sqrt(np.diag(covariance))).all()
