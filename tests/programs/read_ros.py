"""Waits for a pose on a topic of DDS, and prints it with the type hash of its writer."""

import json
import os
import sys
import time

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from phasemark.matcher.live.ros_types import PoseWithCovarianceStamped


def main(name: str) -> None:
    """Print one message of a topic."""
    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
    qos = Qos(Policy.Reliability.Reliable(1), Policy.DataRepresentation(use_cdrv0_representation=True))
    reader = DataReader(participant, Topic(participant, name, PoseWithCovarianceStamped, qos=qos), qos=qos)
    writers = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    print("ready", flush=True)
    hashed = ""
    for _ in range(200):
        for writer in writers.take(N=100):
            data = [policy.data for policy in writer.qos or () if type(policy).__name__ == "Userdata"]
            if writer.topic_name == name and data:
                hashed = data[0].decode()
        for message in reader.take(N=1):
            pose = message.pose
            row = {"x": pose.pose.position.x, "covariance": list(pose.covariance), "hash": hashed}
            print(json.dumps(row), flush=True)
            return
        time.sleep(0.1)


if __name__ == "__main__":
    main(sys.argv[1])
