"""Readings of a time-of-flight sensor as an observation of a MuJoCo environment of Gymnasium."""

from __future__ import annotations

import secrets
from typing import Any, SupportsFloat

import numpy as np

from phasemark import UsageError
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.simulators import NEEDS_GYMNASIUM
from phasemark.render.simulators.mujoco import TofReading, TofSensor

try:
    import gymnasium
except ImportError:
    raise UsageError(NEEDS_GYMNASIUM) from None

__all__ = ["TofObservation"]


class TofObservation(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Wrapper that adds the distances of a time-of-flight sensor to the observation of an environment.

    The observation is a dictionary: what the environment observes under "observation", or under its own keys if it is a
    dictionary already, and under `key` the distance that each zone reports, metres, float32 (rows, cols); a zone
    without a valid target has the largest distance of the space. ``reading`` is all that the sensor reported last.

    Parameters
    ----------
    env : gymnasium.Env
        With ``model`` and ``data`` of MuJoCo, as :class:`gymnasium.envs.mujoco.MujocoEnv` has them.
    sensor : str or Sensor
        Name of a preset, or a sensor.
    key : str
    replace : bool
        Whether the distances alone are the observation.
    **options
        Further parameters of :class:`~phasemark.render.simulators.mujoco.TofSensor`: ``site="tof"`` for instance.

    Raises
    ------
    UsageError
        The environment has no MuJoCo model, observes something under `key` already, or whatever `TofSensor` refuses.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        sensor: str | Sensor = "vl53l8cx-8x8",
        *,
        key: str = "tof",
        replace: bool = False,
        **options: Any,
    ) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self, sensor=sensor, key=key, replace=replace, **options)
        super().__init__(env)
        model = getattr(env.unwrapped, "model", None)
        if model is None or not hasattr(env.unwrapped, "data"):
            raise UsageError(f"{env.unwrapped} has no 'model' and 'data' of MuJoCo")
        self.tof = TofSensor(model, sensor=sensor, **options)
        self._has_seed = "seed" in options
        self.reading: TofReading | None = None
        """The last reading of the sensor."""
        self._key, self._replace = key, replace
        shape = self.tof.sensor.rows, self.tof.sensor.cols
        distances = gymnasium.spaces.Box(0.0, farthest_m(self.tof.sensor), shape, np.float32)
        inner = env.observation_space
        self._of_dictionary = isinstance(inner, gymnasium.spaces.Dict)
        if replace:
            self.observation_space = distances
            return
        if isinstance(inner, gymnasium.spaces.Dict):
            if key in inner.spaces:
                raise UsageError(f"the environment observes something under '{key}' already: give another key=…")
            self.observation_space = gymnasium.spaces.Dict({**inner.spaces, key: distances})
        else:
            self.observation_space = gymnasium.spaces.Dict({"observation": inner, key: distances})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and the sensor; a seed is that of the sensor's noise too.

        Without any seed the noise is that of no other environment.
        """
        observation, info = self.env.reset(seed=seed, options=options)
        of_noise = seed if seed is not None or self._has_seed else secrets.randbits(63)
        self._has_seed = True
        self.tof.reset(of_noise)
        return self._observed(observation), info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the environment, and read the sensor."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._observed(observation), reward, terminated, truncated, info

    def _observed(self, observation: Any) -> Any:
        """Read the sensor, and return the observation with its distances."""
        unwrapped: Any = self.env.unwrapped
        self.reading = self.tof.read(unwrapped.data)
        farthest = farthest_m(self.tof.sensor)
        valid = (self.reading.status == 0) & np.isfinite(self.reading.distance_m)
        distances = np.clip(np.where(valid, self.reading.distance_m, farthest), 0.0, farthest).astype(np.float32)
        if self._replace:
            return distances
        return {**(observation if self._of_dictionary else {"observation": observation}), self._key: distances}


def farthest_m(sensor: Sensor) -> float:
    """Return the largest distance that a sensor can report, metres."""
    if sensor.histogram is not None:
        return sensor.histogram.start_m + sensor.histogram.length_m
    return sensor.max_range_m or sensor.unambiguous_range_m
