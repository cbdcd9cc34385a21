"""Recordings in time: stamps, whether the camera stood still, and tables of estimates."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.recordings.stillness import MotionTest, motion_test
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["MotionTest", "motion_test"]
