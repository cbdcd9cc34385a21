"""Live poses: a fake board behind a terminal or a port, faults of every kind, and sinks read by other processes."""

import gc
import io
import json
import math
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from programs.fake_board import FakeBoard
from rich.console import Console
from rig_trials import ring_rig, room
from rosbags.typesys import Stores, get_typestore

from phasemark import InputFileError, OutputExistsError, UsageError
from phasemark.cli import main
from phasemark.data import BankPlan, build_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import Matcher, kalman_filter
from phasemark.matcher.live import Live, Tracker, open_sink, open_source, sources
from phasemark.matcher.live.map_tracker import MapTracker
from phasemark.matcher.live.rig_frames import RecordedRig, RigLines, open_rig_source
from phasemark.matcher.live.search_beside import SearchesInLine
from phasemark.matcher.live.sources import SourceFault
from phasemark.matcher.live.streams import Stream
from phasemark.matcher.live.tracker import Located
from phasemark.matcher.locate import Locator, Rig, read_rig_recording, recording_bytes, simulated_recording
from phasemark.matcher.sequence import Estimate, FreeMotion, PoseEstimator, Standing
from phasemark.render import Frames, Renderer, Views, capture, preset

SENSOR = "tmf8829-16x16"
RATE_HZ = 30.0


def truth(k):
    """View of the camera at frame k: it circles slowly before the landmark."""
    return 0.6 + 0.03 * math.sin(k / 15), 0.35 + 0.1 * math.sin(k / 20), 0.0


def pose_of(view):
    distance, delta, bearing = view
    return np.array([-distance * math.cos(delta), -distance * math.sin(delta), delta - bearing])


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    path = tmp_path_factory.mktemp("live") / "bank.h5"
    plan = BankPlan(classes=("cone",), sensor=SENSOR, distance_m="0.5:0.7:0.01", delta_deg="0:45:1")
    built = build_bank(plan, path, workers=1)
    tracker_of(built).warm()  # a board does not wait while compiled code is loaded
    return built


@pytest.fixture(scope="module")
def printed():
    """Lines of JSON of 90 frames."""
    sensor = preset(SENSOR).with_(histogram=None)  # ranges that are means over their zones
    image = Renderer(build_mesh(catalog()["cone"]), sensor, albedo=0.8).render_views(
        Views.broadcast(*np.array([truth(k) for k in range(90)]).T)
    )
    frames = capture(image, sensor, rng=np.random.default_rng(3), n_frames=1)
    range_mm = np.where(frames.valid, 1e3 * frames.range_m, 0.0)[:, 0].reshape(90, -1).round(1)
    return [
        json.dumps({"t_ms": round(1e3 * k / RATE_HZ, 3), "distances": row.tolist()}).encode() + b"\n"
        for k, row in enumerate(range_mm)
    ]


def tracker_of(bank, *, free=("distance_m", "delta_rad"), searches=None):
    matcher = Matcher(bank, "refine", free=free, workers=1)
    motion = FreeMotion(0.2, 0.5, 0.3, 0.5)
    return Tracker(matcher, PoseEstimator(Standing(), motion), searches or SearchesInLine(matcher, 10))


def run(source, locator, sinks=(), *, until=None, most_s=20.0, said=None):
    """Run a session until a condition holds for its updates; return these and the session."""
    session = Live(source, locator, sinks, say=None if said is None else said.append)
    updates, began, is_over = [], time.monotonic(), threading.Event()

    def watch():
        try:
            while time.monotonic() - began < most_s and not is_over.wait(0.01):
                if until is not None and until(updates):
                    break
        finally:
            session.stop()

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    session.run(on_update=updates.append)
    is_over.set()
    watcher.join()
    return updates, session


def assert_right(updates, n=1):
    """Every published pose is within five of its standard deviations, and there are n of them."""
    published = [one for one in updates if not one.reason]
    assert len(published) >= n
    for one in published:
        k = round(one.stamp_s % 3.0 * RATE_HZ)
        off = one.located.estimate.pose - pose_of(truth(k))
        assert (np.abs(off) < 5 * np.sqrt(np.diag(one.located.estimate.covariance)) + 1e-3).all()


def test_tracking_from_the_view_before_gives_the_answer_of_a_search(bank, printed):
    matcher = Matcher(bank, "refine", workers=1)  # the bearing is free
    before, *_, now = [kalman_filter(frames) for frames in frames_of_lines(printed[:4])]
    searched = matcher.match(now)[0]
    tracked = matcher.track(now, [matcher.match(before)[0]])
    assert searched.accepted
    assert tracked.accepted
    std = np.sqrt(np.diag(searched.covariance))
    for name, own in zip(searched.free, std, strict=True):
        assert getattr(tracked, name) == pytest.approx(getattr(searched, name), abs=0.1 * own)
    np.testing.assert_allclose(np.sqrt(np.diag(tracked.covariance)), std, rtol=0.2)
    with pytest.raises(UsageError, match="one frame and at least one expected view"):
        matcher.track(now, [])


