"""ROS 2 over DDS, without ROS: poses and status as topics that any node with the DDS of ROS 2 receives."""

from __future__ import annotations

import json
import math
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.inputs.extras import needed
from phasemark.matcher.live.sinks import Sink, planar_covariance
from phasemark.matcher.live.status import Status
from phasemark.matcher.live.updates import Update

_DEPTH = 10


class RosSink(Sink):
    """Topics of ROS 2 in the domain ROS_DOMAIN_ID, 0 unless that is set.

    ==================  =========================================  ==============================================
    topic               type                                       content
    ==================  =========================================  ==============================================
    NAME/pose           geometry_msgs/PoseWithCovarianceStamped    accepted poses of the camera in the landmark's
                                                                   frame
    NAME/landmark_pose  geometry_msgs/PoseStamped                  the landmark seen from the camera, as docking
                                                                   takes it
    NAME/status         std_msgs/String                            JSON: rates, shares, why a pose is missing
    ==================  =========================================  ==============================================

    Parameters
    ----------
    name : str
    below : str
        NAME of the topics; the frames are NAME_landmark and NAME_camera.
    in_map : bool
        Whether poses are those of a robot in a map: frame NAME_map, and no landmark_pose.
    """

    def __init__(self, name: str, below: str, *, in_map: bool = False) -> None:
        super().__init__(name)
        from phasemark.matcher.live import ros_types

        self._types, self._in_map = ros_types, in_map
        self._frames = f"{below}_{'map' if in_map else 'landmark'}", f"{below}_camera"
        domain = needed("cyclonedds.domain", "the sink 'ros'", "dds")
        number = os.environ.get("ROS_DOMAIN_ID", "0")
        if not number.isdigit() or int(number) > 232:
            raise UsageError(f"ROS_DOMAIN_ID must be a number from 0 to 232, got {number!r}")
        self._participant = domain.DomainParticipant(int(number))
        self._pose = self._writer(f"{below}/pose", ros_types.PoseWithCovarianceStamped)
        self._landmark = self._writer(f"{below}/landmark_pose", ros_types.PoseStamped)
        self._status = self._writer(f"{below}/status", ros_types.String)

    def _writer(self, topic: str, kind: Any) -> Any:
        core, topics, pub = (needed(f"cyclonedds.{part}", "", "dds") for part in ("core", "topic", "pub"))
        policy = core.Policy
        qos = core.Qos(
            policy.Reliability.Reliable(100_000_000),
            policy.History.KeepLast(_DEPTH),
            policy.DataRepresentation(use_cdrv0_representation=True),
        )
        hashed = policy.Userdata(f"typehash={self._types.TYPE_HASHES[kind]};".encode())
        own = topics.Topic(self._participant, f"rt/{topic}", kind, qos=qos)
        return pub.DataWriter(self._participant, own, qos=core.Qos(*qos, hashed))

    def update(self, update: Update) -> None:
        """Publish an accepted pose."""
        found = update.located.estimate
        if not update.reason and found.pose is not None and found.covariance is not None:
            self._pose.write(self.pose_message(found.pose, found.covariance, update.time_s))
            if not self._in_map:
                self._landmark.write(self.landmark_message(found.pose, update.time_s))

    def status(self, status: Status) -> None:
        """Publish the status."""
        self._status.write(self._types.String(json.dumps(status.as_dict())))

    def pose_message(self, pose: NDArray[np.float64], covariance: NDArray[np.float64], time_s: float) -> Any:
        """Return the message of a pose (x, y, heading) of the camera in the landmark's frame."""
        own = self._types
        whole = planar_covariance(covariance).ravel().tolist()
        return own.PoseWithCovarianceStamped(
            self._header(time_s, 0), own.PoseWithCovariance(self._message(pose), whole)
        )  # fmt: skip

    def landmark_message(self, pose: NDArray[np.float64], time_s: float) -> Any:
        """Return the message of the landmark's pose in the camera's frame: the inverse of that of the camera."""
        x, y, heading = (float(value) for value in pose)
        cos, sin = math.cos(heading), math.sin(heading)
        inverse = np.array([-cos * x - sin * y, sin * x - cos * y, -heading])
        return self._types.PoseStamped(self._header(time_s, 1), self._message(inverse))

    def _message(self, pose: NDArray[np.float64]) -> Any:
        x, y, heading = (float(value) for value in pose)
        turn = self._types.Quaternion(0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
        return self._types.Pose(self._types.Point(x, y, 0.0), turn)

    def _header(self, time_s: float, frame: int) -> Any:
        whole = math.floor(time_s)
        stamp = self._types.Time(whole, min(int((time_s - whole) * 1e9), 999_999_999))
        return self._types.Header(stamp, self._frames[frame])

    def close(self) -> None:
        """Leave the domain."""
        del self._pose, self._landmark, self._status, self._participant
