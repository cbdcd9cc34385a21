"""Recordings in time: stamps, whether the camera stood still, how images are turned, and tables of estimates."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.recordings.learnt_orientation import LearntOrientation, learn_orientation
    from phasemark.matcher.recordings.stillness import MotionTest, motion_test
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["LearntOrientation", "MotionTest", "learn_orientation", "motion_test"]
