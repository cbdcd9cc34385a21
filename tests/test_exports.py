"""Exports hold the frames' own values, say what they are, and come back as they were."""

import json
from typing import Any

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from phasemark import InputFileError, OutputExistsError, UsageError
from phasemark.data import FramePlan, build_frames, read_frames
from phasemark.data.export import export_frames
from phasemark.render import Views, preset

MOUNT = {"bearing_offset_deg": 3.0, "height_offset_m": -0.03}  # two pixels aside and one down
SENSOR = preset("pmd-16x16").with_(**MOUNT)
PLAN = FramePlan(
    sensor_overrides=MOUNT,
    classes=["cone", "post"],
    views=12,
    frames_per_view=2,
    seed=3,
    distance_m={"uniform": [0.8, 1.5]},
    bearing_deg={"uniform": [-3, 3]},
    height_m={"uniform": [-0.03, 0.03]},
    splits={"train": 0.5, "test": 0.5},
)
"""No wall: some pixels are invalid."""


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    with build_frames(PLAN, tmp_path_factory.mktemp("frames") / "frames.h5") as opened:
        yield opened


def exported(frames, tmp_path, to, quantity=None):
    return export_frames(frames, tmp_path / f"out-{to}", to, quantity=quantity)


@pytest.mark.parametrize("quantity", ["range", "z"])
@pytest.mark.parametrize(
    ("to", "options", "tolerance_m"),
    [
        ("npz", {}, 1e-6),  # float32 of z, below 2 m
        ("csv", {}, 1e-8),  # nine digits
        ("png16", {}, 2e-4),  # half of 15 m / 65535
        ("rosbag", {}, 1e-6),
    ],
)
def test_frames_come_back_as_ranges(frames, tmp_path, to, options, tolerance_m, quantity):
    if to == "rosbag":
        pytest.importorskip("rosbags")
        topic = {"range": "/camera/range/image", "z": "/camera/depth/image_rect"}[quantity]
        path, options = exported(frames, tmp_path, to), {"topic": topic}
    else:
        path = exported(frames, tmp_path, to, quantity)
    back = read_frames(path, sensor=SENSOR, **options)
    expected = frames[:]["range_m"]
    np.testing.assert_array_equal(np.isnan(back.range_m[0]), np.isnan(expected))
    np.testing.assert_allclose(back.range_m[0], expected, rtol=0, atol=tolerance_m)


def test_range_and_z_are_told_apart(frames, tmp_path):
    of_range, of_z = (
        np.load(exported(frames, tmp_path, "npz", quantity).rename(tmp_path / quantity)) for quantity in ("range", "z")
    )
    assert (str(of_range["quantity"]), str(of_z["quantity"])) == ("range", "z")
    np.testing.assert_allclose(of_z["range"], of_range["range"] * SENSOR.axis_cosine(), rtol=1e-6)
    with pytest.raises(UsageError, match="quantity=… must be z for bop, got 'range'"):
        exported(frames, tmp_path, "bop", "range")
    with pytest.raises(UsageError, match=r"but .* says z"):
        read_frames(tmp_path / "z", sensor=SENSOR, quantity="range")
    table = exported(frames, tmp_path, "csv", "z")
    contradicting: tuple[dict[str, Any], ...] = ({"quantity": "range"}, {"unit": "cm"})
    for wrong in contradicting:
        with pytest.raises(UsageError, match=rf"{next(iter(wrong))}=… is .*, but .* says (z|m)"):
            read_frames(table, sensor=SENSOR, **wrong)


def test_an_image_states_its_quantity_and_scale(frames, tmp_path):
    folder = exported(frames, tmp_path, "png16", "z")
    facts = json.loads((folder / "frames.json").read_text())
    with Image.open(folder / "00000005.png") as image:
        assert isinstance(image, PngImageFile)
        assert image.text["quantity"] == facts["quantity"] == "z"
        assert float(image.text["metres_per_unit"]) == facts["metres_per_unit"]
        codes = np.asarray(image)
    assert codes.max() <= 65535
    expected = frames[5]["range_m"] * SENSOR.axis_cosine()
    np.testing.assert_array_equal(codes == 0, np.isnan(expected))
    # half a unit of rounding
    assert (
        np.nanmax(np.abs(np.where(codes, codes * facts["metres_per_unit"], np.nan) - expected))
        < 0.51 * facts["metres_per_unit"]
    )
    assert len(facts["frames"]) == 24
    assert facts["frames"][5]["class"] == frames[5]["class_name"]


