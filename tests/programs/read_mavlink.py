"""Prints the first two messages of MAVLink that arrive at a port of UDP."""

import json
import math
import os
import sys

os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil


def main(port: str) -> None:
    """Print two messages."""
    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}")
    print("ready", flush=True)
    for _ in range(2):
        message = link.recv_match(type=["VISION_POSITION_ESTIMATE", "ODOMETRY"], blocking=True, timeout=20)
        row = {"kind": message.get_type(), "x": message.x, "y": message.y}
        if row["kind"] == "ODOMETRY":
            row |= {"usec": message.time_usec, "covariance": list(message.pose_covariance)}
            row["yaw"] = 2 * math.atan2(message.q[3], message.q[0])
        else:
            row |= {"usec": message.usec, "covariance": list(message.covariance), "yaw": message.yaw}
        print(json.dumps(row), flush=True)
    link.close()


if __name__ == "__main__":
    main(sys.argv[1])
