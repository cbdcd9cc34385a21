"""HDF5 files from strangers: what they may contain, and a first reading in a process of its own.

HDF5 can open other files (external links and storage, virtual datasets), load code (filter plug-ins), and be made to
crash or to fill the memory by a damaged or hostile file. :func:`refusal` looks at the structure, without following a
link or reading a value, and says what is not allowed. :func:`first_reading` has a child process do that and read every
value, under limits, before this process opens the file.

This module is also the child's program, so it imports nothing of phasemark.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator

import h5py
import numpy as np

MAX_OBJECTS = 10_000
MAX_DEPTH = 16
MAX_ATTRIBUTES = 200
EXPANSION = 200
"""How many times a file's own size its values may take; deflate reaches 1000."""
FREE_BYTES = 1 << 24
"""What values may take whatever the file's size."""
OWN_EXPANSION, OWN_FREE_BYTES = 4, 1 << 28
"""The same two for our own files, which are read whole and are not packed unless somebody packs them afterwards."""
FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}

_MEMORY_BYTES = 1 << 30  # address space, most of it never touched: what a bare interpreter with NumPy maps
_SECONDS = 3
"""Processor time for small files: what else the machine does is no fault of the file."""
_BYTES_PER_SECOND = 1 << 26
_BLOCK_BYTES = 1 << 22
_SOFT, _EXTERNAL, _HARD = h5py.h5l.TYPE_SOFT, h5py.h5l.TYPE_EXTERNAL, h5py.h5l.TYPE_HARD


class Refusal(Exception):
    """Content that a file must not have."""


def refusal(path: str | os.PathLike[str], *, expansion: int = EXPANSION, free_bytes: int = FREE_BYTES) -> str | None:
    """Return why a file must not be read, or None; no link is followed and no value read.

    Parameters
    ----------
    path : path-like
        An HDF5 file.
    expansion, free_bytes : int
        How many times the file's own size its values may take, and what they may take whatever its size.

    Raises
    ------
    OSError, RuntimeError, ValueError
        HDF5 cannot make sense of it.
    """
    file = h5py.h5f.open(os.fsencode(path), h5py.h5f.ACC_RDONLY)
    try:
        budget = free_bytes + expansion * os.path.getsize(path)
        for _, dataset in _objects(file):
            if isinstance(dataset, h5py.h5d.DatasetID):
                budget -= _declared_bytes(dataset)
                if budget < 0:
                    raise Refusal(f"declares far more values than its {os.path.getsize(path)} bytes can hold")
    except Refusal as error:
        return str(error)
    finally:
        file.close()
    return None


def _objects(file: h5py.h5f.FileID) -> Iterator[tuple[str, h5py.h5g.GroupID | h5py.h5d.DatasetID]]:
    """Yield every object that hard links lead to, once, checked; raise Refusal at what may not be there."""
    root = h5py.h5g.open(file, b"/")
    seen = {h5py.h5o.get_info(root).addr}
    waiting = [("", root, 0)]
    while waiting:
        name, group, depth = waiting.pop()
        _check_attributes(name, group)
        yield name, group
        if depth > MAX_DEPTH:
            raise Refusal("nests its groups without end")
        if group.get_num_objs() > MAX_OBJECTS:
            raise Refusal(f"has more than {MAX_OBJECTS} objects")
        for raw in list(group):
            inner_name = f"{name}/{raw.decode('utf-8', 'replace')}"
            kind = group.links.get_info(raw).type
            if kind == _SOFT:
                if group.links.get_val(raw).startswith(b"/"):
                    raise Refusal(f"'{inner_name}' is a soft link out of its group")
                continue
            if kind != _HARD:
                what = "an external link" if kind == _EXTERNAL else "a link of an unknown kind"
                raise Refusal(f"'{inner_name}' is {what}")
            inner = h5py.h5o.open(group, raw)
            address = h5py.h5o.get_info(inner).addr
            if address in seen:
                continue
            seen.add(address)
            if len(seen) > MAX_OBJECTS:
                raise Refusal(f"has more than {MAX_OBJECTS} objects")
            if isinstance(inner, h5py.h5g.GroupID):
                waiting.append((inner_name, inner, depth + 1))
            elif isinstance(inner, h5py.h5d.DatasetID):
                _check_dataset(inner_name, inner)
                _check_attributes(inner_name, inner)
                yield inner_name, inner


