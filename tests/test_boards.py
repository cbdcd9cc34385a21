"""Text that boards print: each format written as the original program's printf does, and read back."""

# ruff: noqa: UP031  # the formats stand as in the programs that print them

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from phasemark import InputFileError, UsageError
from phasemark.cli import main
from phasemark.data import read_frames
from phasemark.data.commands.options import BoardWord
from phasemark.data.measured.boards import BOARDS
from phasemark.render import Sensor, preset

SENSORS = {4: preset("vl53l5cx-4x4"), 8: preset("vl53l5cx-8x8")}
TMF = preset("tmf8828-8x8")
Frames = NDArray[np.int64]


def images(width: int, n_frames: int = 3) -> Frames:
    """Return frames in the chip's order of zones, millimetres: an L of near zones, every zone another number."""
    rows, cols = np.indices((width, width))
    near = (cols == 1) | ((rows == width - 1) & (cols < 3))
    return np.stack([np.where(near, 500, 900) + width * rows + cols + 100 * k for k in range(n_frames)])


def sparkfun(zones: Frames, status: Frames) -> Iterable[str]:
    yield "SparkFun VL53L5CX Imager Example\r\n"
    yield "Initializing sensor board. This can take up to 10s. Please wait.\r\n"
    width = zones.shape[-1]
    for distance_mm in zones.reshape(len(zones), -1):
        for y in range(0, width * (width - 1) + 1, width):
            for x in range(width - 1, -1, -1):
                yield f"\t{distance_mm[x + y]}"
            yield "\r\n"
        yield "\r\n"


def adafruit(zones: Frames, status: Frames) -> Iterable[str]:
    yield "Adafruit VL53L5CX simpletest\r\n============================\r\nRanging frequency: 15 Hz\r\n\r\n"
    width = zones.shape[-1]
    for distance_mm in zones.reshape(len(zones), -1):
        for x in range(width - 1, -1, -1):
            for y in range(width * (width - 1), -1, -width):
                yield f"\t{distance_mm[x + y]}"
            yield "\r\n"
        yield "\r\n"


def adafruit_webserial(zones: Frames, status: Frames) -> Iterable[str]:
    width = zones.shape[-1]
    order = [x + y for x in range(width - 1, -1, -1) for y in range(width * (width - 1), -1, -width)]
    yield "VL53L5CX WebSerial Demo\r\nREADY\r\n"
    for distance_mm, codes in zip(zones.reshape(len(zones), -1), status.reshape(len(zones), -1), strict=True):
        yield f"FRAME_START\r\nRES:{width**2}\r\nRATE:15\r\n"
        yield f"D:{','.join(str(distance_mm[k]) for k in order)}\r\n"
        yield f"S:{','.join(str(codes[k]) for k in order)}\r\nFRAME_END\r\n"


def adafruit_nost(zones: Frames, status: Frames) -> Iterable[str]:
    yield "VL53L5CX NoST 8x8 Demo\r\nSensor initialized\r\n"
    for frame in np.where(status == 5, zones, 20000):
        for row in frame:
            for value in row:
                yield f"{value}\t" if value < 10000 else "----\t"
            yield "\r\n"
        yield "\r\n"


def st_zones(zones: Frames, status: Frames) -> Iterable[str]:
    yield "Initialize... Please wait, it may take few seconds...\r\n"
    for k, (frame, codes) in enumerate(zip(zones, status, strict=True)):
        yield "Print data no : %3u\r\n" % k
        for i, (mm, code) in enumerate(zip(frame.ravel(), codes.ravel(), strict=True)):
            yield "Zone : %3d, Status : %3u, Distance : %4d mm\r\n" % (i, code, mm)
        yield "\r\n"
    yield "End of ULD demo\r\n"


def st_targets(zones: Frames, status: Frames) -> Iterable[str]:
    for k, (frame, codes) in enumerate(zip(zones, status, strict=True)):
        yield "Print data no : %3u\r\n" % k
        for i, (mm, code) in enumerate(zip(frame.ravel(), codes.ravel(), strict=True)):
            yield "Zone %3u : %2u, %6u, %6u, " % (i, 2 * (code == 5), 3, 1024)
            for j, far in enumerate((0, 700)):
                yield "Target[%1u] : %2u, %4d, %6u, %3u, " % (j, 5, mm + far, 200, 4)
            yield "\r\n"
        yield "\r\n"


