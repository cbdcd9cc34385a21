"""Publish live poses as topics of ROS 2, from a board or a recording, without ROS on this computer.

``python examples/ros2_node.py /dev/ttyUSB0 bank.h5 --name dock``

Topics are ``/dock/pose``, ``/dock/landmark_pose`` and ``/dock/status`` in the domain ROS_DOMAIN_ID. What is not
accepted is not published: a consumer needs a timeout, and finds why in the status.
"""

from __future__ import annotations

import argparse
import signal
import sys

from phasemark import PhasemarkError
from phasemark.data import open_bank
from phasemark.matcher import Matcher
from phasemark.matcher.live import Live, Tracker, Update, open_sink, open_source
from phasemark.matcher.live.search_beside import SearchesBeside
from phasemark.matcher.sequence import FreeMotion, PoseEstimator, Standing


def main(argv: list[str] | None = None) -> int:
    """Publish until the source ends or Ctrl-C is pressed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", help="serial port, tcp://HOST:PORT, a recording, …")
    parser.add_argument("bank", help="bank of the landmark")
    parser.add_argument("--name", default="phasemark", help="topics are NAME/pose, NAME/landmark_pose, NAME/status")
    arguments = parser.parse_args(argv)
    try:
        bank = open_bank(arguments.bank)
        matcher = Matcher(bank, "refine", workers=1)
        estimator = PoseEstimator(Standing(), FreeMotion(), jitter_s=bank.sensor.systematic_time_s)
        tracker = Tracker(matcher, estimator, SearchesBeside(matcher))
        sinks = [open_sink(f"ros:{arguments.name}", bank.camera)]
        tracker.warm()
        source = open_source(arguments.source, bank.camera)
        session = Live(source, tracker, sinks, delay_s=tracker.delay_s, say=lambda line: print(line, file=sys.stderr))
        signal.signal(signal.SIGINT, lambda *_: session.stop())
        counted = {"published": 0}

        def count(update: Update) -> None:
            counted["published"] += not update.reason

        session.run(on_update=count)
    except PhasemarkError as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    print(f"{counted['published']} poses published")
    return 0


if __name__ == "__main__":
    sys.exit(main())
