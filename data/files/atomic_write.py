"""Files that are whole or not there: atomic replacement and SHA-256 checksums beside them."""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

from phasemark import InputFileError, OutputExistsError, StorageError, UsageError
from phasemark.data.files import renames
from phasemark.data.files.lock_file import exclusive
from phasemark.inputs import checksum_line, checksum_path, read_checksum, sha256_of
from phasemark.inputs.checksum import read_errors

Buffer = bytes | bytearray | memoryview


def write_atomically(
    path: str | os.PathLike[str], data: Buffer | Iterable[Buffer], *, force: bool = False, checksum: bool = False
) -> Path:
    """Write a file so that under its name there is the old content or all of the new, never a part.

    Parameters
    ----------
    path : path-like
        The file to write.
    data : bytes-like or iterable of bytes-like
        Its content, whole or in pieces.
    force : bool
        Whether an existing file may be replaced.
    checksum : bool
        Whether to write ``FILE.sha256`` too.

    Returns
    -------
    Path
        `path`.

    Raises
    ------
    OutputExistsError
        The file exists and `force` is not set.
    UsageError
        The folder does not exist, or the name is that of a folder or device.
    StorageError
        The disk is full or fails; what was there before is untouched.
    """
    pieces = (data,) if isinstance(data, bytes | bytearray | memoryview) else data
    with replacing(path, force=force, checksum=checksum) as temporary, temporary.open("wb") as file:
        for piece in pieces:
            file.write(piece)
    return Path(path)


def write_files(folder: Path, contents: Mapping[str, bytes], *, force: bool) -> list[Path]:
    """Write several files of a folder, by their names, each as :func:`write_atomically` does."""
    return [write_atomically(folder / name, content, force=force) for name, content in contents.items()]


@contextmanager
def replacing(path: str | os.PathLike[str], *, force: bool = False, checksum: bool = False) -> Iterator[Path]:
    """Open an empty temporary file beside `path`, and rename it to `path` when the block ends without an error.

    Whatever ends the block early, an interrupt included, removes the temporary file and leaves `path` as it was. With
    `checksum` the old ``FILE.sha256`` goes before the file is replaced and the new one comes after, so a crash in
    between leaves a file without a checksum, never one with another file's checksum. A file that is replaced keeps its
    permissions, and gets a new checksum if it had one. A link is followed: what it leads to is replaced.

    Parameters and errors are those of :func:`write_atomically`; an OSError raised in the block is a StorageError.

    Yields
    ------
    Path
        The temporary file.
    """
    path = Path(path)
    if not path.name:
        raise UsageError(f"'{path}' is not a file name")
    real = followed(path)
    checksum = checksum or (force and _names_checksum_of(real))
    targets = [real, checksum_path(real)] if checksum else [real]
    for target in targets:
        refuse_unwritable(target, force=force)
    parts = [target.with_name(f".{target.name}.{secrets.token_hex(4)}.partial") for target in targets]
    try:
        with storage_errors(path):
            # a new file gets the permissions that the umask leaves; one that replaces another gets those at the end
            os.close(os.open(parts[0], os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600 if real.exists() else 0o666))
            yield parts[0]
            digest = sha256_of(parts[0]) if checksum else None
        _put_in_place(parts, targets, digest, force=force)
    finally:
        for leftover in parts:
            with suppress(OSError):
                leftover.unlink(missing_ok=True)


def publish(part: Path, path: Path, digest: str, *, force: bool) -> None:
    """Rename a finished file to its final name and write its checksum file, as :func:`replacing` does.

    Parameters
    ----------
    part : Path
        The finished file, in the folder of `path`.
    path : Path
        The name it gets.
    digest : str
        Its SHA-256.
    force : bool
        Whether existing files may be replaced.

    Raises
    ------
    OutputExistsError, StorageError
        As :func:`write_atomically`; `part` and what was there before are untouched.
    """
    parts, targets = [part, _publishing_names(path)[0]], [path, checksum_path(path)]
    try:
        _put_in_place(parts, targets, digest, force=force)
    finally:
        with suppress(OSError):
            parts[1].unlink(missing_ok=True)


def finish_publishing(path: Path) -> None:
    """Write the checksum of a file that :func:`publish` had just given its name when the process was killed."""
    write_checksum(path, force=True)
    for leftover in (*_publishing_names(path), _lock_path(path)):
        leftover.unlink(missing_ok=True)


def _publishing_names(path: Path) -> tuple[Path, Path]:
    """Return the temporary names of the new and the old checksum; always the same, so a later run tidies them up."""
    name = checksum_path(path).name
    return path.with_name(f".{name}.partial"), path.with_name(f".{name}.old")


