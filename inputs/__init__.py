"""Reading of input files: opened once, limited in size, and compared with the checksum beside them."""

from phasemark.inputs.checksum import (
    checksum_line,
    checksum_path,
    is_vouched_for,
    read_checksum,
    sha256_of,
    unverified,
    verify_checksum,
    verifying,
)
from phasemark.inputs.reading import MOST_TOML_BYTES, opened, pipes_read_once, read_text, read_whole
from phasemark.inputs.truth_values import refuse_truth_values

__all__ = [
    "MOST_TOML_BYTES",
    "checksum_line",
    "checksum_path",
    "is_vouched_for",
    "opened",
    "pipes_read_once",
    "read_checksum",
    "read_text",
    "read_whole",
    "refuse_truth_values",
    "sha256_of",
    "unverified",
    "verify_checksum",
    "verifying",
]
