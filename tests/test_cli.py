"""The frame of the command line: exit codes, one line for every mistake, output that other programs can read."""

import ctypes
import importlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path
from typing import NoReturn

import pytest

from phasemark import PhasemarkError, StorageError, __version__, cli
from phasemark.data.commands import console
from phasemark.data.commands.interruption import Interruption
from phasemark.render import Sensor, preset, preset_names

PHASEMARK = str(Path(sys.executable).with_name("phasemark"))


def test_version_is_printed(run):
    assert run("--version") == (0, f"phasemark {__version__}\n", "")


def test_without_arguments_the_first_steps_are_printed_and_run(run):
    code, out, err = run()
    steps = [line.split("   ")[0].split()[1:] for line in out.splitlines() if line.startswith("  phasemark ")]
    assert (code, err) == (0, "")
    assert steps[0] == ["demo"]
    for step in steps:
        assert run(*step, "--help").code == 0


def test_listed_sensors_are_the_shipped_ones(run):
    assert [line.split()[0] for line in run("sensor", "list").out.splitlines()[1:]] == preset_names()
    assert [entry["name"] for entry in json.loads(run("sensor", "list", "--json").out)] == preset_names()


@pytest.mark.parametrize("name", preset_names())
def test_a_shown_sensor_is_a_sensor_file_again(run, name, tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text(run("sensor", "show", name).out, encoding="utf-8")
    assert Sensor.from_toml(path) == preset(name)
    assert run("sensor", "show", str(path)).out == run("sensor", "show", name).out


def test_a_direct_sensor_is_shown_without_a_modulation_of_its_own(run):
    shown = run("sensor", "show", "vl53l5cx-8x8")
    assert "no modulation" in shown.out.splitlines()[0]
    assert shown.out.splitlines()[1].startswith("# modulation_hz: of the model alone")
    assert json.loads(run("sensor", "show", "vl53l5cx-8x8", "--json").out)["unambiguous_range_m"] is None


def test_a_sensor_as_json_has_every_field(run):
    shown = json.loads(run("sensor", "show", "pmd-16x16", "--json").out)
    assert set(Sensor.model_fields) - {"histogram", "lens"} < set(shown)  # tables that some sensors have
    assert shown["unambiguous_range_m"] == pytest.approx(14.9896, abs=5e-5)  # c / 2f as PHYSICS section 3 prints it


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("sensor", "show", "pmd-17x17"), 2, ["pmd-17x17", "pmd-16x16", ".toml"]),
        (("sensor", "show", "missing.toml"), 3, ["missing.toml"]),
        (("sensor", "show"), 2, ["NAME|FILE", "phasemark sensor show --help"]),
        (("sensor", "show", "ideal", "--jsn"), 2, ["--jsn"]),
        (("sensor",), 2, ["phasemark sensor --help"]),
        (("snesor",), 2, ["snesor", "phasemark --help"]),
    ],
)
def test_a_mistake_is_one_line_and_its_code(run, arguments, code, words):
    outcome = run(*arguments)
    assert (outcome.code, outcome.out) == (code, "")
    assert outcome.err.startswith("error: ")
    assert outcome.err.count("\n") == 1
    assert "\x1b" not in outcome.err  # no colours where nobody sees them
    assert all(word in outcome.err for word in words)


@pytest.mark.parametrize("error", [PhasemarkError, *PhasemarkError.__subclasses__()])
def test_each_error_has_its_exit_code(run, monkeypatch, error):
    _fail_with(monkeypatch, error("first\nsecond \x1b[2J [bold]third"))
    assert run("sensor", "show", "ideal") == (error.exit_code, "", "error: first second  [2J [bold]third\n")


def test_the_exit_codes_are_the_documented_ones():
    codes = {error.__name__: error.exit_code for error in PhasemarkError.__subclasses__()}
    assert codes == {"UsageError": 2, "InputFileError": 3, "OutputExistsError": 4, "StorageError": 5}


def test_an_operating_system_error_is_a_storage_error(run, monkeypatch):
    _fail_with(monkeypatch, OSError(28, "No space left on device", "bank.h5"))
    assert run("sensor", "show", "ideal") == (5, "", "error: bank.h5: No space left on device\n")


def test_an_interrupt_exits_with_130(run, monkeypatch):
    _fail_with(monkeypatch, KeyboardInterrupt())
    assert run("sensor", "show", "ideal") == (130, "", "error: interrupted\n")