def _put_in_place(parts: list[Path], targets: list[Path], digest: str | None, *, force: bool) -> None:
    """Replace a file, and then its checksum; the old checksum steps aside first and returns if the file cannot go.

    Before that the checksum is written, and the new files, with the permissions of those that they replace, are synced.
    """
    path, checksums = targets[0], targets[1:]
    with storage_errors(path):
        if digest is not None:
            parts[1].write_bytes(checksum_line(digest, path.name))
        for part, target in zip(parts, targets, strict=True):
            take_over(part, target)
            sync(part)
    _, aside = _publishing_names(path)
    # both are of the same run
    with storage_errors(path), exclusive(_lock_path(path), path) if checksums else nullcontext():
        for target in targets:  # somebody else may have been faster
            refuse_unwritable(target, force=force)
        try:
            if checksums and checksums[0].exists():
                os.replace(checksums[0], aside)
            for part, target in zip(parts, targets, strict=True):
                move(part, target, force=force)
            sync(path.parent)
        except BaseException:
            if aside.exists() and parts[0].exists():  # the file is still the old one: give it its checksum back
                with suppress(OSError):
                    os.replace(aside, targets[1])
            raise
        finally:
            if not parts[0].exists():
                with suppress(OSError):
                    aside.unlink(missing_ok=True)


def _lock_path(path: Path) -> Path:
    return path.with_name(f".{path.name}.lock")


def move(part: Path, target: Path, *, force: bool) -> None:
    """Rename a file or folder, and refuse one that exists unless `force` allows it."""
    if force:
        os.replace(part, target)
        return
    try:
        renames.rename_new(part, target)
    except FileExistsError:  # somebody else was faster still
        raise OutputExistsError(f"{target}: exists; use force=True to replace it") from None


def write_checksum(path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write ``FILE.sha256`` for an existing file, in the format of ``sha256sum``.

    Parameters
    ----------
    path : path-like
        The file to sum up.
    force : bool
        Whether an existing checksum file may be replaced.

    Returns
    -------
    Path
        The checksum file.

    Raises
    ------
    InputFileError
        The file cannot be read.
    OutputExistsError, StorageError
        As in :func:`write_atomically`.
    """
    path = Path(path)
    with read_errors(path):
        digest = sha256_of(path)
    return write_atomically(checksum_path(path), checksum_line(digest, path.name), force=force)


def refuse_unwritable(path: Path, *, force: bool) -> None:
    """Refuse a name in no folder, of a folder or device, or of a file that exists unless `force` allows it."""
    if path.is_symlink() and force:
        path = followed(path)
    if not path.parent.is_dir():
        raise UsageError(f"{path}: the folder '{path.parent}' does not exist: make it first")
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    except OSError as error:
        raise UsageError(f"{path}: cannot be written ({error.strerror})") from None
    if not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
        raise UsageError(f"{path}: is a {'folder' if stat.S_ISDIR(mode) else 'device'}, give the name of a file")
    if not force:
        raise OutputExistsError(f"{path}: exists; use force=True to replace it")


@contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn an OSError of the block into a StorageError that names `path`."""
    try:
        yield
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror or error})") from error


def take_over(part: Path, target: Path) -> None:
    """Copy permissions of what is replaced to a finished file or folder, and its owner where the system allows it."""
    try:
        old = target.stat()
    except FileNotFoundError:
        return
    with suppress(PermissionError):
        os.chown(part, old.st_uid, old.st_gid)
    os.chmod(part, stat.S_IMODE(old.st_mode))


def followed(path: Path) -> Path:
    """Return the file or folder that a link leads to, or the path itself if it is no link.

    Raises
    ------
    UsageError
        The link leads in a circle, or a checksum beside the link would no longer be right.
    """
    if not path.is_symlink():
        return path
    real = Path(os.path.realpath(path))
    if real.is_symlink():
        raise UsageError(f"{path}: is a link that leads in a circle, give the name of a file")
    beside = checksum_path(path)
    if os.path.lexists(beside) and os.path.realpath(beside) != str(checksum_path(real)):
        raise UsageError(f"{path}: is a link with a checksum of its own, '{beside.name}': give '{real}' instead")
    return real


def _names_checksum_of(path: Path) -> bool:
    """Return whether a file has a checksum beside it, right or wrong."""
    try:
        read_checksum(path)
    except InputFileError:
        return False
    return True


def sync(path: Path) -> None:
    """Flush the content of a file, or the names in a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
