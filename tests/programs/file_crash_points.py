"""Kill or fail the writing of a picture, table or plan at its k-th call to the system; a program, run by the tests.

usage: python -m programs.file_crash_points FOLDER kill|ENOSPC|EIO|other

"other" has a second run write the same file at that call, without --force where the first has none. The file is old or
new, and never has the checksum of another content. Prints how many points there were.
"""

import signal
import sys
from pathlib import Path

from programs.system_calls import ended, in_fork

from phasemark import OutputExistsError
from phasemark.data.files import write_atomically
from phasemark.inputs import checksum_path, verify_checksum


def second(path: Path, force: bool) -> int:
    try:
        write_atomically(path, b"second", force=force, checksum=force)
    except OutputExistsError:
        return 4
    return 0


def fail_at(path: Path, at: int, action: str, force: bool) -> int:
    seconds: list[int] = []
    act = (lambda: seconds.append(in_fork(second, path, force))) if action == "other" else action
    code = ended(lambda: write_atomically(path, [b"new"], force=force, checksum=force), at, act)
    if code == 4:
        assert seconds in ([0], [4])
    elif code in (0, 6):
        assert force or seconds in ([], [4]), "both believe that they made the file"
    return code


def main(folder: Path, action: str) -> None:
    points = 0
    for force in (False, True):
        for at in range(1, 100):
            path = folder / "picture.png"
            if force:
                write_atomically(path, b"old", checksum=True)
            code = in_fork(fail_at, path, at, action, force)
            where = f"{action} at call {at} with force {force}, exit code {code}"
            allowed = {"kill": (-signal.SIGKILL, 0), "other": (0, 4, 6)}.get(action, (0, 5, 6))
            assert code in allowed, where
            assert path.read_bytes() in (b"old", b"new", b"second") if path.exists() else not force, where
            if checksum_path(path).exists():
                verify_checksum(path)
            if action != "kill":
                left = {entry.name for entry in folder.iterdir()}
                left -= {"picture.png", "picture.png.sha256"}
                # what a failing disk does not remove has a name that the next run tidies up
                tidied = {".picture.png.sha256.old", ".picture.png.lock"} if code == 6 else set()
                assert left <= tidied, f"{where}: debris {left}"
            for entry in folder.iterdir():
                entry.unlink()
            if code == 0:
                break
            points += 1
    sys.stdout.write(f"{points}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
