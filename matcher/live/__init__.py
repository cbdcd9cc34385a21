"""Live poses: a board's frames as they are printed, matched and followed, and published."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.matcher.live.openers import open_sink, open_source
    from phasemark.matcher.live.session import Live
    from phasemark.matcher.live.sinks import Sink
    from phasemark.matcher.live.sources import Source
    from phasemark.matcher.live.tracker import Locator, Tracker
    from phasemark.matcher.live.updates import Update
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = ["Live", "Locator", "Sink", "Source", "Tracker", "Update", "open_sink", "open_source"]
