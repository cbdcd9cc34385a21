"""MAVLink: poses as an autopilot takes them, VISION_POSITION_ESTIMATE and ODOMETRY with covariance."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.inputs.extras import needed
from phasemark.matcher.live.sinks import Sink, planar_covariance
from phasemark.matcher.live.updates import Update

_SYSTEM, _VISUAL_INERTIAL = 1, 197
"""System that the messages come from, and the component MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY."""
_TO_FRD = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
"""Signs that turn x forward, y left, z up into x forward, y right, z down: position and angles about the axes."""


class MavlinkSink(Sink):
    """Messages to an autopilot; its frame is that of the landmark, x forward, y right, z down.

    Parameters
    ----------
    name : str
    address : str
        As pymavlink has it: ``udpout:127.0.0.1:14550``, ``/dev/ttyACM0,921600``.

    Raises
    ------
    UsageError
        The address is none, or pymavlink is missing.
    """

    def __init__(self, name: str, address: str) -> None:
        super().__init__(name)
        os.environ["MAVLINK20"] = "1"  # ODOMETRY is a message of version 2
        mavutil = needed("pymavlink.mavutil", "the sink 'mavlink'", "mavlink")
        device, _, baud = address.partition(",")
        try:
            self._link = mavutil.mavlink_connection(
                device, baud=int(baud or 115200), source_system=_SYSTEM, source_component=_VISUAL_INERTIAL
            )
        except Exception as error:  # whatever sockets, ports and pymavlink's own parser of addresses say
            reason = " ".join(str(error).split()) or type(error).__name__
            raise UsageError(f"{name}: cannot be opened ({reason}), as in mavlink:udpout:127.0.0.1:14550") from None
        self._mavlink = mavutil.mavlink
        self._resets, self._was_published = 0, True

    def update(self, update: Update) -> None:
        """Send an accepted pose; the counter of resets grows when poses come again after a gap."""
        found = update.located.estimate
        published = not update.reason and found.pose is not None and found.covariance is not None
        if published and not self._was_published:
            self._resets = (self._resets + 1) % 256
        self._was_published = published
        if found.pose is not None and found.covariance is not None and published:
            for message in self.messages(found.pose, found.covariance, update.time_s):
                self._link.mav.send(message)

    def messages(self, pose: NDArray[np.float64], covariance: NDArray[np.float64], time_s: float) -> list[Any]:
        """Return both messages of a pose (x, y, heading), with the upper triangle of the covariance row by row."""
        whole = planar_covariance(covariance) * np.outer(_TO_FRD, _TO_FRD)
        upper = whole[np.triu_indices(6)].tolist()
        x, y, yaw = float(pose[0]), -float(pose[1]), -float(pose[2])
        microseconds = max(int(time_s * 1e6), 0)  # a delay may put a pose before the first stamp
        own, none = self._mavlink, [math.nan] * 21
        position = own.MAVLink_vision_position_estimate_message(
            microseconds, x, y, 0.0, 0.0, 0.0, yaw, upper, self._resets
        )  # fmt: skip
        turn = [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
        odometry = own.MAVLink_odometry_message(
            microseconds, own.MAV_FRAME_LOCAL_FRD, own.MAV_FRAME_BODY_FRD, x, y, 0.0, turn,
            math.nan, math.nan, math.nan, math.nan, math.nan, math.nan,
            upper, none, self._resets, own.MAV_ESTIMATOR_TYPE_VISION, 0,
        )  # fmt: skip
        return [position, odometry]

    def close(self) -> None:
        """Close the link."""
        self._link.close()
