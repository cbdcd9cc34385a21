"""A server that Foxglove connects to: poses and status as topics to look at."""

from __future__ import annotations

import math

from phasemark import UsageError
from phasemark.inputs.extras import needed
from phasemark.matcher.live.sinks import Sink
from phasemark.matcher.live.status import Status
from phasemark.matcher.live.updates import Update, plain_rows


class FoxgloveSink(Sink):
    """Topics /pose (PoseInFrame, accepted poses), /zones (a grid of ranges as JSON), /update and /status (JSON).

    Parameters
    ----------
    name : str
    address : str
        HOST:PORT of the server.

    Raises
    ------
    UsageError
        The port is taken, or the package is missing.
    """

    def __init__(self, name: str, address: str) -> None:
        super().__init__(name)
        foxglove = needed("foxglove", "the sink 'foxglove'", "foxglove")
        self._messages = needed("foxglove.messages", "", "foxglove")
        channels = needed("foxglove.channels", "", "foxglove")
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit():
            raise UsageError(f"{name}: must be foxglove://HOST:PORT, as in foxglove://127.0.0.1:8765")
        self._context = context = foxglove.Context()  # its channels close when nobody holds it any more
        try:
            self._server = foxglove.start_server(name="phasemark", host=host, port=int(port), context=context)
        except (RuntimeError, OSError, OverflowError) as error:
            raise UsageError(f"{name}: the port cannot be used ({error}): give another one") from None
        self._pose = channels.PoseInFrameChannel("/pose", context=context)
        self._update, self._status, self._zones = (
            foxglove.Channel(topic, message_encoding="json", context=context)
            for topic in ("/update", "/status", "/zones")
        )

    def update(self, update: Update) -> None:
        """Send a pose, if it is accepted, and what is known."""
        found, now = update.located.estimate, max(int(update.time_s * 1e9), 0)
        self._update.log(update.as_dict(), log_time=now)
        self._zones.log({"range_m": plain_rows(update.zones_m)}, log_time=now)
        if not update.reason and found.pose is not None:
            own, heading = self._messages, float(found.pose[2])
            pose = own.Pose(
                position=own.Vector3(x=float(found.pose[0]), y=float(found.pose[1]), z=0.0),
                orientation=own.Quaternion(x=0.0, y=0.0, z=math.sin(heading / 2), w=math.cos(heading / 2)),
            )
            stamp = own.Timestamp(sec=now // 10**9, nsec=now % 10**9)
            frame = "map" if update.located.filtered is None else "landmark"
            self._pose.log(own.PoseInFrame(timestamp=stamp, frame_id=frame, pose=pose), log_time=now)

    def status(self, status: Status) -> None:
        """Send the status."""
        self._status.log(status.as_dict())

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
