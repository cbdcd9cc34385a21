"""What is kept: plans, banks of model images, frame sets, measured frames, and files that are whole or not there."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.data.bank.bank_file import Bank, BankGroup, open_bank
    from phasemark.data.bank.build_bank import build_bank
    from phasemark.data.export import export_frames
    from phasemark.data.files.atomic_write import write_atomically, write_checksum
    from phasemark.data.files.provenance import mesh_sha256, versions
    from phasemark.data.frames.build_frames import build_frames
    from phasemark.data.frames.frame_set_file import FrameSet, FrameSubset, is_frame_set, open_frames
    from phasemark.data.measured.reading import read_frames, write_measured
    from phasemark.data.measured.simulated import SimulatedRecording, simulate_recording, write_recording
    from phasemark.data.pages.characterisation import summary_sentences, write_characterisation
    from phasemark.data.partial_outputs import build_part, estimate_build, merge_parts, parse_part
    from phasemark.data.plans.bank_plan import BankPlan, MeshPlan, read_bank_plan, read_plan
    from phasemark.data.plans.frame_plan import Distribution, FramePlan
    from phasemark.data.plans.grid_axis import format_grid, parse_grid
    from phasemark.data.plans.size import planned_size
    from phasemark.data.verify import verify_bank, verify_frames
    from phasemark.inputs import read_checksum, unverified, verify_checksum
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "Bank",
    "BankGroup",
    "BankPlan",
    "Distribution",
    "FramePlan",
    "FrameSet",
    "FrameSubset",
    "MeshPlan",
    "SimulatedRecording",
    "build_bank",
    "build_frames",
    "build_part",
    "estimate_build",
    "export_frames",
    "format_grid",
    "is_frame_set",
    "merge_parts",
    "mesh_sha256",
    "open_bank",
    "open_frames",
    "parse_grid",
    "parse_part",
    "planned_size",
    "read_bank_plan",
    "read_checksum",
    "read_frames",
    "read_plan",
    "simulate_recording",
    "summary_sentences",
    "unverified",
    "verify_bank",
    "verify_checksum",
    "verify_frames",
    "versions",
    "write_atomically",
    "write_characterisation",
    "write_checksum",
    "write_measured",
    "write_recording",
]
