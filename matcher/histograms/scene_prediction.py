"""Expected counts of a direct sensor for an object at an assumed pose, and their derivatives by the pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from phasemark import UsageError
from phasemark.render.direct.bin_counts import piled_up
from phasemark.render.direct.fit_model import undo_pile_up
from phasemark.render.direct.footprints import footprint_grid, histogram_of
from phasemark.render.direct.histogram_frames import HistogramFrames
from phasemark.render.direct.recordings import object_centre, world2cam
from phasemark.render.direct.sample_counts import signal_of_samples
from phasemark.render.integral.scene_samples import SceneMesh
from phasemark.render.rigid import rigid_transforms
from phasemark.render.sensor.sensor import Sensor

POSE_PARAMETERS = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")
"""Displacement of the object in the world frame, and rotation vector about its centre, world axes."""

_STEPS = {"x_m": 5e-4, "y_m": 5e-4, "z_m": 5e-4, "roll_rad": 2e-3, "pitch_rad": 2e-3, "yaw_rad": 2e-3, "support": 0.05}
_AMBIENT_BINS = slice(2, 9)


class Linearised(NamedTuple):
    """Histograms of n poses about a supposed object pose; arrays are (n, zones, bins[, parameters]).

    Parameters
    ----------
    expected : (n, zones, bins) float64
        Counts, brightness and ambient light of every histogram taken from the histogram itself.
    slope : (n, zones, bins, p) float64
        ∂expected/∂parameter at fixed brightness.
    brightness : (n, zones, bins) float64
        ∂expected/∂ln brightness.
    free : tuple of str
        The parameters.
    direction : (n, 3) float64
        From the object's centre to the sensor, unit vectors.
    lever : (n, 6, 6) float64
        By how much the object seems displaced where the sensor stands or looks otherwise than its pose says: in the
        order of `POSE_PARAMETERS`, by metres along the axes of the optical frame and radians about them.
    """

    expected: NDArray[np.float64]
    slope: NDArray[np.float64]
    brightness: NDArray[np.float64]
    free: tuple[str, ...]
    direction: NDArray[np.float64]
    lever: NDArray[np.float64]


class ObjectScene:
    """A known object on its support, seen by one direct sensor from several poses.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Object and support in the world frame, where they are supposed to be; the face attribute "part" is 1 on the
        object, 0 on the support.
    sensor : Sensor
        With a table ``[histogram]``.
    centre_m : (3,) array_like
        Point of the mesh about which it is turned; None: the middle of the object's faces.
    """

    def __init__(self, mesh: trimesh.Trimesh, sensor: Sensor, centre_m: ArrayLike | None = None) -> None:
        self.sensor, self.histogram = sensor, histogram_of(sensor)
        self._scene = SceneMesh(mesh)
        self._grid = footprint_grid(sensor)
        if centre_m is None:
            centre_m = object_centre(mesh)
        self.centre_m = np.asarray(centre_m, dtype=np.float64)

    def moved(self, displacement: ArrayLike) -> NDArray[np.float64]:
        """Return the rigid transform of the world that displaces the object, (4, 4).

        Parameters
        ----------
        displacement : (6,) array_like
            In the order of `POSE_PARAMETERS`.
        """
        move = np.asarray(displacement, dtype=np.float64)
        out = np.eye(4)
        out[:3, :3] = Rotation.from_rotvec(move[3:]).as_matrix()
        out[:3, 3] = self.centre_m + move[:3] - out[:3, :3] @ self.centre_m
        return out

    def signal(self, sensor2world: NDArray[np.float64], displacement: ArrayLike, support: float) -> NDArray[np.float64]:
        """Return expected signal counts for albedo 1 of the object and `support` of the support, (n, zones, bins)."""
        landmark2cam = world2cam(sensor2world) @ self.moved(displacement)
        return signal_of_samples(self._scene.samples(landmark2cam, self._grid), self.sensor, (support, 1.0))

    def linearise(
        self,
        frames: HistogramFrames,
        sensor2world: ArrayLike,
        displacement: ArrayLike,
        support: float,
        free: Sequence[str],
    ) -> Linearised:
        """Return expected counts and their slopes about a supposed pose.

        Parameters
        ----------
        frames : HistogramFrames
            n positions; each histogram gives its own brightness and ambient light.
        sensor2world : (n, 4, 4) array_like
            Poses of the optical frame.
        displacement : (6,) array_like
            In the order of `POSE_PARAMETERS`.
        support : float
            Albedo of the support over that of the object.
        free : sequence of str
            Of `POSE_PARAMETERS`, and "support".
        """
        poses = rigid_transforms(sensor2world)
        if len(poses) != len(frames):
            raise UsageError(f"'sensor2world' must name {len(frames)} poses, got {len(poses)}")
        unknown = [name for name in free if name not in _STEPS]
        if unknown:
            raise UsageError(f"'free' must name of {', '.join(_STEPS)}, got '{unknown[0]}'")
        move = np.asarray(displacement, dtype=np.float64)
        measured = frames.zone_counts
        n_frames = frames.counts.shape[1]
        cycles = self.histogram.cycles * n_frames if self.histogram.pile_up else np.inf

        def shape(values: NDArray[np.float64], ratio: float) -> NDArray[np.float64]:
            return shifted(self.signal(poses, values, ratio), frames.drift_bins)

        here = shape(move, support)
        counts = undo_pile_up(measured, cycles) if np.isfinite(cycles) else measured
        ambient = counts[..., _AMBIENT_BINS].mean(axis=-1, keepdims=True)
        signal = np.maximum((counts - ambient).sum(axis=-1), 0.0)
        bright = (signal / np.maximum(here.sum(axis=-1), 1e-300))[..., None]

        def piled(light: NDArray[np.float64]) -> NDArray[np.float64]:
            total = np.maximum(light + ambient, 1e-3)
            return piled_up(total, cycles) if np.isfinite(cycles) else total

        slopes = []
        for name in free:
            step = _STEPS[name] * (support if name == "support" else 1.0)
            sides = [piled(bright * shape(*displaced(move, support, {name: by}))) for by in (step, -step)]
            slopes.append((sides[0] - sides[1]) / (2 * step))
        expected = piled(bright * here)
        brighter = (piled(bright * here * 1.001) - expected) / 0.001
        slope = np.stack(slopes, axis=-1) if slopes else np.zeros((*expected.shape, 0))
        to_centre = self.centre_m + move[:3] - poses[:, :3, 3]
        direction = -to_centre / np.linalg.norm(to_centre, axis=1, keepdims=True)
        return Linearised(expected, slope, brighter, tuple(free), direction, _lever(poses[:, :3, :3], to_centre))


def _lever(axes: NDArray[np.float64], to_centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far an object seems displaced by errors of the sensor's place and turn, (n, 6, 6)."""
    out = np.zeros((len(axes), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = -axes
    out[:, :3, 3:] = np.cross(to_centre[:, None], axes.transpose(0, 2, 1)).transpose(0, 2, 1)
    return out


def displaced(
    displacement: NDArray[np.float64], support: float, step: Mapping[str, float]
) -> tuple[NDArray[np.float64], float]:
    """Return displacement and albedo of the support after a step, by parameter."""
    moves = np.array([step.get(name, 0.0) for name in POSE_PARAMETERS])
    return displacement + moves, support + step.get("support", 0.0)


def shifted(counts: NDArray[np.float64], bins: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return histograms shifted to later bins by a fraction of a bin each, (n, zones, bins): in the Fourier domain."""
    if not bins.any():
        return counts
    n = counts.shape[-1]
    wave = np.exp(-2j * np.pi * np.arange(n // 2 + 1) / n * bins[:, None])
    return np.asarray(np.fft.irfft(np.fft.rfft(counts, axis=-1) * wave[:, None], n=n, axis=-1))
