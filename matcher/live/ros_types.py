"""Messages of ROS 2 as DDS types: final, in plain CDR, by the names and with the type hashes of ROS 2."""

# Annotations are evaluated: cyclonedds reads the types of fields. Importing this module needs cyclonedds.
# mypy: ignore-errors
# because its types are made as the module is imported

from dataclasses import dataclass
from typing import Any

from phasemark.matcher.live.extras import needed

idl = needed("cyclonedds.idl", "the sink 'ros'", "dds")
_types, _annotations = needed("cyclonedds.idl.types", "", "dds"), needed("cyclonedds.idl.annotations", "", "dds")


def _field(name: str) -> Any:
    return getattr(_types, name)


@dataclass
@_annotations.final
class Time(idl.IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """Time stamp."""

    sec: _field("int32")
    nanosec: _field("uint32")


@dataclass
@_annotations.final
class Header(idl.IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """Stamp and frame."""

    stamp: Time
    frame_id: str


@dataclass
@_annotations.final
class Point(idl.IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    """Position, metres."""

    x: _field("float64")
    y: _field("float64")
    z: _field("float64")


@dataclass
@_annotations.final
class Quaternion(idl.IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    """Orientation."""

    x: _field("float64")
    y: _field("float64")
    z: _field("float64")
    w: _field("float64")


@dataclass
@_annotations.final
class Pose(idl.IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    """Position and orientation."""

    position: Point
    orientation: Quaternion


@dataclass
@_annotations.final
class PoseWithCovariance(idl.IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    """Pose with its covariance, row by row: x, y, z, about x, about y, about z."""

    pose: Pose
    covariance: _types.array[_field("float64"), 36]


@dataclass
@_annotations.final
class PoseWithCovarianceStamped(idl.IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"):
    """Pose with its covariance, stamp and frame."""

    header: Header
    pose: PoseWithCovariance


@dataclass
@_annotations.final
class PoseStamped(idl.IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    """Pose with stamp and frame."""

    header: Header
    pose: Pose


@dataclass
@_annotations.final
class String(idl.IdlStruct, typename="std_msgs::msg::dds_::String_"):
    """Text."""

    data: str


TYPE_HASHES = {
    PoseWithCovarianceStamped: "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    PoseStamped: "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    String: "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}
"""Hashes of the messages' definitions (REP 2011), which ROS 2 looks for in USER_DATA."""
