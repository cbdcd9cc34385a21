"""Diagnosis of refused frames: the cause, and the change of a setting that would make the frame fit."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.diagnosis.diagnose import Change, Diagnosis
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["Change", "Diagnosis"]