def _check_dataset(name: str, dataset: h5py.h5d.DatasetID) -> None:
    creation = dataset.get_create_plist()
    if creation.get_layout() == h5py.h5d.VIRTUAL:
        raise Refusal(f"'{name}' is a virtual dataset")
    if creation.get_layout() != h5py.h5d.CHUNKED and creation.get_external_count():
        raise Refusal(f"'{name}' keeps its values in another file")
    for k in range(creation.get_nfilters()):
        code = creation.get_filter(k)[0]
        if code not in FILTERS:
            raise Refusal(f"'{name}' is packed with filter {code}: only deflate, shuffle and fletcher32 are read")


def _check_attributes(name: str, owner: h5py.h5g.GroupID | h5py.h5d.DatasetID) -> None:
    count = h5py.h5a.get_num_attrs(owner)
    if count > MAX_ATTRIBUTES:
        raise Refusal(f"'{name or '/'}' has {count} attributes")
    for k in range(count):
        attribute = h5py.h5a.open(owner, index=k)
        size = attribute.get_space().get_simple_extent_npoints() * max(1, attribute.get_type().get_size())
        if size > FREE_BYTES:
            raise Refusal(f"an attribute of '{name or '/'}' declares {size} bytes")


def _declared_bytes(dataset: h5py.h5d.DatasetID) -> int:
    space = dataset.get_space()
    points = 1
    if space.get_simple_extent_type() == h5py.h5s.SIMPLE:
        for size in space.get_simple_extent_dims():
            points *= int(size)  # Python's integers do not wrap as HDF5's do
    return points * max(1, int(dataset.get_type().get_size()))


def read_everything(path: str | os.PathLike[str]) -> None:
    """Read every value and attribute, in small blocks."""
    with h5py.File(path, "r") as file:
        for _, identity in _objects(file.id):
            item = h5py.Dataset(identity) if isinstance(identity, h5py.h5d.DatasetID) else h5py.Group(identity)
            for key in item.attrs:
                if key not in ("DIMENSION_LIST", "REFERENCE_LIST"):
                    item.attrs[key]
            if isinstance(item, h5py.Dataset):
                _read_blocks(item)


def _read_blocks(dataset: h5py.Dataset) -> None:
    if dataset.shape is None:
        return
    if dataset.ndim == 0:
        dataset[()]
        return
    per_row = max(1, dataset.dtype.itemsize * int(np.prod(dataset.shape[1:], dtype=object)))
    if per_row > 16 * _BLOCK_BYTES:
        raise Refusal(f"'{dataset.name}' has rows of {per_row} bytes")
    step = max(1, _BLOCK_BYTES // per_row)
    for start in range(0, dataset.shape[0], step):
        dataset[start : start + step]


def first_reading(path: str | os.PathLike[str]) -> str | None:
    """Read a file whole in a child process; return what is wrong with it, or None.

    The child has a limit on its memory and time, and can neither write nor start anything. It is an ordinary program,
    not a copy of this process, so that notebooks can call this.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    str or None
        What the file contains and may not, or how reading it ended.
    """
    seconds = _SECONDS + os.path.getsize(path) // _BYTES_PER_SECOND
    environment = {
        **{key: value for key, value in os.environ.items() if not key.startswith("HDF5_")},
        "HDF5_PLUGIN_PRELOAD": "::",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry),
        "PYTHONIOENCODING": "utf-8",
    }
    command = [sys.executable, "-P", os.path.abspath(__file__), os.path.abspath(path), str(seconds)]
    # how many times that a child may take in all, before a disk or a pipe that does not answer is given up
    patience = 10
    try:
        child = subprocess.run(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=patience * seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"cannot be read within {patience * seconds} s"
    if child.returncode == 0:
        return None
    if child.returncode == 3:
        return " ".join(child.stdout.decode("utf-8", "replace").split())[:300]
    if child.returncode == -signal.SIGXCPU:
        return f"takes more than {seconds} s of processor time to read"
    return "crashes HDF5, or needs more memory than a file of its kind should"


def _main(path: str, seconds: int) -> int:
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        reason = refusal(path)
        if reason is None:
            read_everything(path)
    except Refusal as error:
        reason = str(error)
    except Exception as error:
        reason = f"damaged ({' '.join(str(error).split()) or type(error).__name__})"
    if reason is not None:
        sys.stdout.write(reason)
    return 0 if reason is None else 3


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1], int(sys.argv[2])))
