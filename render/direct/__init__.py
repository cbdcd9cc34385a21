"""Direct sensors: from a scene to histograms, and from these to the targets a chip reports (PHYSICS section 11)."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use
from phasemark.render.direct.histogram_frames import (
    HistogramFrames,
    capture_histograms,
    nearest_ranges,
    reference_centroid,
)
from phasemark.render.direct.histogram_images import HistogramImages, HistogramRenderer

if TYPE_CHECKING:
    import matplotlib.figure

    from phasemark.render.direct.bin_counts import detected_counts, expected_counts, piled_up, without_pile_up
    from phasemark.render.direct.fit_sensor import DirectFit, fit_direct_sensor, score_zone_orders
    from phasemark.render.direct.footprints import footprint_grid
    from phasemark.render.direct.recordings import (
        ObjectRecording,
        PlaneRecording,
        label_object,
        support_height,
        world2cam,
    )
    from phasemark.render.direct.targets import Status, Targets, find_targets
    from phasemark.render.direct.transients import range_axis, zone_transients
    from phasemark.render.integral.scene_samples import SceneMesh, plane_samples
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

__all__ = [
    "DirectFit",
    "HistogramFrames",
    "HistogramImages",
    "HistogramRenderer",
    "ObjectRecording",
    "PlaneRecording",
    "SceneMesh",
    "Status",
    "Targets",
    "capture_histograms",
    "detected_counts",
    "expected_counts",
    "find_targets",
    "fit_direct_sensor",
    "footprint_grid",
    "label_object",
    "nearest_ranges",
    "piled_up",
    "plane_samples",
    "range_axis",
    "reference_centroid",
    "score_zone_orders",
    "support_height",
    "without_pile_up",
    "world2cam",
    "zone_transients",
]


def _figure_of_histograms(frames: HistogramFrames, index: int, frame: int) -> "matplotlib.figure.Figure":
    """Draw histograms of one frame and the range of the nearest target."""
    from phasemark.render.direct.figures import histogram_figure

    return histogram_figure(frames, index, frame)


def _figure_of_expected_histograms(images: HistogramImages, index: int) -> "matplotlib.figure.Figure":
    """Draw the expected histograms of one view."""
    from phasemark.render.direct.figures import expected_figure

    return expected_figure(images, index)


HistogramFrames.figure = staticmethod(_figure_of_histograms)
HistogramImages.figure = staticmethod(_figure_of_expected_histograms)