def test_a_signal_within_an_import_ends_the_program_after_it(tmp_path, monkeypatch):
    """Libraries take what is raised in an import for a missing package, and go on."""
    (tmp_path / "guarded.py").write_text(
        "try:\n    import interrupted\nexcept BaseException:\n    interrupted = None\n"
    )
    (tmp_path / "interrupted.py").write_text(
        "import os, signal, time\nos.kill(os.getpid(), signal.SIGTERM)\ntime.sleep(0.2)\nis_whole = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SystemExit) as caught, Interruption():
        _import_and_wait("guarded")
    assert caught.value.code == 143
    assert sys.modules["guarded"].interrupted.is_whole


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("by", ["finaliser", "callback"])
def test_a_signal_where_python_discards_exceptions_ends_the_program_all_the_same(number, code, by, capfd, monkeypatch):
    """Compiled code calls functions whose exceptions go nowhere."""
    monkeypatch.setattr("phasemark.data.commands.interruption._DEAF", ())  # of functions that are not listed there
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with pytest.raises((SystemExit, KeyboardInterrupt)) as caught, Interruption():
        _signal_and_wait(number, by)
    signal.signal(signal.SIGINT, before)
    assert getattr(caught.value, "code", 130) == code
    assert capfd.readouterr() == ("", "")


def _signal_and_wait(number: int, by: str) -> None:
    class Signals:
        def __del__(self) -> None:
            signal.raise_signal(number)

    if by == "finaliser":
        Signals()
    else:
        ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(number))()
    time.sleep(5)