def st_boxes(zones: Frames, status: Frames, signal: bool = True) -> Iterable[str]:
    width = zones.shape[-1]
    for frame, codes in zip(zones.reshape(len(zones), -1), status.reshape(len(zones), -1), strict=True):
        yield "\033[2H53L8A1 Simple Ranging demo application\n--------------------------------------\n\n"
        yield "Use the following keys to control application\n 'r' : change resolution\n\nCell Format :\n\n"
        yield " \033[38;5;10m%20s\033[0m : %20s\n" % ("Distance [mm]", "Status")
        yield "\n\n"
        for j in range(0, width**2, width):
            yield " -----------------" * width + "\n" + "|                 " * width + "|\n"
            for target in range(2):
                for k in range(width - 1, -1, -1):
                    if codes[j + k] == 5:
                        mm = frame[j + k] + 700 * target
                        yield "| \033[38;5;10m%5d\033[0m  :  %5d " % (mm, codes[j + k])
                    else:
                        yield "| %5s  :  %5s " % ("X", "X")
                yield "|\n"
                if signal:
                    yield ("| %5d  :  %5d " % (310, 7)) * width + "|\n"
        yield " -----------------" * width + "\n"


def esphome(zones: Frames, status: Frames, metres: bool = True, table: bool = False) -> Iterable[str]:
    width, length = zones.shape[-1], 5 if metres else 4
    yield "[10:00:00][I][app:102]: ESPHome version 2026.1.0 compiled on Jan 1 2026\n"
    for frame, codes in zip(zones.reshape(len(zones), -1), status.reshape(len(zones), -1), strict=True):
        yield "[10:00:01][D][sensor:093]: 'Uptime': Sending state 12.00000 s with 0 decimals of accuracy\n"
        yield "\033[0;36m[10:00:01][D][text_sensor:069]: 'Distances': Sending state '"
        for i, (mm, code) in enumerate(zip(frame, codes, strict=True)):
            if i % width:
                yield "|" if table else ","
            elif i:
                yield "\n" + "-" * (width * length + width - 1) + "\n" if table else ",\n"
            valid = code == 5
            text = ("%.3f" % (mm / 1000) if valid else "nan") if metres else "%d" % (mm if valid else 0)
            yield text.rjust(length)
        yield "'\033[0m\n"


def json_lines(zones: Frames, status: Frames) -> Iterable[str]:
    for k, (frame, codes) in enumerate(zip(zones, status, strict=True)):
        row = {"seq": k, "t_ms": 1000 + 66 * k, "distances": frame.ravel().tolist(), "status": codes.ravel().tolist()}
        yield json.dumps(row) + "\r\n"


def cnh_lines(zones: Frames, status: Frames) -> Iterable[str]:
    for frame, codes in zip(zones, status, strict=True):
        names = {"distance_mm": frame.ravel().tolist(), "target_status": codes.ravel().tolist()}
        yield json.dumps({"type": "cnh_frame", **names}, separators=(",", ":")) + "\n"


def tmf8828(zones: Frames, status: Frames) -> Iterable[str]:
    # place of each of the 16 results of a capture in the image, and its number among the 36 printed
    places = (
        (8, 9, 12, 13, 24, 25, 28, 29, 40, 41, 44, 45, 56, 57, 60, 61),
        (10, 11, 14, 15, 26, 27, 30, 31, 42, 43, 46, 47, 58, 59, 62, 63),
        (0, 1, 4, 5, 16, 17, 20, 21, 32, 33, 36, 37, 48, 49, 52, 53),
        (2, 3, 6, 7, 18, 19, 22, 23, 34, 35, 38, 39, 50, 51, 54, 55),
    )
    numbers = (6, 15, 7, 16, 4, 13, 5, 14, 2, 11, 3, 12, 0, 9, 1, 10)
    yield "#Conf,Period=264ms,KIter=500\n"
    for k, frame in enumerate(np.where(status == 5, zones, 0).reshape(len(zones), 64)):
        for capture in range(4):
            results = np.zeros((36, 2), int)
            results[list(numbers), 0] = frame[list(places[capture])]
            results[18:27] = 1500, 12  # a second object
            header = f"#Obj,65,{(4 * k + capture) % 256},25,18,{388525 + 300000 * (4 * k + capture)}"
            yield ",".join([header, *map(str, results.ravel())]) + "\n"


