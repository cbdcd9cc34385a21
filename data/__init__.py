"""What is kept: plans, banks of model images, measured frames, and files that are whole or not there."""

from phasemark.data.bank import Bank, BankGroup, open_bank
from phasemark.data.build import build_bank
from phasemark.data.characterisation import summary_sentences, write_characterisation
from phasemark.data.grid import format_grid, parse_grid
from phasemark.data.measured import read_frames
from phasemark.data.plan import BankPlan, MeshPlan, load_plan
from phasemark.data.provenance import mesh_sha256, versions
from phasemark.data.store import read_checksum, verify_checksum, write_atomically, write_checksum

__all__ = [
    "Bank",
    "BankGroup",
    "BankPlan",
    "MeshPlan",
    "build_bank",
    "format_grid",
    "load_plan",
    "mesh_sha256",
    "open_bank",
    "parse_grid",
    "read_checksum",
    "read_frames",
    "summary_sentences",
    "verify_checksum",
    "versions",
    "write_atomically",
    "write_characterisation",
    "write_checksum",
]
