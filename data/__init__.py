"""Stored data: plans, banks of model images, frame sets, measured frames; every file is written whole or not at all."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.data.bank.bank_file import Bank, open_bank
    from phasemark.data.bank.build_bank import build_bank
    from phasemark.data.frames.build_frames import build_frames
    from phasemark.data.frames.frame_set_file import FrameSet, open_frames
    from phasemark.data.measured.reading import read_frames
    from phasemark.data.plans.bank_plan import BankPlan, read_plan
    from phasemark.data.plans.frame_plan import FramePlan
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "Bank",
    "BankPlan",
    "FramePlan",
    "FrameSet",
    "build_bank",
    "build_frames",
    "open_bank",
    "open_frames",
    "read_frames",
    "read_plan",
]
