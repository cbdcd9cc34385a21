"""Messages of ROS 2 as DDS types: final, in plain CDR, by the names and with the type hashes of ROS 2."""

# Importing this module needs cyclonedds.
# mypy: ignore-errors
# because its types are made as the module is imported

from typing import Any

from phasemark.inputs.extras import needed

_idl = needed("cyclonedds.idl", "the sink 'ros'", "dds")
_types, _annotations = needed("cyclonedds.idl.types", "", "dds"), needed("cyclonedds.idl.annotations", "", "dds")


def _message(package: str, name: str, **fields: Any) -> Any:
    """Return the type of a message with its fields in order."""
    kind = _idl.make_idl_struct(name, f"{package}::msg::dds_::{name}_", fields)
    return _annotations.final(kind)


_GEOMETRY, _double = "geometry_msgs", _types.float64
Time = _message("builtin_interfaces", "Time", sec=_types.int32, nanosec=_types.uint32)
Header = _message("std_msgs", "Header", stamp=Time, frame_id=str)
Point = _message(_GEOMETRY, "Point", x=_double, y=_double, z=_double)
Quaternion = _message(_GEOMETRY, "Quaternion", x=_double, y=_double, z=_double, w=_double)
Pose = _message(_GEOMETRY, "Pose", position=Point, orientation=Quaternion)
# the covariance row by row: x, y, z, about x, about y, about z
PoseWithCovariance = _message(_GEOMETRY, "PoseWithCovariance", pose=Pose, covariance=_types.array[_double, 36])
PoseWithCovarianceStamped = _message(
    "geometry_msgs", "PoseWithCovarianceStamped", header=Header, pose=PoseWithCovariance
)
PoseStamped = _message(_GEOMETRY, "PoseStamped", header=Header, pose=Pose)
String = _message("std_msgs", "String", data=str)

TYPE_HASHES = {
    PoseWithCovarianceStamped: "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    PoseStamped: "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    String: "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}
"""Hashes of the messages' definitions (REP 2011), which ROS 2 looks for in USER_DATA."""
