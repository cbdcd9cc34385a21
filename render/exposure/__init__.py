"""From phasor images to frames, PHYSICS section 4: taps, electrons, noise, stray light and motion."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.render.exposure.ablation import Ablation, ablate
    from phasemark.render.exposure.capture import capture_moving
    from phasemark.render.exposure.motion import Motion, render_moving
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["Ablation", "Motion", "ablate", "capture_moving", "render_moving"]
