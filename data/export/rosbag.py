"""Frames as a ROS 2 bag: images of z and of range under topics of their own, CameraInfo, TF of the truth."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from phasemark import StorageError
from phasemark.data.export.samples import CAM2OPTICAL, blocks, landmark2cam, pinhole, ros_distortion
from phasemark.data.frames.frame_set_file import FrameSet
from phasemark.data.measured.bags import AMPLITUDE_TOPIC, INFO_TOPIC, RANGE_TOPIC, Z_TOPIC, ros_types
from phasemark.data.measured.reading import RangeOrZ

NAME = "frames"
"""What the file in a bag's folder is called."""

_OPTICAL, _CAMERA, _LANDMARK = "camera_optical_frame", "camera_link", "landmark"


def write_rosbag(frames: FrameSet, folder: Path, quantity: RangeOrZ) -> None:
    """Write a bag: a depth image is z by ROS's convention (REP 118), so radial range has a topic of its own."""
    store = ros_types()
    from rosbags.rosbag2 import Writer

    bag = folder / NAME  # the writer makes this folder, and names the file in it after it
    try:
        _write(frames, store, Writer(bag, version=8))
    except sqlite3.Error as error:
        raise StorageError(f"{folder.parent}: cannot write the bag ({error})") from None
    for entry in list(bag.iterdir()):
        entry.rename(folder / entry.name)
    bag.rmdir()


def _write(frames: FrameSet, store: Any, bag: Any) -> None:
    with bag as writer:
        topics = {
            Z_TOPIC: "sensor_msgs/msg/Image",
            RANGE_TOPIC: "sensor_msgs/msg/Image",
            INFO_TOPIC: "sensor_msgs/msg/CameraInfo",
            "/tf": "tf2_msgs/msg/TFMessage",
            "/tf_static": "tf2_msgs/msg/TFMessage",
        }
        if "amplitude_e" in frames[0]:
            topics[AMPLITUDE_TOPIC] = "sensor_msgs/msg/Image"
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in topics.items()}
        for topic, time_ns, message in _messages(frames, store):
            writer.write(connections[topic], time_ns, store.serialize_cdr(message, message.__msgtype__))


def _messages(frames: FrameSet, store: Any) -> Iterator[tuple[str, int, Any]]:
    sensor, types = frames.sensor, store.types
    static = _transform(types, 0, _CAMERA, _OPTICAL, (CAM2OPTICAL @ sensor.cam2level.T).T, np.zeros(3))
    yield "/tf_static", 0, types["tf2_msgs/msg/TFMessage"](transforms=[static])
    cosine = sensor.axis_cosine()
    for start, sample in blocks(frames):
        for k in range(len(sample["view"])):
            time_ns = round((start + k) * 1e9 / sensor.frame_rate_hz)
            header = _header(types, time_ns, _OPTICAL)
            range_m = np.asarray(sample["range_m"][k], np.float32)
            yield Z_TOPIC, time_ns, _image(types, header, (range_m * cosine).astype("<f4"))
            yield RANGE_TOPIC, time_ns, _image(types, header, range_m)
            if "amplitude_e" in sample:
                yield AMPLITUDE_TOPIC, time_ns, _image(types, header, sample["amplitude_e"][k])
            yield INFO_TOPIC, time_ns, _camera_info(types, header, frames)
            landmark = f"{_LANDMARK}_{sample['class_name'][k]}"
            pose = _transform(types, time_ns, _CAMERA, landmark, *landmark2cam(frames, sample, k))
            yield "/tf", time_ns, types["tf2_msgs/msg/TFMessage"](transforms=[pose])


def _header(types: Any, time_ns: int, frame: str) -> Any:
    stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def _image(types: Any, header: Any, values: NDArray[Any]) -> Any:
    rows, cols = values.shape
    return types["sensor_msgs/msg/Image"](
        header=header, height=rows, width=cols, encoding="32FC1", is_bigendian=0, step=4 * cols,
        data=np.ascontiguousarray(values, "<f4").reshape(-1).view(np.uint8),
    )  # fmt: skip


def _camera_info(types: Any, header: Any, frames: FrameSet) -> Any:
    fx, fy, cx, cy = pinhole(frames)
    model, coefficients = ros_distortion(frames.sensor)
    region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return types["sensor_msgs/msg/CameraInfo"](
        header=header, height=frames.sensor.rows, width=frames.sensor.cols, distortion_model=model,
        d=np.array(coefficients), k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]), r=np.eye(3).ravel(),
        p=np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0]), binning_x=0, binning_y=0, roi=region,
    )  # fmt: skip


def _transform(
    types: Any, time_ns: int, parent: str, child: str, rotation: NDArray[np.float64], translation_m: NDArray[np.float64]
) -> Any:
    """Return the pose of the child frame in the parent's."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    vector = types["geometry_msgs/msg/Vector3"](*(float(value) for value in translation_m))
    transform = types["geometry_msgs/msg/Transform"](
        translation=vector, rotation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    )
    header = _header(types, time_ns, parent)
    return types["geometry_msgs/msg/TransformStamped"](header=header, child_frame_id=child, transform=transform)
