"""Build wheel and sdist twice from fresh copies of the repository, compare them bit for bit, and keep them.

The times within are those of the last commit, or of ``SOURCE_DATE_EPOCH`` if that is set.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import io
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def run(*command: str | Path, cwd: Path, epoch: int = 0) -> str:
    """Run a command, and end with all its output if it fails."""
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment["SOURCE_DATE_EPOCH"] = str(epoch)
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}\n{' '.join(map(str, command))}: exit code {done.returncode}")
    return done.stdout


def normalise(sdist: Path, epoch: int) -> None:
    """Write an sdist again: names in order, nobody's name, one time for all."""
    out = io.BytesIO()
    with tarfile.open(sdist) as source, tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as target:
        for member in sorted(source.getmembers(), key=lambda each: each.name):
            member.uid = member.gid = 0
            member.uname = member.gname = ""
            member.mtime = epoch
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            member.pax_headers = {}
            target.addfile(member, source.extractfile(member) if member.isfile() else None)
    with sdist.open("wb") as file, gzip.GzipFile("", "wb", 9, file, mtime=epoch) as packed:
        packed.write(out.getvalue())


def build(work: Path, epoch: int) -> dict[str, bytes]:
    """Return wheel and sdist of a fresh copy of the repository, by their names."""
    run("git", "clone", "--quiet", ROOT, work / "source", cwd=ROOT)
    # the archives hold the modes of files, so the umask of the builder must not matter
    run("chmod", "-R", "u=rwX,go=rX", work / "source", cwd=ROOT)
    run(sys.executable, "-m", "build", "--outdir", work / "dist", cwd=work / "source", epoch=epoch)
    (sdist,) = (work / "dist").glob("*.tar.gz")
    normalise(sdist, epoch)
    return {path.name: path.read_bytes() for path in sorted((work / "dist").iterdir())}


def main() -> None:
    """Build twice, compare, and keep."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder of the distributions")
    out: Path = parser.parse_args().out
    committed = run("git", "log", "-1", "--format=%ct", cwd=ROOT).strip()
    epoch = int(os.environ.get("SOURCE_DATE_EPOCH", committed))
    with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as second:
        built, again = build(Path(first), epoch), build(Path(second), epoch)
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in built.items()}
    for name, content in again.items():
        if digests.get(name) != hashlib.sha256(content).hexdigest():
            sys.exit(f"{name}: two builds differ")
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for name, content in built.items():
        (out / name).write_bytes(content)
        print(f"{digests[name]}  {name}")
    (out / "SHA256SUMS").write_text(
        "".join(f"{digest}  {name}\n" for name, digest in digests.items()), encoding="utf-8"
    )


if __name__ == "__main__":
    main()