WRITERS: dict[str, tuple[str, Callable[[Frames, Frames], Iterable[str]], tuple[int, ...]]] = {
    "sparkfun": ("sparkfun", sparkfun, (4, 8)),
    "adafruit": ("adafruit", adafruit, (4, 8)),
    "adafruit-webserial": ("adafruit-webserial", adafruit_webserial, (4, 8)),
    "adafruit-nost": ("adafruit-nost", adafruit_nost, (4, 8)),
    "st-zones": ("st-zones", st_zones, (4, 8)),
    "st-zones, several targets": ("st-zones", st_targets, (4, 8)),
    "st-boxes": ("st-boxes", st_boxes, (4, 8)),
    "st-boxes, no signal": ("st-boxes", lambda zones, status: st_boxes(zones, status, False), (4, 8)),
    "esphome, metres": ("esphome", esphome, (4, 8)),
    "esphome, table": ("esphome", lambda zones, status: esphome(zones, status, False, True), (4, 8)),
    "esphome, table of metres": ("esphome", lambda zones, status: esphome(zones, status, True, True), (4, 8)),
    "esphome, millimetres": ("esphome", lambda zones, status: esphome(zones, status, False), (4, 8)),
    "json": ("json", json_lines, (4, 8)),
    "json, other names": ("json", cnh_lines, (4, 8)),
    "tmf8828": ("tmf8828", tmf8828, (8,)),
}
CASES = [(name, width) for name, (_, _, widths) in WRITERS.items() for width in widths]
PRINT_NO_STATUS = ("sparkfun", "adafruit")


def sensor_of(name: str, width: int) -> Sensor:
    return TMF if name == "tmf8828" else SENSORS[width]


def log_of(name: str, zones: Frames, status: Frames | None = None) -> str:
    return "".join(WRITERS[name][1](zones, np.full(zones.shape, 5) if status is None else status))


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "board.log"
    path.write_bytes(text.encode())
    return path


def expected_range_m(zones: Frames, sensor: Sensor) -> NDArray[np.float64]:
    return zones / 1000 / (sensor.axis_cosine() if sensor.quantity == "z" else 1.0)


def read(path: Path, name: str, width: int, **options: str) -> NDArray[np.float64]:
    if name == "adafruit":
        options = {"board": name, **options}
    return read_frames(path, sensor=sensor_of(name, width), **options).range_m  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "width"), CASES)
def test_what_a_board_prints_is_read_upright_without_unit_quantity_or_status(tmp_path, name, width):
    zones = images(width)
    path = written(tmp_path, log_of(name, zones))
    np.testing.assert_allclose(read(path, name, width)[0], expected_range_m(zones, sensor_of(name, width)), rtol=1e-6)


@pytest.mark.parametrize(("name", "width"), [case for case in CASES if case[0] not in PRINT_NO_STATUS])
def test_a_zone_without_a_target_is_invalid(tmp_path, name, width):
    zones, status = images(width), np.full((3, width, width), 5)
    status[0, 0, 1] = status[1, 2, 3] = 255
    frames = read_frames(written(tmp_path, log_of(name, zones, status)), sensor=sensor_of(name, width))
    assert (frames.valid[0] == (status == 5)).all()


@pytest.mark.parametrize(("name", "width"), CASES)
def test_a_log_that_begins_and_ends_within_frames_has_the_frames_between(tmp_path, name, width):
    zones = images(width, 4)
    lines = log_of(name, zones).splitlines(keepends=True)
    if WRITERS[name][0] == "json":  # a frame is a line: cut within two of them
        text = "".join([lines[0], lines[1], lines[2], lines[3][:30]])
        kept = zones[:3]
    else:
        of_frame = len(log_of(name, zones[:1]).splitlines())
        spared = len(log_of(name, zones[:2]).splitlines()) - of_frame
        text = "".join(lines[of_frame - spared // 2 : -(spared // 2)])
        kept = zones[1:3]
    with pytest.warns(
        UserWarning, match=r"left out [12] of [34] frames.*incomplete or garbled, the first at line \d+: "
    ):
        found = read(written(tmp_path, text), name, width, board=WRITERS[name][0])
    np.testing.assert_allclose(found[0], expected_range_m(kept, sensor_of(name, width)), rtol=1e-6)


@pytest.mark.parametrize(("name", "width"), CASES)
def test_a_garbled_line_costs_its_frame_and_is_named(tmp_path, name, width):
    zones = images(width)
    text, times = re.subn(r"(?<![0-9])(0\.)?601(?![0-9])", r"\g<1>6?1", log_of(name, zones))  # of the second frame
    assert times
    with pytest.warns(UserWarning, match=r"left out 1 of 3 frames.*the first at line \d+: "):
        found = read(written(tmp_path, text), name, width)
    np.testing.assert_allclose(found[0], expected_range_m(zones[[0, 2]], sensor_of(name, width)), rtol=1e-6)


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "tmf8828"])
def test_another_number_of_zones_names_both(tmp_path, name):
    path = written(tmp_path, log_of(name, images(8)))
    with pytest.raises(InputFileError, match=r"board\.log: line \d+: a frame of 64 zones, but the sensor has 4 × 4"):
        read(path, name, 4)