def test_a_point_cloud_lies_on_the_pixels_rays(frames, tmp_path):
    cloud: Any = trimesh.load(exported(frames, tmp_path, "ply") / "00000003.ply")
    range_m = frames[3]["range_m"]
    seen = np.isfinite(range_m)
    np.testing.assert_allclose(np.linalg.norm(cloud.vertices, axis=1), range_m[seen], rtol=1e-6)
    rows, cols = np.nonzero(seen)
    tangent = np.tan(np.deg2rad(11))
    # PHYSICS section 2: d ∝ (1, tan α (1 − 2u/cols), tan α (1 − 2v/rows)) at the pixel's centre
    np.testing.assert_allclose(cloud.vertices[:, 1] / cloud.vertices[:, 0], tangent * (1 - (cols + 0.5) / 8), atol=1e-6)
    np.testing.assert_allclose(cloud.vertices[:, 2] / cloud.vertices[:, 0], tangent * (1 - (rows + 0.5) / 8), atol=1e-6)


def test_point_clouds_of_a_tilted_camera_are_level(tmp_path):
    pitch = {"uniform": [5.0, 10.0]}
    tilted = FramePlan(classes=["cone"], views=3, distance_m=1.0, floor_m=0.2, pitch_deg=pitch, roll_deg=4.0)
    with build_frames(tilted, tmp_path / "frames.h5") as frames:
        folder = export_frames(frames, tmp_path / "ply", "ply")
    for number in range(3):
        cloud: Any = trimesh.load(folder / f"{number:08d}.ply")
        on_floor = cloud.vertices[:, 2] < -0.17  # below the cone
        assert on_floor.sum() > 10
        assert np.median(cloud.vertices[on_floor, 2]) == pytest.approx(-0.2, abs=4e-3)


def read_json_file(path):
    """Load JSON as bop_toolkit does: keys that are numbers become numbers."""

    def with_numbers(pairs):
        return {int(key) if key.lstrip("-").isdigit() else key: value for key, value in pairs.items()}

    return json.loads(path.read_text(), object_hook=with_numbers)


@pytest.fixture(scope="module")
def bop(frames, tmp_path_factory):
    return export_frames(frames, tmp_path_factory.mktemp("bop") / "bop", "bop")


def bop_images(folder):
    """Yield split, scene, and number, camera, truth and facts of each image."""
    for kind in ("train", "test"):
        for scene in sorted((folder / kind).iterdir()):
            camera, truth, info = (read_json_file(scene / f"scene_{name}.json") for name in ("camera", "gt", "gt_info"))
            assert set(camera) == set(truth) == set(info)
            for key in truth:
                yield kind, scene, key, camera[key], truth[key][0], info[key][0]


def test_bop_depth_and_masks_fit_the_projected_model(frames, bop):
    infos = read_json_file(bop / "models" / "models_info.json")
    models: dict[int, Any] = {k: trimesh.load(bop / "models" / f"obj_{k:06d}.ply", process=False) for k in infos}
    count = 0
    for kind, scene, key, camera, truth, info in bop_images(bop):
        sample = frames[frames.split(kind)[key + 1000 * int(scene.name)]]
        assert frames.classes[truth["obj_id"] - 1] == sample["class_name"]
        matrix = np.reshape(camera["cam_K"], (3, 3))
        rotation, translation = np.reshape(truth["cam_R_m2c"], (3, 3)), np.array(truth["cam_t_m2c"])
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0
        points = models[truth["obj_id"]].vertices @ rotation.T + translation
        u, v, w = matrix @ points.T
        box = info["bbox_obj"]
        low, high = np.min([u / w, v / w], axis=1), np.max([u / w, v / w], axis=1)
        inside = np.clip(low, 0, 15), np.clip(high, 0, 15)
        # a pixel is in the mask when half of it sees the landmark: its centre is about half a pixel within the outline;
        # the tip of a cone fills half a pixel only some way down
        np.testing.assert_allclose(box[0], inside[0][0], atol=1)
        np.testing.assert_allclose(box[1], inside[0][1], atol=2)
        np.testing.assert_allclose([box[0] + box[2] - 1, box[1] + box[3] - 1], inside[1], atol=1)
        with Image.open(scene / "depth" / f"{key:06d}.png") as image:
            assert image.mode == "I;16"
            depth_mm = np.asarray(image) * camera["depth_scale"]
        expected = np.nan_to_num(1000 * sample["range_m"] * SENSOR.axis_cosine())
        np.testing.assert_allclose(depth_mm, expected, atol=0.51 * camera["depth_scale"])
        for name in ("mask", "mask_visib"):
            with Image.open(scene / name / f"{key:06d}_000000.png") as image:
                assert image.mode == "L"
                mask = np.asarray(image) > 0
            assert mask.sum() == info["px_count_all"]
        assert info["px_count_valid"] == (mask & (depth_mm > 0)).sum()
        assert info["visib_fract"] == info["px_count_visib"] / info["px_count_all"] == 1
        with Image.open(scene / "gray" / f"{key:06d}.png") as image:
            assert (image.mode, image.size) == ("L", (16, 16))
        count += 1
    assert count == 24
    targets = read_json_file(bop / "test_targets_bop19.json")
    assert len(targets) == len(frames.split("test"))
    for target in targets:
        truths = read_json_file(bop / "test" / f"{target['scene_id']:06d}" / "scene_gt.json")
        assert [truth["obj_id"] for truth in truths[target["im_id"]]] == [target["obj_id"]]


