"""Measured frames: readers of every accepted form, and a simulated recording."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.data.measured.reading import read_frames, write_measured
    from phasemark.data.measured.simulated import SimulatedRecording, simulate_recording, write_recording
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["SimulatedRecording", "read_frames", "simulate_recording", "write_measured", "write_recording"]