@pytest.mark.parametrize("name", ["sparkfun", "st-zones", "st-boxes", "esphome, table", "json", "adafruit-webserial"])
@pytest.mark.parametrize("other", ["adafruit-nost", "st-zones", "st-boxes", "json", "tmf8828", "esphome, metres"])
def test_logs_of_two_boards_in_one_file_are_refused(tmp_path, name, other):
    if WRITERS[name][0] == WRITERS[other][0]:
        return
    path = written(tmp_path, log_of(name, images(8)) + log_of(other, images(8)))
    with pytest.raises(InputFileError, match=r"line \d+ was printed by board=[a-z0-9-]+, unlike the lines before"):
        read(path, name, 8)


def test_a_print_that_several_boards_share_has_to_be_named(tmp_path):
    path = written(tmp_path, log_of("adafruit", images(8)))
    with pytest.raises(UsageError, match=r"say with board=… which \(sparkfun or adafruit\)"):
        read_frames(path, sensor=SENSORS[8])


@pytest.mark.parametrize(
    ("board", "text", "error", "reason"),
    [
        ("arduino", "", UsageError, "must be one of sparkfun, adafruit"),
        ("st-zones", "json", InputFileError, "line 1 was printed by board=json, not board=st-zones"),
        ("json", "1,2,3", InputFileError, "holds no whole frame of board=json"),
    ],
)
def test_a_wrong_board_is_one_line(tmp_path, board, text, error, reason):
    path = written(tmp_path, log_of("json", images(8)) if text == "json" else text + "\n")
    with pytest.raises(error, match=reason):
        read_frames(path, sensor=SENSORS[8], board=board)


def test_a_board_is_refused_for_a_file_that_no_board_printed(tmp_path):
    np.save(tmp_path / "frames.npy", np.ones((2, 8, 8)))
    with pytest.raises(UsageError, match="board=… goes with text that a board printed"):
        read_frames(tmp_path / "frames.npy", sensor=SENSORS[8], board="json", unit="m", quantity="z")


def test_a_unit_or_quantity_of_the_caller_that_contradicts_the_board_is_refused(tmp_path):
    path = written(tmp_path, log_of("st-zones", images(8)))
    with pytest.raises(UsageError, match=r"quantity=… is range, but .* says z"):
        read_frames(path, sensor=SENSORS[8], quantity="range")


def test_flips_of_the_caller_come_on_top_of_the_board_s_orientation(tmp_path):
    path = written(tmp_path, log_of("sparkfun", images(8)))
    turned = read_frames(path, sensor=SENSORS[8], rotate=90).range_m[0]
    np.testing.assert_allclose(turned, expected_range_m(np.rot90(images(8), -1, (1, 2)), SENSORS[8]), rtol=1e-6)


def test_status_codes_of_the_caller_replace_the_board_s(tmp_path):
    status = np.full((3, 8, 8), 9)
    path = written(tmp_path, log_of("st-zones", images(8), status))
    assert read_frames(path, sensor=SENSORS[8], valid_status=[5, 9]).valid.all()
    assert not read_frames(path, sensor=SENSORS[8]).valid.any()


def test_two_text_sensors_in_one_log_are_refused(tmp_path):
    text = log_of("esphome, millimetres", images(8))
    path = written(tmp_path, text + text.replace("Distances", "Codes"))
    with pytest.raises(
        InputFileError, match="states of the text sensors 'Codes' and 'Distances': keep the lines of one"
    ):
        read_frames(path, sensor=SENSORS[8])


def test_json_lines_have_times(tmp_path):
    frames = read_frames(written(tmp_path, log_of("json", images(8))), sensor=SENSORS[8])
    assert frames.time_s is not None
    np.testing.assert_allclose(frames.time_s, [[1.0, 1.066, 1.132]])


def test_a_table_with_tabs_of_a_frame_a_line_is_still_a_table(tmp_path):
    text = "".join("\t" + "\t".join(f"{mm}" for mm in frame.ravel()[1:9]) + "\n" for frame in images(8))
    nine = Sensor(rows=3, cols=3, half_angle_h_deg=20, half_angle_v_deg=20)
    frames = read_frames(written(tmp_path, text), sensor=nine, unit="mm", quantity="range")
    assert frames.range_m.shape == (1, 3, 3, 3)
    assert not frames.valid[:, :, 0, 0].any()