def test_a_bop_model_is_in_millimetres_about_its_centre_and_knows_its_symmetry(bop):
    folder = bop / "models"
    info = json.loads((folder / "models_info.json").read_text())["1"]
    model: Any = trimesh.load(folder / "obj_000001.ply", process=False)
    np.testing.assert_allclose(model.bounds.mean(axis=0), 0, atol=1e-3)
    np.testing.assert_allclose([info["size_x"], info["size_y"], info["size_z"]], [240, 160, 300], atol=1e-3)
    # the tip of the cone is nearer to the box's corners than these are to each other: 3D diagonal of the box
    assert abs(info["diameter"] - max(np.sqrt(240**2 + 160**2 + 150**2), np.sqrt(120**2 + 80**2 + 300**2))) < 1e-3
    (turn,) = info["symmetries_discrete"]
    turned = model.vertices @ np.reshape(turn, (4, 4))[:3, :3].T + np.reshape(turn, (4, 4))[:3, 3]
    distance = np.linalg.norm(turned[:, None] - model.vertices[None, :400], axis=2).min(axis=0)
    assert np.median(distance) < 1.0  # mm: the turned box has its corners where it had them


def read_bop_ply(path):
    """Load a model by bop_toolkit's rules: ASCII, four types, a vertex or three indices a line; strict in all of it."""
    lines = path.read_text("ascii").splitlines()
    assert lines[:2] == ["ply", "format ascii 1.0"]
    header = lines[: lines.index("end_header")]
    words = [line.split() for line in header if line.startswith(("element", "property"))]
    assert [word[1] for word in words if word[0] == "element"] == ["vertex", "face"]
    n_vertices, n_faces = (int(word[2]) for word in words if word[0] == "element")
    first_face = next(k for k, word in enumerate(words) if word[:2] == ["element", "face"])
    properties = words[1:first_face]
    assert {word[1] for word in properties} <= {"float", "double", "int", "uchar"}
    assert [word[2] for word in properties[:6]] == ["x", "y", "z", "nx", "ny", "nz"]
    (of_faces,) = words[first_face + 1 :]
    assert of_faces[:2] == ["property", "list"]
    assert {of_faces[2], of_faces[3]} <= {"uchar", "int"}
    assert of_faces[4] in ("vertex_indices", "vertex_index")
    body = [line.split() for line in lines[len(header) + 1 :] if line]
    assert len(body) == n_vertices + n_faces
    vertices = np.array([line[:6] for line in body[:n_vertices]], float)
    faces = np.array(body[n_vertices:], int)
    assert (faces[:, 0] == 3).all()
    return vertices[:, :3], vertices[:, 3:], faces[:, 1:4]


def test_bop_models_load_as_the_toolkit_loads_them(bop):
    camera = read_json_file(bop / "camera.json")
    assert set(camera) >= {"width", "height", "fx", "fy", "cx", "cy", "depth_scale"}
    infos = read_json_file(bop / "models" / "models_info.json")
    assert sorted(infos) == [1, 2]  # object numbers count from 1
    for number, info in infos.items():
        points, normals, faces = read_bop_ply(bop / "models" / f"obj_{number:06d}.ply")
        assert faces.max() < len(points)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-4)
        for k, axis in enumerate("xyz"):
            np.testing.assert_allclose(points[:, k].min(), info[f"min_{axis}"], atol=1e-3)
            np.testing.assert_allclose(np.ptp(points[:, k]), info[f"size_{axis}"], atol=1e-3)
        for turn in info.get("symmetries_discrete", []):
            np.testing.assert_allclose(np.reshape(turn, (4, 4))[3], [0, 0, 0, 1])


