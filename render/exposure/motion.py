"""Motion of the camera during the four phase images of a frame (PHYSICS sections 1 and 4)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from phasemark import UsageError
from phasemark.render.background import Background
from phasemark.render.phasor_images import PhasorImages
from phasemark.render.renderer import Renderer
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.view import Views


@dataclass(frozen=True)
class Motion:
    """Constant velocities of a camera that drives on the level, in its own level frame, and rates of its tilt.

    Parameters
    ----------
    forward_m_s : float
        Along the optical axis's heading; with a `bearing_offset_deg`, that of what the mount points at.
    sideways_m_s : float
        To the left.
    yaw_rate_rad_s : float
        Counter-clockwise.
    pitch_rate_rad_s, roll_rate_rad_s : float
        How fast the pitch and the roll of the view grow.

    Raises
    ------
    UsageError
        A velocity is not finite.
    """

    forward_m_s: float = 0.0
    sideways_m_s: float = 0.0
    yaw_rate_rad_s: float = 0.0
    pitch_rate_rad_s: float = 0.0
    roll_rate_rad_s: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not math.isfinite(value):
                raise UsageError(f"'{name}' must be finite, got {value!r}")

    def views_after(self, views: Views, time_s: float) -> Views:
        """Return the views a time later (earlier, if negative).

        In the camera's level frame of time 0 the lens then stands at p = ∫ Rz(ωt') (forward, sideways) dt', an arc, and
        the axis at D (cos b, sin b). So (D', b') are the polar coordinates of Rz(−ωt) (D (cos b, sin b) − p); and the
        heading δ − b of the optical axis in the landmark frame grows by ωt (PHYSICS section 1).

        Raises
        ------
        UsageError
            The lens would stand on the landmark's axis.
        """
        turn = self.yaw_rate_rad_s * time_s
        along = time_s * np.sinc(turn / math.pi)  # ∫ cos ωt'
        across = time_s * math.sin(turn / 2) * np.sinc(turn / (2 * math.pi))  # ∫ sin ωt'
        x = views.distance_m * np.cos(views.bearing_rad) - (self.forward_m_s * along - self.sideways_m_s * across)
        y = views.distance_m * np.sin(views.bearing_rad) - (self.forward_m_s * across + self.sideways_m_s * along)
        bearing = np.arctan2(y, x) - turn
        return Views.broadcast(
            np.hypot(x, y),
            views.delta_rad - views.bearing_rad + bearing + turn,
            bearing,
            views.height_m,
            views.pitch_rad + self.pitch_rate_rad_s * time_s,
            views.roll_rad + self.roll_rate_rad_s * time_s,
        )


def phase_image_times_s(sensor: Sensor) -> tuple[float, ...]:
    """Return when the phase images are taken, seconds from mid-frame: (i − 1.5)·T, i = 0 … 3 at one frequency.

    Of m frequencies the 4 m phase images follow one another at the same T, four for each frequency in their order, and
    mid-frame is the middle of them all.
    """
    middle = (sensor.n_phase_images - 1) / 2
    return tuple((i - middle) * sensor.phase_image_interval_s for i in range(sensor.n_phase_images))


def render_moving(
    renderer: Renderer,
    views: Views,
    motion: Motion,
    *,
    background: Background | None = None,
    workers: int = 1,
) -> tuple[PhasorImages, ...]:
    """Render what a moving camera sees during each of the phase images of a frame, four for each frequency.

    Parameters
    ----------
    renderer : Renderer
        Its sensor times the phase images.
    views : Views
        The views at mid-frame: the truth that the frame is labelled with.
    motion : Motion
        Movement of the camera during a frame.
    background : Background, optional
        Given as seen at mid-frame. A wall stands square to each view's own line of sight (PHYSICS section 3), so the
        motion must keep that line: turning on the spot, or driving along it.
    workers : int
        Number of threads.

    Returns
    -------
    tuple of PhasorImages
        One for each phase image. For :func:`~phasemark.render.capture`; n views each.

    Raises
    ------
    UsageError
        The motion leads into the landmark, or past a wall.
    """
    images = []
    for time_s in phase_image_times_s(renderer.sensor):
        moved = motion.views_after(views, time_s)
        behind = None if background is None else _after_motion(background, views, moved, motion, time_s)
        images.append(renderer.render_views(moved, background=behind, workers=workers))
    return tuple(images)


def _after_motion(background: Background, views: Views, moved: Views, motion: Motion, time_s: float) -> Background:
    """Return the background as the moved camera sees it."""
    if background.wall_m is None or not len(views):
        return background
    swing = moved.bearing_rad + motion.yaw_rate_rad_s * time_s - views.bearing_rad
    nearer = views.distance_m - moved.distance_m
    same_line_rad = 1e-9  # rounding of an angle, or of metres
    if np.abs(np.sin(swing)).max() > same_line_rad or np.ptp(nearer) > same_line_rad:
        raise UsageError(
            "'wall_m' cannot be rendered for this motion: a wall stands square to the line of sight, which must not "
            "swing; add the wall to the mesh instead"
        )
    return replace(background, wall_m=background.wall_m - float(nearer[0]))