def test_a_signal_that_waits_when_all_is_done_is_not_forgotten(tmp_path, run, monkeypatch):
    (tmp_path / "signalled.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("phasemark.data.commands.interruption._TICK_S", 10.0)
    monkeypatch.setattr(
        "phasemark.data.commands.sensor.read_sensor", lambda name: importlib.import_module("signalled") and preset(name)
    )
    with pytest.raises(SystemExit, match="143"):
        run("sensor", "show", "ideal")
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def _import_and_wait(module: str) -> None:
    importlib.import_module(module)
    time.sleep(5)


def test_a_bug_of_ours_keeps_its_traceback(run, monkeypatch):
    _fail_with(monkeypatch, ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        run("sensor", "show", "ideal")


def _fail_with(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def fail(name_or_file: str) -> Sensor:
        raise error

    monkeypatch.setattr("phasemark.data.commands.sensor.read_sensor", fail)


def test_termination_unwinds_and_exits_with_143():
    program = """
        import sys, time
        from phasemark import cli
        from phasemark.data.commands import sensor

        def wait(name_or_file):
            try:
                print("waiting", flush=True)
                time.sleep(60)
            finally:
                print("cleaned up")

        sensor.read_sensor = wait
        sys.exit(cli.main(["sensor", "show", "ideal"]))
    """
    command = [sys.executable, "-c", textwrap.dedent(program)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "waiting\n"
        process.terminate()
        out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (143, "cleaned up\n", "")


def test_a_reader_that_went_away_is_no_error():
    read_end, write_end = os.pipe()
    os.close(read_end)
    done = subprocess.run([PHASEMARK, "sensor", "list"], stdout=write_end, stderr=subprocess.PIPE, text=True)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_results_that_find_no_space_exit_with_5():
    with open("/dev/full", "w") as full:
        done = subprocess.run([PHASEMARK, "sensor", "list"], stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (5, "error: No space left on device\n")


def test_a_terminal_without_the_signs_still_gets_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.TextIOWrapper(io.BytesIO(), encoding="cp1251")  # has a degree sign, but no multiplication sign
    monkeypatch.setattr(sys, "stdout", terminal)
    assert cli.main(["sensor", "list"]) == 0
    assert re.search(r"16 \\xd7 16 +22° \\xd7 22°", terminal.buffer.getvalue().decode("cp1251"))


def test_the_package_runs_as_a_module_and_as_a_program(tmp_path: Path) -> None:
    as_module, as_program = (
        subprocess.run([*command, "snesor"], cwd=tmp_path, capture_output=True, text=True)
        for command in ([sys.executable, "-m", "phasemark"], [PHASEMARK])
    )
    assert as_module.returncode == as_program.returncode == 2
    assert (as_module.stdout, as_module.stderr) == (as_program.stdout, as_program.stderr)


class Clock:
    """Time that passes when the test moves it."""

    seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


def test_a_line_of_progress_says_what_how_far_and_for_how_long(capsys):
    clock = Clock()
    progress = console.LongWork("rendering", clock)
    with progress as report:
        clock.seconds = 10.0
        assert progress._line() == "rendering: 10 s elapsed"
        report(7, 200)
        clock.seconds = 83.2
        assert progress._line() == "rendering: 7/200, 1 min 23 s elapsed"
        clock.seconds = 3600 * 5 + 60 * 7 + 3
        assert progress._line() == "rendering: 7/200, 5 h 7 min elapsed"
    assert capsys.readouterr().err == ""  # as it took no time on a real clock


@pytest.mark.parametrize(
    ("command", "what"),
    [
        (["bank", "build", "--class", "cone", "--distance", "1", "--delta", "0", "-o", "b.h5"], "rendering"),
        (["frames", "build", "frames.toml", "--views", "1", "-o", "f.h5"], "rendering"),
        (["sweep", "run", "paper", "-o", "s"], "trials"),
        (["landmark", "design", "-o", "d"], "searching"),
        (["demo", "-o", "o"], "matching"),
        (["drive", "-o", "o"], "driving, cm"),
        (["sensor", "characterise", "ideal", "-o", "c"], "measuring"),
    ],
)
def test_long_work_writes_lines_where_stderr_is_no_terminal(run, monkeypatch, tmp_path, command, what):
    # The work itself is replaced by waiting for two lines.
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(console, "PROGRESS_SECONDS", 1e-3)
    (tmp_path / "frames.toml").write_text("views = 1\n", encoding="utf-8")
    lines: list[str] = []
    two = threading.Event()

    def echo(message: object = "", err: bool = False, **options: object) -> None:
        lines.append(str(message))
        if len(lines) == 2:
            two.set()

    def work(*arguments: object, **options: object) -> NoReturn:
        assert two.wait(60)
        raise StorageError("enough")

    monkeypatch.setattr("phasemark.cli.typer.echo", echo)
    for name in (
        "data.build_bank", "data.build_frames", "matcher.sweep.run_sweep", "matcher.design.run_design",
        "matcher.drive.run_drive", "render.characterise",
    ):  # fmt: skip
        monkeypatch.setattr(f"phasemark.{name}", work)
    assert run(*command) == (5, "", "error: enough\n")
    assert [line.partition(":")[0] for line in lines[:2]] == [what] * 2


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("phasemark ba", "bank"),
        ("phasemark bank bu", "build"),
        ("phasemark match --me", "--method"),
        ("phasemark match bank.h5 frames.csv --quantity ", "range z"),
        ("phasemark bank build --class c", "cylinder cone"),
        ("phasemark sensor show vl53l5cx-8", "vl53l5cx-8x8"),
        ("phasemark match ban", ""),  # the shell goes on with files
    ],
)
def test_a_shell_is_told_what_may_follow(
    words: str,
    found: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name, value in {
        "COMP_WORDS": words, "COMP_CWORD": str(words.count(" ")), "_PHASEMARK_COMPLETE": "complete_bash"
    }.items():  # fmt: skip
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert (end.value.code, capsys.readouterr().out.split()) == (0, found.split())


def test_completion_can_be_installed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv(
        "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1"
    )  # which shell runs the tests does not matter
    with pytest.raises(SystemExit) as end:
        cli.main(["--show-completion", "bash"])
    assert end.value.code == 0
    assert "_PHASEMARK_COMPLETE=complete_bash" in capsys.readouterr().out


def test_the_accuracy_of_a_class_loads_no_mesh_library_and_nothing_of_files():
    heavy = {"h5py", "matplotlib", "phasemark.data.bank.bank_file", "phasemark.render.direct", "trimesh"}
    command = ["accuracy", "--class", "cone", "--distance", "1.5"]
    program = f"import sys; from phasemark import cli; code = cli.main({command}); print(*sys.modules); sys.exit(code)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (heavy | {"scipy.spatial"}).isdisjoint(done.stdout.splitlines()[-1].split())


def test_a_table_in_pieces_is_aligned_and_has_no_spaces_at_the_end(capsys):
    table = console.Table(("class", "[D]", "m"))
    table.echo([("cone", "1.0", "")])
    table.echo([("a long name", "2.0", "x " * 100 + "x")])
    table.echo([("cone", "\u00e9", "y")])
    assert capsys.readouterr().out.splitlines() == [
        "class  [D]  m",
        "cone   1.0",
        "a long name  2.0  " + "x " * 100 + "x",
        "cone         \u00e9    y",
    ]


def test_a_table_is_folded_to_a_narrow_terminal(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "30")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    console.echo_table(("name", "text"), [("cone", "one two three four five six seven eight")])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 30
    assert " ".join(" ".join(lines).split()) == "name text cone one two three four five six seven eight"


@pytest.mark.parametrize("command", [["match", "frames.csv", "bank.h5"], ["bank", "info", "frames.csv"]])
def test_frames_in_the_place_of_a_bank_are_named(command, tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "frames.csv").write_text("1,2,3\n")
    (tmp_path / "bank.h5").write_bytes(b"")
    code, out, err = run(*command)
    assert (code, out) == (3, "")
    assert "frames.csv: measured frames, not a bank; the bank comes first: phasemark match BANK FRAMES" in err