def test_the_option_offers_every_board():
    assert get_args(BoardWord) == tuple(BOARDS)


def test_commands_read_a_board_s_log_and_name_the_option(tmp_path, capsys):
    path = written(tmp_path, log_of("adafruit", images(8)))
    command = ["frames", "import", str(path), "--sensor", "vl53l5cx-8x8", "--out", str(tmp_path / "a.npz")]
    assert main(command) == 2
    assert "say with --board which (sparkfun or adafruit)" in capsys.readouterr().err
    assert main([*command, "--board", "adafruit"]) == 0
    with np.load(tmp_path / "a.npz") as saved:
        np.testing.assert_allclose(saved["range"][0], expected_range_m(images(8), SENSORS[8]), rtol=1e-6)


def test_lines_of_json_without_histograms_are_drawn_as_frames(tmp_path):
    path = written(tmp_path, log_of("json", images(8)))
    assert main(["frames", "show", str(path), "--sensor", "vl53l5cx-8x8", "--out", str(tmp_path / "a.png")]) == 0


@pytest.mark.soak
def test_a_log_of_100_megabytes_takes_less_than_2_gigabytes(tmp_path):
    frame = "".join("\t".join(["", *["512"] * 8]) + "\r\n" for _ in range(8)) + "\r\n"
    path = tmp_path / "long.log"
    path.write_text("SparkFun VL53L5CX Imager Example\r\n" + frame * (100_000_000 // len(frame)), newline="")
    program = (
        "import sys; from phasemark.data import read_frames; from phasemark.render import preset;"
        "print(read_frames(sys.argv[1], sensor=preset('vl53l5cx-8x8')).n_frames);"
        "print(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"  # ru_maxrss begins at the parent's
    )
    found = subprocess.run([sys.executable, "-c", program, path], capture_output=True, text=True, check=True)
    n_frames, kilobytes = map(int, found.stdout.split())
    assert n_frames == 100_000_000 // len(frame)
    print(f"{n_frames} frames, {kilobytes / 1e6:.2f} GB")
    assert kilobytes < 2e6


def test_json_lines_state_their_unit_and_stamps_that_run_back_are_noted(tmp_path):
    zones = images(8)
    rows = [
        {"distances": (frame.ravel() / 10).tolist(), "unit": "cm", "t_ms": time_ms}
        for frame, time_ms in zip(zones, (100, 200, 0), strict=True)
    ]
    path = written(tmp_path, "\n".join(map(json.dumps, rows)))
    with pytest.warns(UserWarning, match="1 of 3 time stamps run backwards, the first in frame 2"):
        found = read_frames(path, sensor=SENSORS[8])
    np.testing.assert_allclose(found.range_m[0], expected_range_m(zones, SENSORS[8]), rtol=1e-6)
    with pytest.raises(InputFileError, match="holds no whole frame of board=json"):
        read_frames(written(tmp_path, json.dumps({**rows[0], "unit": "inch"})), sensor=SENSORS[8])


def test_captures_of_two_frames_make_no_frame(tmp_path):
    zones = images(8, 4)
    lines = log_of("tmf8828", zones).splitlines(keepends=True)
    found = [k for k, line in enumerate(lines) if line.startswith("#Obj")]
    text = "".join(
        line for k, line in enumerate(lines) if k not in found[6:10]
    )  # the end of one, the begin of the next
    with pytest.warns(UserWarning, match=r"left out 1 of 3 frames.* behind result .*: captures of two frames"):
        frames = read_frames(written(tmp_path, text), sensor=TMF)
    np.testing.assert_allclose(frames.range_m[0], zones[[0, 3]] / 1000, rtol=1e-6)


def test_a_line_that_is_lost_behind_the_distances_costs_its_frame_alone(tmp_path):
    zones = images(8)
    lines = log_of("adafruit-webserial", zones).splitlines(keepends=True)
    codes = [k for k, line in enumerate(lines) if line.startswith("S:")]
    text = "".join(line for k, line in enumerate(lines) if k not in (codes[1], codes[1] + 1))
    with pytest.warns(UserWarning, match="left out 1 of 3 frames"):
        found = read_frames(written(tmp_path, text), sensor=SENSORS[8])
    np.testing.assert_allclose(found.range_m[0], expected_range_m(zones[[0, 2]], SENSORS[8]), rtol=1e-6)