def frames_of_lines(lines):
    """Frames of lines, read as a recording."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.log"
        path.write_bytes(b"".join(lines))
        return [arrival.frames for arrival in open_source(str(path), preset(SENSOR), in_time=False).frames()]


def test_a_tracker_with_a_free_bearing_follows_and_finds_itself_again_within_half_a_second(bank, printed):
    """The landmark is out of sight for a second."""
    tracker = tracker_of(bank, free=None)
    found = []
    for k, frames in enumerate(frames_of_lines(printed[:60])):
        if 20 <= k < 50:
            frames = Frames(np.full_like(frames.range_m, np.nan), valid=np.zeros(frames.range_m.shape, bool),
                            sensor=frames.sensor, time_s=frames.time_s)  # fmt: skip
        found.append(tracker.locate(frames, k / RATE_HZ))
    assert [one.estimate.accepted for one in found[:20]] == [True] * 20
    assert all(one.tracked for one in found[1:20])
    assert found[49].estimate.reason == "lost"
    again = next(k for k in range(50, 60) if found[k].estimate.accepted)
    assert (again - 50) / RATE_HZ <= 0.5
    for k in (*range(20), *range(again, 60)):
        off = found[k].estimate.pose - pose_of(truth(k))
        assert (np.abs(off) < 5 * np.sqrt(np.diag(found[k].estimate.covariance))).all()


@pytest.mark.parametrize("way", ["terminal", "tcp", "udp"])
def test_poses_come_from_a_board_behind_a_terminal_and_ports(bank, printed, way):
    board = FakeBoard(printed, RATE_HZ)
    if way == "udp":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        name = f"udp://127.0.0.1:{port}"
        board.to_port(port)
    else:
        name = board.on_terminal() if way == "terminal" else f"tcp://127.0.0.1:{board.on_port()}"
    source = open_source(name, preset(SENSOR))
    updates, session = run(source, tracker_of(bank), until=lambda found: len(found) >= 12)
    board.unplug()
    assert_right(updates, 8)
    assert session.status.as_dict()["accepted"] >= 8


def test_garbage_half_lines_wrong_sizes_and_jumps_of_the_clock_publish_nothing_wrong(bank, printed):
    """Ten thousand random lines among the frames; after them poses come within a second."""
    rng = random.Random(5)
    junk = [rng.randbytes(rng.randrange(0, 60)).replace(b"\n", b"") + b"\n" for _ in range(10_000)]
    junk += [printed[3][: rng.randrange(5, 400)] + b"\n" for _ in range(20)]
    junk += [
        b'{"distances": [1, 2, 3]}\n',
        b'{"distances": "no"}\n',
        b'{"t_ms": 1e400, "distances": [1]}\n',
        b"{" * 3000 + b"\n",
    ]
    rng.shuffle(junk)
    # more than one: on a busy machine the newest frame may win over the first
    jumped = [
        json.dumps({**json.loads(printed[k]), "t_ms": 5e9 + 1e3 * k / RATE_HZ}).encode() + b"\n" for k in range(30, 45)
    ]
    lines = [*printed[:10], b"".join(junk), *jumped, *printed[45:90]]
    board = FakeBoard(lines, RATE_HZ)
    said: list[str] = []
    source = open_source(board.on_terminal(), preset(SENSOR))
    updates, session = run(source, tracker_of(bank), said=said, until=lambda found: board.is_done.is_set(), most_s=30)
    board.unplug()
    assert_right([one for one in updates if one.stamp_s < 1e6], 3)
    assert source.n_damaged >= 20
    assert any("clock jumps" in line for line in said)
    assert session.status.as_dict()["damaged"] == source.n_damaged


def test_of_two_boards_on_one_port_nothing_is_published_until_one_is_silent(bank, printed):
    """Their clocks differ by an hour, so that every second stamp runs back."""
    lines = []
    for k in range(30):
        lines += [
            printed[k],
            json.dumps({**json.loads(printed[k]), "t_ms": 3.6e6 + 1e3 * k / RATE_HZ}).encode() + b"\n",
        ]
    board = FakeBoard(lines, 2 * RATE_HZ)
    source, said = open_source(board.on_terminal(), preset(SENSOR)), []
    updates, _ = run(source, tracker_of(bank), until=lambda found: board.is_done.is_set(), said=said)
    board.unplug()
    jumps = [k for k, one in enumerate(updates) if one.located.note]
    assert all(one.reason for k in jumps for one in updates[k : k + 5])
    assert any("clock jumps" in line for line in said)


def test_a_killed_source_is_said_in_a_line_and_opened_again(bank, printed):
    board = FakeBoard(printed, RATE_HZ)
    port = board.on_port()
    source, said, updates = open_source(f"tcp://127.0.0.1:{port}", preset(SENSOR)), [], []
    session = Live(source, tracker_of(bank), say=said.append)
    thread = threading.Thread(target=session.run, kwargs={"on_update": updates.append}, daemon=True)
    thread.start()
    wait_for(lambda: len(updates) >= 5)
    board.unplug()
    wait_for(lambda: session.status.fault)
    n, again = len(updates), FakeBoard(printed[40:], RATE_HZ)
    again.on_port(port)
    began = time.monotonic()
    wait_for(lambda: any(not one.reason for one in updates[n:]))
    assert time.monotonic() - began < 1.5  # a second, and the frames until a stamp that jumped is trusted
    session.stop()
    thread.join(5)
    again.unplug()
    assert any(str(port) in line and "tried again" in line for line in said)
    assert_right(updates, 6)


def wait_for(condition, most_s=10.0):
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < most_s
        time.sleep(0.01)


class _SlowLocator:
    """Takes a time for each frame, and finds nothing."""

    def __init__(self, takes_s):
        self._takes_s = takes_s

    def locate(self, frames, stamp_s):
        time.sleep(self._takes_s)
        return Located(Estimate(False, "searching"), None, None)

    def warm(self):
        pass

    def close(self):
        pass


def test_of_a_source_twice_as_fast_the_newest_frame_wins_and_the_dropped_ones_are_counted(printed):
    takes_s = 0.05
    board = FakeBoard(printed, 2 / takes_s)
    source = open_source(board.on_terminal(), preset(SENSOR))
    updates, session = run(source, _SlowLocator(takes_s), until=lambda found: board.is_done.is_set())
    board.unplug()
    # a frame waits for at most the one before it: two of the matcher's periods; half of one more for a busy machine
    assert np.quantile([one.latency_s for one in updates], 0.95) < 2.5 * takes_s
    assert session.status.dropped >= 0.3 * board.n_sent
    assert len(updates) + session.status.dropped <= board.n_sent


def test_a_log_in_mcap_replays_the_same_poses_bit_for_bit(bank, printed, tmp_path):
    path, log = tmp_path / "frames.log", tmp_path / "log.mcap"
    path.write_bytes(b"".join(printed[:22]))
    sensor = preset(SENSOR)

    def poses(source, searches=None, sinks=()):
        tracker = tracker_of(bank, free=None, searches=searches)
        updates, _ = run(source, tracker, sinks, most_s=60)
        return [
            (one.stamp_s, one.reason, one.located.estimate.pose, one.located.estimate.covariance) for one in updates
        ]

    first = poses(open_source(str(path), sensor, in_time=False), None, [open_sink(f"mcap:{log}", sensor)])
    again: Any = open_source(str(log), sensor, in_time=False)
    second = poses(again, SearchesInLine(Matcher(bank, "refine", workers=1), logged=again.searches()))
    assert len(first) == len(second) == 22
    for one, other in zip(first, second, strict=True):
        assert one[:2] == other[:2]
        np.testing.assert_array_equal(one[2], other[2])
        np.testing.assert_array_equal(one[3], other[3])
    with pytest.raises(OutputExistsError):
        open_sink(f"mcap:{log}", sensor)
    whole = log.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 4
    for damaged in (whole[:200], bytes(flipped)):
        log.write_bytes(damaged)
        with pytest.raises(InputFileError, match="damaged"):
            open_source(str(log), sensor)
    log.write_bytes(whole[:-30])  # of a session that was killed
    with pytest.warns(UserWarning, match="cut off: the 22 messages of /frames before are read"):
        cut: Any = open_source(str(log), sensor, in_time=False)
    assert len(list(cut.recorded())) == 22


def test_a_board_whose_first_line_comes_late_is_recognised(printed, monkeypatch):
    """A port that resets its board when it is opened is silent at first, and is opened again."""
    monkeypatch.setattr(sources, "STALLS_AFTER_S", 0.1)
    read, write = os.pipe()
    late = threading.Timer(0.15, os.write, (write, b"".join(printed[:4])))
    source: Any = sources.PrintedSource(Stream("port", lambda: os.fdopen(os.dup(read), "rb", 0)), preset(SENSOR), {})
    found: list[Any] = []
    late.start()
    for _ in range(3):
        with pytest.raises(SourceFault, match="has sent nothing"):
            found.extend(source.frames())
    late.join()
    os.close(write)
    os.close(read)
    assert (len(found), source.n_damaged) == (4, 0)


def started(program, *words):
    command = [sys.executable, "-m", program, *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent)


POSE, COVARIANCE = np.array([-1.0, 0.2, 0.3]), np.array([[1e-4, 2e-5, 3e-5], [2e-5, 2e-4, 4e-5], [3e-5, 4e-5, 3e-4]])


def test_messages_of_ros_are_bytes_of_rosbags_and_reach_another_process(monkeypatch):
    from phasemark.matcher.live import ros_types
    from phasemark.matcher.live.ros import RosSink

    monkeypatch.setenv("ROS_DOMAIN_ID", "77")
    store, sink = get_typestore(Stores.ROS2_HUMBLE), RosSink("ros", "dock")
    message = sink.pose_message(POSE, COVARIANCE, 1_700_000_000.25)
    kinds: dict[str, Any] = {
        "geometry_msgs/msg/PoseWithCovarianceStamped": message,
        "geometry_msgs/msg/PoseStamped": sink.landmark_message(POSE, 1_700_000_000.25),
        "std_msgs/msg/String": ros_types.String("searching"),
    }
    for name, one in kinds.items():
        data = one.serialize(use_version_2=False)
        assert bytes(store.serialize_cdr(store.deserialize_cdr(data, name), name)) == data
        assert ros_types.TYPE_HASHES[type(one)] == store.hash_rihs01(name)
    decoded: Any = store.deserialize_cdr(
        message.serialize(use_version_2=False), "geometry_msgs/msg/PoseWithCovarianceStamped"
    )
    assert (decoded.header.stamp.sec, decoded.header.stamp.nanosec) == (1_700_000_000, 250_000_000)
    assert decoded.header.frame_id == "dock_landmark"
    np.testing.assert_array_equal(decoded.pose.covariance.reshape(6, 6)[np.ix_([0, 1, 5], [0, 1, 5])], COVARIANCE)
    landmark = kinds["geometry_msgs/msg/PoseStamped"].pose
    # the camera's pose after that of the landmark is the origin
    turn = 2 * math.atan2(landmark.orientation.z, landmark.orientation.w) + POSE[2]
    assert turn == pytest.approx(0, abs=1e-12)
    x = POSE[0] + math.cos(POSE[2]) * landmark.position.x - math.sin(POSE[2]) * landmark.position.y
    assert x == pytest.approx(0, abs=1e-12)
    with started("programs.read_ros", "rt/dock/pose") as reader:
        assert reader.stdout.readline() == "ready\n"
        began = time.monotonic()
        while reader.poll() is None and time.monotonic() - began < 20:
            sink._pose.write(message)
            time.sleep(0.1)
        row = json.loads(reader.stdout.read())
    sink.close()
    assert row["x"] == POSE[0]
    assert row["covariance"] == decoded.pose.covariance.tolist()
    assert row["hash"] == f"typehash={store.hash_rihs01('geometry_msgs/msg/PoseWithCovarianceStamped')};"


def test_mavlink_is_decoded_in_another_process_with_its_covariance_in_order():
    from phasemark.matcher.live.mavlink import MavlinkSink

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with started("programs.read_mavlink", str(port)) as reader:
        assert reader.stdout.readline() == "ready\n"
        sink = MavlinkSink("mavlink", f"udpout:127.0.0.1:{port}")
        for message in sink.messages(POSE, COVARIANCE, 12.5):
            sink._link.mav.send(message)
        early = sink.messages(POSE, COVARIANCE, -0.05)  # a recording from 0 s on, of a sensor that is late
        rows = [json.loads(line) for line in reader.stdout.readlines()]
    sink.close()
    assert (early[0].usec, early[1].time_usec) == (0, 0)
    assert [row["kind"] for row in rows] == ["VISION_POSITION_ESTIMATE", "ODOMETRY"]
    for row in rows:
        assert row["usec"] == 12_500_000
        np.testing.assert_allclose([row["x"], row["y"], row["yaw"]], [-1.0, -0.2, -0.3], rtol=1e-6)
        whole = np.zeros((6, 6))
        whole[np.triu_indices(6)] = row["covariance"]
        # y and yaw to the right: covariances of either with x change their signs, that of both does not
        np.testing.assert_allclose(whole[0, [0, 1, 5]], [1e-4, -2e-5, -3e-5], rtol=1e-6)
        np.testing.assert_allclose(whole[1, [1, 5]], [2e-4, 4e-5], rtol=1e-6)
        assert whole[5, 5] == pytest.approx(3e-4)
        assert whole[2, 2] == whole[3, 3] == whole[4, 4] == 1e6


def test_results_of_a_tmf8829_come_over_zeromq():
    sensor = preset("tmf8829-16x16")
    socket_ = zmq.Context.instance().socket(zmq.PUB)
    port = socket_.bind_to_random_port("tcp://127.0.0.1")
    quarters = np.arange(256) * 4 + 2000
    zones = b"".join(struct.pack("<HB", int(value), 9) for value in quarters)
    frame = struct.pack("<BBHI3bBHH", 0x12, 1, len(zones) + 12 + 12, 1, 25, 25, 25, 0, 0, 0) + zones
    frame += struct.pack("<IIBBH", 0, 0, 1, 0, 0xE0F7)
    message = struct.pack("<IB3xI", 0xFE5E1234, 2, len(frame) + 77).ljust(84, b"\0") + b"\0" * 5 + frame
    source, found = open_source(f"zmq://127.0.0.1:{port}", sensor), list[Any]()

    def read():
        for arrival in source.frames():
            found.append(arrival.frames)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    began = time.monotonic()
    while not (found and source.n_damaged >= 2) and time.monotonic() - began < 10:
        for one in (message, message[:-3], b"no"):
            socket_.send(one)
        time.sleep(0.02)
    source.stop()
    thread.join(2)
    socket_.close(0)
    np.testing.assert_allclose(found[0].range_m.ravel(), quarters / 4000)
    assert found[0].time_s is None
    assert source.n_damaged >= 2


def test_a_page_on_localhost_and_the_terminal_show_zones_residual_and_pose(bank, printed):
    from phasemark.matcher.live.page import PageView
    from phasemark.matcher.live.picture import Pictures
    from phasemark.matcher.live.terminal import drawn

    tracker = tracker_of(bank)
    page = PageView(0, tracker.matcher.bank)
    with pytest.raises(UsageError, match=f"port {page.port} cannot be used"):
        PageView(page.port, None)
    text = urllib.request.urlopen(f"http://127.0.0.1:{page.port}/").read().decode()
    assert "://" not in text.replace("http://www.w3.org", "")  # nothing from elsewhere
    board = FakeBoard(printed, RATE_HZ)
    source, events = open_source(board.on_terminal(), preset(SENSOR)), []

    def look():
        with urllib.request.urlopen(f"http://127.0.0.1:{page.port}/events") as stream:
            for line in stream:
                if line.startswith(b"data:") and b"range_m" in line:
                    events.append(json.loads(line[5:]))

    threading.Thread(target=look, daemon=True).start()
    updates, _ = run(source, tracker, [page], until=lambda found: len(events) >= 3)
    board.unplug()
    assert np.array(events[-1]["range_m"]).shape == (16, 16)
    assert events[-1]["status"]["accepted"] > 0
    residual_mm = np.array(events[-1]["residual_mm"], float)
    assert np.nanmedian(np.abs(residual_mm)) < 10  # noise of the cone's pixels, some millimetres
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(drawn(Pictures(tracker.matcher.bank).of(updates[-1]), "30/s"))
    shown = console.export_text()
    assert "heading" in shown
    assert "██" in shown


def test_a_foxglove_server_says_that_its_port_is_taken(bank):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UsageError, match="the port cannot be used"):
            open_sink(f"foxglove://127.0.0.1:{port}", bank.camera)


def test_a_foxglove_server_has_topics_for_who_connects(bank):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    sink = open_sink(f"foxglove://127.0.0.1:{port}", bank.camera)
    gc.collect()
    hello = (
        f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
    )
    topics = {b"/pose", b"/update", b"/status", b"/zones"}
    with socket.create_connection(("127.0.0.1", port), timeout=10) as client:
        client.sendall(hello.encode())
        said = b""
        while not all(topic in said for topic in topics):
            said += client.recv(1 << 16)  # which raises TimeoutError where a topic is missing
    sink.close()
    assert b'"advertise"' in said


@pytest.mark.parametrize(
    ("name", "how", "message"),
    [
        ("ftp://x", {}, "a source must begin with serial://"),
        ("tcp://127.0.0.1", {}, "must have a port, as in tcp://127.0.0.1:5000"),
        ("serial:///dev/ttyX?baud=fast", {}, "'baud' must be a whole number"),
        ("-", {"board": "abacus"}, "board=… must be one of sparkfun"),
    ],
)
def test_a_wrong_source_is_refused_in_a_line(name, how, message):
    with pytest.raises(UsageError, match=message):
        open_source(name, preset(SENSOR), how)


def test_a_wrong_sink_and_a_missing_package_are_refused_in_a_line(monkeypatch):
    with pytest.raises(UsageError, match="a sink must be jsonl:FILE"):
        open_sink("fax:1", preset(SENSOR))
    monkeypatch.setitem(sys.modules, "pymavlink", None)
    monkeypatch.setitem(sys.modules, "pymavlink.mavutil", None)
    with pytest.raises(UsageError, match=r"needs the package pymavlink: pip install -e '\.\[mavlink\]'"):
        open_sink("mavlink:udpout:127.0.0.1:1", preset(SENSOR))


def test_another_board_s_format_a_port_that_is_not_there_and_no_stamps_are_told(bank, printed):
    with pytest.raises(SourceFault, match="cannot be opened"):
        list(open_source("/dev/pts/99999", preset(SENSOR)).frames())
    other = FakeBoard([b"FRAME_START\n", b"D:1,2\n", b"FRAME_END\n"] * 50, 200)
    source = open_source(other.on_terminal(), preset(SENSOR), {"board": "json"})
    run(source, _SlowLocator(0.0), until=lambda _: source.n_damaged >= 3)
    other.unplug()
    assert "board=adafruit-webserial" in source.damage
    plain = [json.dumps({"distances": json.loads(line)["distances"]}).encode() + b"\n" for line in printed]
    board = FakeBoard(plain, RATE_HZ)
    updates, _ = run(open_source(board.on_terminal(), preset(SENSOR)), tracker_of(bank), until=lambda u: len(u) > 5)
    board.unplug()
    assert updates[-1].stamp_s == pytest.approx(time.time(), abs=60)  # those of arrival


def test_the_command_reads_standard_input_and_closes_its_log_whole_when_it_is_interrupted(bank, printed, tmp_path):
    log, out = tmp_path / "log.mcap", tmp_path / "poses.jsonl"
    program = [sys.executable, "-m", "phasemark", "live", "-", "--landmark", str(bank.path), "--fix", "bearing",
               "--no-background", "--to", f"mcap:{log}", "--to", f"jsonl:{out}",
               "--json"]  # fmt: skip
    process = subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdin is not None
    began, k = time.monotonic(), 0
    while not (out.exists() and out.read_text().count("\n") >= 5) and time.monotonic() - began < 60:
        row = json.loads(printed[k % 90])
        process.stdin.write(json.dumps({**row, "t_ms": 1e3 * k / RATE_HZ}).encode() + b"\n")
        process.stdin.flush()
        time.sleep(1 / RATE_HZ)
        k += 1
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=20)
    assert process.returncode == 0, stderr.decode()
    status = json.loads(stdout)["status"]
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert status["frames"] == len(rows)
    assert [row["index"] for row in rows] == list(range(len(rows)))
    replayed: Any = open_source(str(log), preset(SENSOR), in_time=False)
    assert replayed.searches() == {}
    assert all("x_m" in row for row in rows if row["accepted"])


def test_the_command_replays_a_recording(bank, printed, tmp_path, capsys):
    path = tmp_path / "frames.log"
    path.write_bytes(b"".join(printed[:10]))
    words = ["live", str(path), "--landmark", str(bank.path), "--fix", "bearing", "--no-background", "--at-once"]
    assert main(words) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(rows) == 10
    assert rows[-1]["accepted"]
    # a disk that is full is told in a line and by the exit code; other sinks get every frame
    assert main([*words, "--to", "jsonl:/dev/full", "--force", "--to", "-"]) == 5
    told = capsys.readouterr()
    assert len(told.out.splitlines()) == 10
    assert "jsonl:/dev/full: No space left on device; what was to be written there is not whole" in told.err
    assert told.err.count("No space left on device") == 2  # a note when it happens, and the error at the end
    assert main([*words, "--delay-ms", "nan"]) == 2
    assert "--delay-ms must be from -10000 to 10000, got nan" in capsys.readouterr().err
    assert main(["live", str(path), "--landmark", "cone"]) == 2
    assert "--landmark cone needs --sensor NAME" in capsys.readouterr().err


def rig_drive():
    """A drive of four sensors in a room, 8 stops of one frame, 0.2 s apart."""
    wall_map, rig = room(box=[{"x_m": 1.1, "y_m": 1.5, "size_m": [0.4, 0.3, 1]}]), ring_rig(4)
    angle = np.linspace(0.3, 1.3, 8)
    path = np.column_stack([1.6 + 0.6 * np.cos(angle), 1.4 + 0.5 * np.sin(angle), angle + 1.5])
    drive = simulated_recording(wall_map, rig, path, np.random.default_rng(4))
    return wall_map, rig, path, replace(drive, time_s=drive.time_s + 0.2 * np.arange(8)[:, None])


def test_a_rig_among_walls_is_followed_as_locate_follows_its_recording(tmp_path, capsys):
    wall_map, rig, path, drive = rig_drive()
    for name, text in (("room.toml", wall_map.to_toml()), ("rig.toml", rig.to_toml())):
        (tmp_path / name).write_text(text)
    (tmp_path / "drive.npz").write_bytes(recording_bytes(drive, rig))
    files = ["--map", str(tmp_path / "room.toml"), "--rig", str(tmp_path / "rig.toml")]
    assert main(["live", str(tmp_path / "drive.npz"), *files, "--at-once"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    read = read_rig_recording(tmp_path / "drive.npz", rig)
    expected = Locator(wall_map, rig).follow(read, {0: np.full(3, np.nan)})
    assert [row["accepted"] for row in rows] == [one.accepted for one in expected]
    assert sum(row["accepted"] for row in rows) >= 6
    for row, one, true in zip(rows, expected, path, strict=True):
        if one.accepted:
            pose = [row["x_m"], row["y_m"], math.radians(row["heading_deg"])]
            np.testing.assert_allclose(pose, one.pose, rtol=1e-12)
            assert (np.abs(one.pose - true) < 5 * np.sqrt(np.diag(one.covariance))).all()
    assert main(["live", "-", *files, "--landmark", "cone"]) == 2
    assert "give --landmark" in capsys.readouterr().err


def rig_lines(drive, names):
    """Lines of JSON of a recording, one a sensor."""
    for k in range(len(drive)):
        x, y, yaw = drive.odometry[k]
        for s, name in enumerate(names):
            mm = [None if np.isnan(value) else 1e3 * value for value in drive.depth_m[k, 0, s].tolist()]
            row = {
                "sensor": name,
                "t_ms": 1e3 * drive.time_s[k, 0],
                "distances": mm,
                "odometry": [x, y, math.degrees(yaw)],
            }
            yield json.dumps(row).encode() + b"\n"


def test_lines_of_a_rig_s_sensors_are_frames_and_unknown_or_silent_sensors_are_told():
    wall_map, rig, path, drive = rig_drive()
    frames = list(zip(*[iter(rig_lines(drive, rig.names))] * len(rig.names), strict=True))
    read, write = os.pipe()
    sent = []

    def all_answered(updates):
        if len(sent) == len(updates) < len(frames):  # a frame comes once the one before is answered: none is dropped
            sent.append(os.write(write, b"".join(frames[len(sent)])))
        return len(updates) == len(frames)

    source = RigLines(Stream("pipe", lambda: os.fdopen(os.dup(read), "rb")), rig)
    updates, session = run(source, MapTracker(Locator(wall_map, rig), 0.5, 1.0), until=all_answered, most_s=60.0)
    os.close(write)
    os.close(read)
    assert len(updates) == len(frames)
    assert session.status.dropped == 0
    accepted = [one for one in updates if not one.reason]
    assert len(accepted) >= 6
    for one in accepted:
        off = one.located.estimate.pose - path[round(one.stamp_s / 0.2)]
        assert (np.abs(off) < 5 * np.sqrt(np.diag(one.located.estimate.covariance))).all()
    garbled = [frames[0][1].replace(b'"s1"', b'{"s": %d}' % k) for k in range(len(frames))]
    board = FakeBoard([line for bad, frame in zip(garbled, frames, strict=True) for line in (bad, *frame)], 100)
    updates, session = run(open_rig_source(board.on_terminal(), rig), _SlowLocator(0.0), until=lambda found: found[1:])
    board.unplug()
    assert len(updates) >= 2
    assert session.status.damaged >= 2
    for names, message in ((("s0", "s1", "top"), "name the sensor 'top', the rig has s0, s1, s2, s3"),
                           (("s0", "s1", "s0"), "none of 20 frames names the rig's sensor s2, s3")):  # fmt: skip
        board = FakeBoard(list(rig_lines(drive, names)) * 3, 400)
        with pytest.raises(UsageError, match=message):
            run(open_rig_source(board.on_terminal(), rig), _SlowLocator(0.0))
        board.unplug()


def test_data_that_are_late_are_placed_by_the_odometry_or_told_as_late():
    """A robot moves at 0.4 m/s and 0.5 rad/s, and its sensors show where it was 0.1 s ago."""
    wall_map, rig, _, _ = rig_drive()
    late = Rig(sensor=[{**one.model_dump(exclude_none=True), "delay_s": 0.1} for one in rig.sensor])
    times: Any = 0.2 * np.arange(8)

    def path(time_s):
        yaw = 0.3 + 0.5 * time_s
        return np.column_stack([1.4 + 0.8 * (np.sin(yaw) - np.sin(0.3)), 1.2 - 0.8 * (np.cos(yaw) - np.cos(0.3)), yaw])

    seen = simulated_recording(wall_map, rig, path(times - 0.1), np.random.default_rng(6))
    for odometry, aged_s in ((path(times), 0.0), (None, 0.1)):
        drive = replace(seen, time_s=times[:, None], odometry=odometry)
        tracker = MapTracker(Locator(wall_map, late), 0.5, 1.0)
        found = [tracker.locate(drive.one(k), float(times[k])) for k in range(8)][1:]  # the first one has none before
        assert all(one.estimate.accepted for one in found)
        assert [one.aged_s for one in found] == pytest.approx([aged_s] * 7)
        off = [one.estimate.pose - true for one, true in zip(found, path(times[1:] - aged_s), strict=True)]
        std = [np.sqrt(np.diag(one.estimate.covariance)) for one in found]
        assert np.abs(np.divide(off, std)).max() < 3.0  # 40 mm are three of them, in each frame
        assert np.abs(np.mean(off, axis=0)[:2]).max() < 0.012


def test_the_last_frame_of_a_stream_that_ends_is_read_whole_or_not(tmp_path):
    _, rig, _, drive = rig_drive()
    lines = list(rig_lines(drive, rig.names))
    file = tmp_path / "lines"
    for kept, end in ((lines, b""), (lines, b"\n"), (lines[:-1], b"\n")):
        file.write_bytes(b"".join(kept).rstrip(b"\n") + end)
        source = RigLines(Stream("-", partial(open, file, "rb"), ends=True), rig)
        frames: Any = [arrival.frames for arrival in source.frames()]
        assert len(frames) == len(drive)
        assert np.isnan(frames[-1].depth_m[0, 0, 3]).all() == (len(kept) < len(lines))


def test_a_session_that_cannot_begin_leaves_the_files_of_its_sinks(tmp_path, capsys):
    wall_map, rig, _, drive = rig_drive()
    kept, new = tmp_path / "old.jsonl", tmp_path / "new.jsonl"
    kept.write_text("poses\n")
    for name, content in (("room.toml", wall_map.to_toml()), ("rig.toml", rig.to_toml())):
        (tmp_path / name).write_text(content)
    (tmp_path / "drive.npz").write_bytes(recording_bytes(drive, rig))
    rig_words = ["--map", str(tmp_path / "room.toml"), "--rig", str(tmp_path / "rig.toml"), "--at-once"]
    words = ["live", str(tmp_path / "drive.npz"), *rig_words]
    for wrong in (["--to", "mavlink:nonsense"], ["--to", f"mcap:{tmp_path / 'log.mcap'}"]):
        assert main([*words, "--force", "--to", f"jsonl:{kept}", *wrong]) == 2
        assert main([*words, "--to", f"jsonl:{new}", *wrong]) == 2
    assert main([*words, "--to", f"jsonl:{kept}"]) == 4
    assert kept.read_text() == "poses\n"
    assert not new.exists()


def test_zones_of_another_mode_or_damaged_odometry_are_no_frames_and_a_strange_stream_is_told(tmp_path):
    rig, file = ring_rig(4), tmp_path / "lines"
    row = {"sensor": "s0", "distances": [1000] * 16, "t_ms": 1}
    whole = {**row, "distances": [1000] * 64}
    long = json.dumps(whole)[:-1] + ', "odometry": [1' + "0" * 400 + ", 0, 0]}"
    for lines, message in ((json.dumps(row), "16 zones, the sensor has 8 × 8"), (long, "'odometry' must be")):
        file.write_text(f"{lines}\n" * 3)
        source = RigLines(Stream("-", partial(open, file, "rb"), ends=True), rig)
        assert list(source.frames()) == []
        assert source.n_damaged == 3
        assert message in source.damage
    file.write_text("1, 2, 3\n" * 300)
    with pytest.raises(UsageError, match="none of 256 lines is JSON with 'sensor' and 'distances'"):
        list(RigLines(Stream("-", partial(open, file, "rb"), ends=True), rig).frames())


def test_lines_of_sensors_with_different_zones_are_one_frame(tmp_path):
    rig = Rig(sensor=[{"name": "fine"}, {"name": "coarse", "preset": "vl53l5cx-4x4"}])
    rows: Any = [{"sensor": name, "distances": [1000] * n, "t_ms": 1} for name, n in (("fine", 64), ("coarse", 16))]
    file = tmp_path / "lines"
    file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    source = RigLines(Stream("-", partial(open, file, "rb"), ends=True), rig)
    frames: Any = [arrival.frames for arrival in source.frames()]
    assert source.n_damaged == 0
    np.testing.assert_array_equal(frames[0].depth_m[0, 0], [[1.0] * 8, [1.0] * 4 + [np.nan] * 4])
    rig = Rig(sensor=[{"name": "fine"}, {"name": "coarse", "rows": 1, "columns": 4}])
    file.write_text("".join(json.dumps({**row, "distances": row["distances"][:n]}) + "\n"
                            for row, n in zip(rows, (64, 4), strict=True)))  # fmt: skip
    frames = [arrival.frames for arrival in RigLines(Stream("-", partial(open, file, "rb"), ends=True), rig).frames()]
    np.testing.assert_array_equal(frames[0].depth_m[0, 0], [[1.0] * 8, [1.0] * 4 + [np.nan] * 4])


def test_a_sensor_of_a_rig_that_repeats_itself_while_the_robot_moves_is_left_out_and_told(tmp_path):
    wall_map, rig, path, drive = rig_drive()
    drive.depth_m[2:, :, 1] = drive.depth_m[1, :, 1]
    (tmp_path / "drive.npz").write_bytes(recording_bytes(drive, rig))
    source = RecordedRig(tmp_path / "drive.npz", rig, in_time=False)
    source.recording = drive  # as a stream has it: frame by frame
    said: list[str] = []
    updates, _ = run(source, MapTracker(Locator(wall_map, rig), 0.5, 1.0), said=said)
    assert [one.located.stuck for one in updates] == [(), (), (), *[("s1",)] * 5]
    assert [line for line in said if "stuck" in line] == [f"{source.name}: s1 is stuck and left out"]
    published = [(one.located.estimate.pose, true) for one, true in zip(updates, path, strict=True) if not one.reason]
    assert len(published) >= 4
    assert all(np.hypot(*(pose - true)[:2]) < 0.1 for pose, true in published)


@pytest.mark.parametrize("kind", ["jsonl", "mcap"])
def test_no_sink_writes_over_what_a_session_reads(tmp_path, capsys, kind):
    wall_map, rig, _, drive = rig_drive()
    for name, content in (("room.toml", wall_map.to_toml().encode()), ("rig.toml", rig.to_toml().encode()),
                          ("drive.npz", recording_bytes(drive, rig))):  # fmt: skip
        (tmp_path / name).write_bytes(content)
    room_file, rig_file, frames = (str(tmp_path / name) for name in ("room.toml", "rig.toml", "drive.npz"))
    words = ["live", frames, "--map", room_file, "--rig", rig_file, "--at-once", "--force"]
    for file in (room_file, rig_file, frames):
        before = Path(file).read_bytes()
        assert main([*words, "--to", f"{kind}:{file}"]) == 2
        assert "is an input too" in capsys.readouterr().err
        assert Path(file).read_bytes() == before
    out = str(tmp_path / "out")
    assert main([*words, "--to", f"{kind}:{out}", "--to", f"jsonl:{out}"]) == 2
    assert "each sink must have a file of its own" in capsys.readouterr().err
    assert main([*words, "--flip-h"]) == 2
    assert "go with --landmark" in capsys.readouterr().err


@pytest.mark.soak
def test_a_long_session_leaks_neither_memory_nor_descriptors(bank, printed):
    """Thirty minutes at 60 Hz; PHASEMARK_SOAK_MINUTES sets another length."""
    minutes = float(os.environ.get("PHASEMARK_SOAK_MINUTES", "30"))
    n = round(minutes * 60 * 60)

    def lines():
        for k in range(n):
            row = json.loads(printed[k % 90 if k % 180 < 90 else 89 - k % 90])
            yield json.dumps({**row, "t_ms": 1e3 * k / 60}).encode() + b"\n"

    board, marks = FakeBoard(lines(), 60.0), []

    def note(updates):
        if len(updates) > 500:
            del updates[:]
            marks.append((resident(), len(os.listdir("/proc/self/fd"))))
        return board.is_done.is_set()

    source = open_source(board.on_terminal(), preset(SENSOR))
    run(source, tracker_of(bank), until=note, most_s=60 * minutes + 60)
    board.unplug()
    settled = len(marks) // 4
    memory, descriptors = np.array(marks[settled:]).T
    assert memory[-3:].mean() < 1.01 * memory[:3].mean()
    assert descriptors.max() == descriptors.min()


def resident():
    return int(Path("/proc/self/statm").read_text().split()[1])
