"""Files that are whole or not there: atomic writes, HDF5, folders with a marker, and the guard of reading."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.data.files.atomic_write import write_atomically, write_checksum
    from phasemark.data.files.provenance import mesh_sha256, versions
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["mesh_sha256", "versions", "write_atomically", "write_checksum"]
