"""ROS 2 bags of images, as they are read."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError, PhasemarkError
from phasemark.data.measured.recording import Recording, note_disorder
from phasemark.inputs import is_vouched_for
from phasemark.inputs.extras import needed

Z_TOPIC = "/camera/depth/image_rect"
RANGE_TOPIC = "/camera/range/image"
AMPLITUDE_TOPIC = "/camera/amplitude/image"
INFO_TOPIC = "/camera/depth/camera_info"
_KINDS = {"32FC1": "f4", "16UC1": "u2", "mono16": "u2"}


def ros_types() -> Any:
    """Return the message types of ROS 2.

    Raises
    ------
    UsageError
        The package rosbags is not installed.
    """
    typesys = needed("rosbags.typesys", "ROS bags", "ros", verb="need")
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


def read_rosbag(path: Path, topic: str | None) -> Recording:
    """Return the images of a bag, (frames, rows, cols), their stamps, and what the bag says of unit and quantity.

    Amplitudes belong to the ranges of their stamp, or to those of their number where there are as many.

    Parameters
    ----------
    path : Path
        The bag's folder.
    topic : str, optional
        Which images; needed if the bag has several that are not ours. Images of 32FC1 are metres, of 16UC1 mm.

    Raises
    ------
    InputFileError
        It is no bag, or has no depth images.

    Warns
    -----
    UserWarning
        Time stamps repeat or run backwards, or there are amplitudes of some ranges alone, which are left out.
    """
    store = ros_types()
    try:
        for file in sorted(path.iterdir()):
            if file.is_file():
                is_vouched_for(file)
        return _read(path, topic, store)
    except PhasemarkError:
        raise
    except Exception as error:  # whatever a damaged bag makes YAML, SQLite, MCAP and the messages' decoder say
        raise InputFileError(f"{path}: damaged, or no ROS 2 bag ({' '.join(str(error).split())[:300]})") from None


def _read(path: Path, topic: str | None, store: Any) -> Recording:
    from rosbags.rosbag2 import Reader

    found: dict[str, list[tuple[float, NDArray[Any]]]] = {}
    units, unread = set(), set()
    with Reader(path) as reader:
        of_images = [link for link in reader.connections if link.msgtype == "sensor_msgs/msg/Image"]
        names = [link.topic for link in of_images]
        chosen = topic or next((name for name in (RANGE_TOPIC, Z_TOPIC) if name in names), None)
        if chosen is None and len(set(names)) == 1:
            chosen = names[0]
        if chosen not in names:
            raise InputFileError(f"{path}: say with topic=… which images to read: it has {', '.join(names) or 'none'}")
        wanted = [link for link in of_images if link.topic in (chosen, AMPLITUDE_TOPIC)]
        for link, _, raw in reader.messages(connections=wanted):
            message = store.deserialize_cdr(raw, link.msgtype)
            if link.topic != chosen and message.encoding not in _KINDS:
                unread.add(message.encoding)
                continue
            stamp_s = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            found.setdefault(link.topic, []).append((stamp_s, _pixels(message, path)))
            if link.topic == chosen:
                units.add("m" if message.encoding == "32FC1" else "mm")
    images, stamped = [image for _, image in found.get(chosen, [])], found.get(AMPLITUDE_TOPIC, [])
    if not images or len({image.shape for image in images}) > 1:
        raise InputFileError(f"{path}: '{chosen}' must hold images of one size")
    if len(units) > 1:
        raise InputFileError(f"{path}: '{chosen}' must hold images of one encoding, 16UC1 (mm) or 32FC1 (m), not both")
    values, stamps = np.stack(images), [stamp_s for stamp_s, _ in found[chosen]]
    arrays = {"range": np.where(values == 0, np.nan, values)}
    by_stamp = dict(stamped)
    if len(set(stamps)) == len(stamps) and by_stamp.keys() >= set(stamps):
        arrays["amplitude"] = np.stack([by_stamp[stamp_s] for stamp_s in stamps])
    elif len(stamped) == len(images):
        arrays["amplitude"] = np.stack([image for _, image in stamped])
    elif stamped:
        warnings.warn(
            f"{path}: {len(stamped)} amplitudes of {len(images)} images, not all of the same stamps: left out",
            stacklevel=2,
        )
    if unread:
        warnings.warn(f"{path}: amplitudes in images of {', '.join(unread)}: left out", stacklevel=2)
    stated = {"unit": units.pop()}
    if chosen in (RANGE_TOPIC, Z_TOPIC):
        stated["quantity"] = "range" if chosen == RANGE_TOPIC else "z"
    if not any(stamps):  # nobody set them
        return Recording(arrays, stated, named=True)
    time_s = np.array(stamps)
    note_disorder(time_s, path, "image {}".format)
    return Recording(arrays, stated, time_s=time_s, named=True)


def _pixels(message: Any, path: Path) -> NDArray[Any]:
    if message.encoding not in _KINDS:
        raise InputFileError(f"{path}: images must be 32FC1 or 16UC1, got {message.encoding}")
    order = ">" if message.is_bigendian else "<"
    kind = np.dtype(order + _KINDS[message.encoding])
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    return rows[:, : message.width * kind.itemsize].copy().view(kind).astype(np.float64)
