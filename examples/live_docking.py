"""Dock a robot by live poses: a simulated board in a second process prints frames, the robot drives by what they show.

``python examples/live_docking.py --out out/docking``

The board prints lines of JSON into a pseudo-terminal, thirty a second: what a TMF8829 sees from where the robot really
is. The robot knows nothing but ``phasemark.matcher.live``: it drives to 0.45 m before the landmark, facing it, and
stops while no pose is accepted. The figure has the way, and errors with three standard deviations over time.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import pty
import subprocess
import sys
import threading
import time
import tty
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher
from phasemark.matcher.live import Live, Tracker, Update, open_source
from phasemark.matcher.live.search_beside import SearchesInLine
from phasemark.matcher.sequence import FreeMotion, PoseEstimator, Standing
from phasemark.render import Renderer, capture, preset

SENSOR, LANDMARK = "tmf8829-16x16", "cone"
RATE_HZ, SPEED_M_S, TURN_RAD_S = 30.0, 0.12, 0.5
START = np.array([-0.85, 0.16, -0.28])
COMMAND_LASTS_S = 0.3
"""After that the robot stops by itself: without poses nothing else would."""
GOAL_M = 0.45
"""Distance before the landmark at which the robot is docked."""


def board() -> None:
    """Print frames from where the robot is; standard input has its speed and turn rate, a line each."""
    sensor = preset(SENSOR).with_(histogram=None)  # ranges that are means over their zones
    renderer, rng = Renderer(build_mesh(catalog()[LANDMARK]), sensor, albedo=0.8), np.random.default_rng(1)
    pose, command, began = START.copy(), [0.0, 0.0, 0.0], time.monotonic()

    def listen() -> None:
        for line in sys.stdin:
            command[:] = *map(float, line.split()), time.monotonic()

    threading.Thread(target=listen, daemon=True).start()
    for k in range(10**9):
        time.sleep(max(began + k / RATE_HZ - time.monotonic(), 0.0))
        speed, turn = command[:2] if time.monotonic() - command[2] < COMMAND_LASTS_S else (0.0, 0.0)
        pose += np.array([speed * math.cos(pose[2]), speed * math.sin(pose[2]), turn]) / RATE_HZ
        distance, towards = float(np.hypot(*pose[:2])), math.atan2(-pose[1], -pose[0])
        image = renderer.render(distance, towards, math.remainder(towards - pose[2], math.tau))
        frame = capture(image, sensor, rng=rng, n_frames=1)
        range_mm = np.where(frame.valid, 1e3 * frame.range_m, 0.0).ravel().round(1)
        row = {"t_ms": 1e3 * k / RATE_HZ, "distances": range_mm.tolist(), "truth": pose.tolist()}
        print(json.dumps(row), flush=True)


class Robot:
    """Drives to the landmark by the poses that are published.

    Parameters
    ----------
    steer : callable
        Takes speed and turn rate.
    """

    def __init__(self, steer: Any) -> None:
        self._steer = steer
        self.seen: list[tuple[float, np.ndarray, np.ndarray, str]] = []
        self.is_docked = False

    def take(self, update: Update) -> None:
        """Steer by an update: towards the landmark, slower as it comes near, and not at all without a pose."""
        found = update.located.estimate
        if update.reason or found.pose is None or found.covariance is None:
            self._steer(0.0, 0.0)
            return
        self.seen.append((update.stamp_s, found.pose, found.covariance, update.reason))
        x, y, heading = found.pose
        left_m = math.hypot(x, y) - GOAL_M
        # aim at a point on the axis of the landmark that moves ahead of the robot: it ends up facing it
        aim = math.atan2(-y, max(min(-x - GOAL_M, 0.25), 0.08))
        turn = math.remainder(aim - heading, math.tau) if left_m > 0.05 else -heading - y
        self.is_docked = abs(left_m) < 0.003 and abs(heading) < math.radians(3)
        speed = 0.0 if self.is_docked else np.clip(1.2 * left_m, -SPEED_M_S, SPEED_M_S)
        self._steer(float(speed), float(np.clip(2.0 * turn, -TURN_RAD_S, TURN_RAD_S)) * (not self.is_docked))


def dock(most_s: float) -> tuple[Robot, dict[int, np.ndarray], dict[str, Any]]:
    """Drive until the robot is docked; return it, the true poses by stamp in milliseconds, and the status."""
    own, other = pty.openpty()
    tty.setraw(own)
    tty.setraw(other)
    process = subprocess.Popen(
        [sys.executable, __file__, "--board"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )
    assert process.stdin is not None
    assert process.stdout is not None
    truth: dict[int, np.ndarray] = {}

    def plug() -> None:
        for line in process.stdout or ():
            row = json.loads(line)
            truth[round(row["t_ms"])] = np.array(row.pop("truth"))
            os.write(own, json.dumps(row).encode() + b"\n")

    def steer(speed_m_s: float, turn_rad_s: float) -> None:
        if process.poll() is None and process.stdin is not None:
            process.stdin.write(f"{speed_m_s} {turn_rad_s}\n")

    threading.Thread(target=plug, daemon=True).start()
    bank = build_bank(
        BankPlan(classes=(LANDMARK,), sensor=SENSOR, distance_m="0.35:1:0.02", delta_deg="-44:44:2"), workers=1
    )
    matcher = Matcher(bank, "refine", free=("distance_m", "delta_rad", "bearing_rad"), workers=1)
    estimator = PoseEstimator(Standing(), FreeMotion(0.1, 0.5, 0.3, 3.0))
    tracker = Tracker(matcher, estimator, SearchesInLine(matcher, 60))
    tracker.warm()
    robot = Robot(steer)
    session = Live(open_source(os.ttyname(other), bank.camera), tracker, say=lambda line: print(f"note: {line}"))
    stop = threading.Timer(most_s, session.stop)
    stop.start()

    def update(one: Update) -> None:
        robot.take(one)
        if robot.is_docked:
            session.stop()

    session.run(on_update=update)
    stop.cancel()
    process.kill()
    process.communicate()
    for end in (own, other):
        os.close(end)
    return robot, truth, session.status.as_dict()


def draw(robot: Robot, truth: dict[int, np.ndarray]) -> Figure:
    """Draw the way, and errors with three standard deviations over time."""
    figure = Figure(figsize=(11, 5), layout="constrained")
    grid = figure.add_gridspec(3, 2)
    way = figure.add_subplot(grid[:, 0])
    stamps = np.array([one[0] for one in robot.seen])
    pose, true = np.array([one[1] for one in robot.seen]), np.array([truth[round(1e3 * stamp)] for stamp in stamps])
    std = np.sqrt(np.array([np.diag(one[2]) for one in robot.seen]))
    way.plot(*true[:, :2].T, "k-", lw=2.5, label="true")
    way.plot(*pose[:, :2].T, ".", color="#2a6fbb", ms=3, label="published")
    way.plot(0, 0, "^", color="#5b8c5a", ms=12, label="landmark")
    way.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="way to the dock")
    way.legend(frameon=False)
    names = ("x (mm)", "y (mm)", "heading (°)")
    for k, (name, scale) in enumerate(zip(names, (1e3, 1e3, math.degrees(1.0)), strict=True)):
        axes = figure.add_subplot(grid[k, 1])
        axes.fill_between(stamps, -3 * scale * std[:, k], 3 * scale * std[:, k], color="#2a6fbb", alpha=0.2, lw=0)
        axes.plot(stamps, scale * (pose - true)[:, k], color="#2a6fbb", lw=1)
        axes.set(ylabel=name, xlim=(stamps[0], stamps[-1]))
        axes.grid(alpha=0.3)
    axes.set_xlabel("time (s); error, and ± 3 σ")
    return figure


def main(argv: list[str] | None = None) -> int:
    """Dock, print how well, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/docking"), help="folder of the figure")
    parser.add_argument("--most", type=float, default=60.0, help="seconds after which the robot gives up")
    parser.add_argument("--board", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.board:
        board()
        return 0
    robot, truth, status = dock(arguments.most)
    if not robot.seen:
        print("error: no pose was published", file=sys.stderr)
        return 3
    error = np.array([own[1] - truth[round(1e3 * own[0])] for own in robot.seen])
    squared = np.array([e @ np.linalg.solve(own[2], e) for e, own in zip(error, robot.seen, strict=True)])
    x, y, heading = np.sqrt(np.mean(error**2, axis=0))
    answer = "yes" if robot.is_docked else "no"
    print(f"docked: {answer}, {len(robot.seen)} poses, accepted {status['accepted_share']:.0%}")
    print(f"r.m.s. of x, y, heading: {1e3 * x:.1f} mm, {1e3 * y:.1f} mm, {math.degrees(heading):.2f}°")
    print(f"mean NEES / 3: {squared.mean() / 3:.2f}; latency {status['latency_ms']} ms, {status['dropped']} dropped")
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw(robot, truth).savefig(arguments.out / "docking.png", dpi=100)
    print(arguments.out / "docking.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
