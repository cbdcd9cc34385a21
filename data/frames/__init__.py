"""Sets of simulated frames: the file and how it is built."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.data.frames.frame_set_file import FrameSet, FrameSubset, is_frame_set, open_frames
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["FrameSet", "FrameSubset", "is_frame_set", "open_frames"]