def write_bag(folder, images, encodings=("", "mono8", "16UC1", "", "32FC1")):
    """Write a bag of images: topic, stamp in nanoseconds and values, float32 metres or uint16 mm."""
    rosbags = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    image, header, stamp = (
        store.types[name] for name in ("sensor_msgs/msg/Image", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    links = {}
    with rosbags.Writer(folder, version=9) as writer:
        for k, (topic, time_ns, data) in enumerate(images):
            if topic not in links:
                links[topic] = writer.add_connection(topic, "sensor_msgs/msg/Image", typestore=store)
            at = stamp(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
            message = image(
                header=header(stamp=at, frame_id="camera"), height=len(data), width=data.shape[1],
                encoding=encodings[data.dtype.itemsize], is_bigendian=0, step=data.strides[0],
                data=data.view(np.uint8).ravel(),
            )  # fmt: skip
            writer.write(links[topic], k * 10**6, store.serialize_cdr(message, "sensor_msgs/msg/Image"))
    return folder


def test_a_bag_whose_images_are_millimetres_and_metres_is_refused(tmp_path):
    both = [
        ("/tof/depth", k * 10**9, np.full((8, 8), value)) for k, value in enumerate((np.uint16(700), np.float32(0.7)))
    ]
    with pytest.raises(InputFileError, match="'/tof/depth' must hold images of one encoding, 16UC1"):
        read_frames(write_bag(tmp_path / "both", both), sensor=preset("vl53l5cx-8x8"), quantity="z")


def test_depth_in_mono16_is_millimetres_beside_amplitudes_that_are_not_read(tmp_path):
    images = [
        (topic, k * 10**9, np.full((8, 8), 700 + k if kind is np.uint16 else 9, kind))
        for k in range(2)
        for topic, kind in (("/tof/depth", np.uint16), ("/camera/amplitude/image", np.uint8))
    ]
    bag = write_bag(tmp_path / "bag", images, ("", "mono8", "mono16"))
    reading: Any = {"sensor": preset("vl53l5cx-8x8"), "topic": "/tof/depth"}
    with pytest.warns(UserWarning, match="amplitudes in images of mono8: left out"):
        found = read_frames(bag, quantity="range", **reading)
    np.testing.assert_allclose(found.range_m[0, :, 0, 0], [0.7, 0.701])
    with pytest.warns(UserWarning, match="left out"), pytest.raises(UsageError, match="does not say its quantity"):
        read_frames(bag, **reading)


def test_stamps_of_a_bag_are_read_and_amplitudes_belong_to_the_image_of_their_stamp(tmp_path):
    """The recording began between an image and its amplitudes, and ended so."""
    depth, amplitude = "/camera/depth/image_rect", "/camera/amplitude/image"

    def images(topic, numbers, stamped=True):
        first_ns = 1_790_000_000 * 10**9
        return [
            (
                topic,
                (first_ns + k * 10**8) * stamped,
                np.full((16, 16), 100 * (topic == amplitude) + 1 + k / 10, np.float32),
            )
            for k in numbers
        ]

    shifted = read_frames(
        write_bag(tmp_path / "shifted", images(amplitude, range(5)) + images(depth, range(1, 4))), sensor=SENSOR
    )
    np.testing.assert_allclose(shifted.amplitude_e[0, :, 0, 0], [101.1, 101.2, 101.3], rtol=1e-6)
    np.testing.assert_allclose(np.diff(shifted.time_s[0]), 0.1, atol=1e-6)
    assert shifted.time_s[0, 0] == pytest.approx(1_790_000_000.1, abs=1e-6)
    unset = write_bag(tmp_path / "unset", images(depth, range(3), False) + images(amplitude, range(3), False))
    without = read_frames(unset, sensor=SENSOR)
    assert without.time_s is None
    np.testing.assert_allclose(without.amplitude_e[0, :, 0, 0], [101, 101.1, 101.2], rtol=1e-6)
    late = write_bag(tmp_path / "late", images(depth, range(4)) + images(amplitude, range(1, 4)))
    with pytest.warns(UserWarning, match="3 amplitudes of 4 images, not all of the same stamps: left out"):
        assert read_frames(late, sensor=SENSOR).amplitude_e is None
    twice = write_bag(tmp_path / "twice", images(depth, (0, 0, 1)))
    with pytest.warns(UserWarning, match="1 of 3 time stamps repeat, the first in image 1"):
        read_frames(twice, sensor=SENSOR)


def test_the_bag_is_a_ros_2_bag_with_labelled_quantities(frames, tmp_path):
    rosbags = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    seen = {}
    with rosbags.Reader(exported(frames, tmp_path, "rosbag")) as reader:
        for link, time_ns, raw in reader.messages():
            seen.setdefault(link.topic, []).append((time_ns, store.deserialize_cdr(raw, link.msgtype)))
    assert {topic: len(messages) for topic, messages in seen.items()} == {
        "/tf_static": 1, "/tf": 24, "/camera/depth/image_rect": 24, "/camera/range/image": 24,
        "/camera/amplitude/image": 24, "/camera/depth/camera_info": 24,
    }  # fmt: skip
    time_ns, depth = seen["/camera/depth/image_rect"][7]
    assert time_ns == round(7e9 / SENSOR.frame_rate_hz)
    shown = depth.encoding, depth.height, depth.width, depth.header.frame_id
    assert shown == ("32FC1", 16, 16, "camera_optical_frame")
    z = frames[7]["range_m"] * SENSOR.axis_cosine()
    np.testing.assert_allclose(depth.data.view("<f4").reshape(16, 16), z, rtol=1e-6)
    info = seen["/camera/depth/camera_info"][7][1]
    # the centre of the first pixel is at 0 in ROS: the middle of 16 pixels at 7.5
    np.testing.assert_allclose(
        info.k, [8 / np.tan(np.deg2rad(11)), 0, 7.5, 0, 8 / np.tan(np.deg2rad(11)), 7.5, 0, 0, 1]
    )
    pose = seen["/tf"][7][1].transforms[0]
    sample = frames[7]
    rotation, translation = Views.broadcast(
        sample["distance_m"], sample["delta_rad"], sample["bearing_rad"] + np.deg2rad(3), sample["height_m"] - 0.03
    ).landmark2cam()
    got = pose.transform
    np.testing.assert_allclose([got.translation.x, got.translation.y, got.translation.z], translation[0], atol=1e-12)
    np.testing.assert_allclose(matrix_of(got.rotation), rotation[0], atol=1e-12)
    static = seen["/tf_static"][0][1].transforms[0].transform.rotation
    # the optical frame's z axis points forward, its x axis to the right
    np.testing.assert_allclose(matrix_of(static), [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12)


def matrix_of(q):
    return trimesh.transformations.quaternion_matrix([q.w, q.x, q.y, q.z])[:3, :3]


def test_an_existing_folder_needs_force_and_is_replaced_whole(frames, tmp_path):
    folder = exported(frames, tmp_path, "ply")
    before = sorted(entry.name for entry in folder.iterdir())
    with pytest.raises(OutputExistsError, match="force=True"):
        exported(frames, tmp_path, "ply")
    export_frames(frames, folder, "png16", force=True)
    assert not set(before) & {entry.name for entry in folder.glob("*.ply")}
    export_frames(frames, folder, "ply", force=True)
    assert sorted(entry.name for entry in folder.iterdir()) == before
    assert len(list(folder.glob("*.ply"))) == 24
    assert [entry.name for entry in tmp_path.iterdir()] == ["out-ply"]


def test_an_unknown_format_is_named(frames, tmp_path):
    with pytest.raises(
        UsageError, match="to=… must be one of npz, csv, jsonl, png16, ply, bop, rosbag, webdataset, lerobot, got 'gif'"
    ):
        exported(frames, tmp_path, "gif")


def test_the_figure_of_a_frame_of_a_set_names_its_class_and_view(run, frames, tmp_path, monkeypatch):
    titles = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *where, **how: titles.append(figure.get_suptitle()))
    for index in (0, 5):
        run("frames", "show", frames.path, "--index", index, "-o", tmp_path / f"{index}.png")
        sample = frames[index]
        assert titles[-1].startswith(f"frame {index}: {sample['class_name']}, D = {sample['distance_m']:.3f} m, δ = ")
    assert titles[0] != titles[1].replace("frame 5", "frame 0")


def test_the_commands_export_import_and_show(run, frames, tmp_path):
    out = tmp_path / "set.npz"
    assert run("frames", "export", frames.path, "--to", "npz", "-o", out).code == 0
    assert run("frames", "import", out, "-o", tmp_path / "again.npz").code == 0
    assert run("frames", "show", out, "-o", tmp_path / "a.png").code == 0
    code, _, err = run("frames", "show", frames.path, "--index", 24, "-o", tmp_path / "c.png")
    assert (code, "--index must be below 24" in err) == (2, True)
    again = read_frames(tmp_path / "again.npz", sensor=SENSOR)
    np.testing.assert_array_equal(again.range_m[0], frames[:]["range_m"].astype(float))
