"""Kill or fail the writing of a folder at its k-th call to the system, for every k; a program, run by the tests.

usage: python -m programs.folder_crash_points FOLDER kill|ENOSPC|EIO|other exchange|two-renames

"other" has a second run write the same folder at that call. Afterwards the folder is the old or the new one, whole,
and another run leaves nothing but its own. Without an exchange in one step, and only when killed, the name may be
missing until the next run. Prints how many points there were.
"""

import shutil
import signal
import sys
from pathlib import Path

from programs.system_calls import ended, in_fork

from phasemark import OutputExistsError
from phasemark.data.files import renames
from phasemark.data.files.replaced_folder import replacing_folder


def write(path: Path, mark: str, *, force: bool) -> None:
    with replacing_folder(path, "test", force=force) as temporary:
        (temporary / "inner").mkdir()
        for k in range(2):
            (temporary / "inner" / f"{mark}{k}").write_text(mark)
        (temporary / mark).write_text(mark)


def again(path: Path) -> int:
    write(path, "next", force=True)
    return 0


def content(path: Path) -> list[str]:
    return sorted(str(one.relative_to(path)) for one in path.rglob("*") if not one.name.startswith("."))


def second(path: Path) -> int:
    try:
        write(path, "second", force=True)
    except OutputExistsError:
        return 4
    return 0


def fail_at(path: Path, at: int, action: str, force: bool) -> int:
    return ended(
        lambda: write(path, "new", force=force), at, (lambda: in_fork(second, path)) if action == "other" else action
    )


def main(folder: Path, action: str, way: str) -> None:
    if way == "two-renames":
        renames._renameat2 = lambda source, target, flags: False
    points = 0
    for with_old in (False, True):
        for at in range(1, 1000):
            path = folder / "out"
            if with_old:
                write(path, "old", force=False)
            code = in_fork(fail_at, path, at, action, with_old)
            where = f"{action} at call {at}, exit code {code}"
            whole = [["inner", f"inner/{mark}0", f"inner/{mark}1", mark] for mark in ("new", "old", "second")]
            missing = not with_old or (action == "kill" and way == "two-renames")
            assert content(path) in whole if path.exists() else missing, f"{where}: {content(path)}"
            if action not in ("kill", "other") and code != 6:
                left = [entry.name for entry in folder.iterdir() if entry != path]
                # what cannot be removed is tidied up by the next run
                assert code == 0 or all(name.startswith(".out.") for name in left), f"{where}: debris {left}"
            if with_old and action == "kill" and not path.exists():
                assert content(folder / ".out.old") == whole[1], f"{where}: the old folder is lost"
            if code == 0 and action != "other":
                break
            allowed = {"kill": (-signal.SIGKILL,), "other": (0, 4, 6)}.get(action, (5, 6))
            assert code in allowed, where
            assert in_fork(again, path) == 0, f"{where}: cannot be written again"
            assert content(path) == ["inner", "inner/next0", "inner/next1", "next"], where
            left = sorted(entry.name for entry in folder.iterdir())
            assert left == ["out"], f"{where}: the next run leaves {left}"
            shutil.rmtree(path)
            if code == 0:
                break
            points += 1
        shutil.rmtree(folder / "out", ignore_errors=True)
    sys.stdout.write(f"{points}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
