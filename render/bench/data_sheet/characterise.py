"""Characterise a sensor as EMVA 1288 and the literature on PMD cameras would: by flat fields, beside predictions.

Every figure stands beside what closed forms predict (:mod:`~phasemark.render.bench.flat_field`), with its number of
samples and its standard error; :attr:`~phasemark.render.bench.data_sheet.results.Comparison.chi2` says whether the two
agree.
"""

from __future__ import annotations

import math

import numpy as np

from phasemark import UsageError
from phasemark.render.bench.data_sheet.bench import Bench
from phasemark.render.bench.data_sheet.direct import direct_rows
from phasemark.render.bench.data_sheet.phase import phase_rows
from phasemark.render.bench.data_sheet.results import Characterisation, Comparison, SheetQuantity
from phasemark.render.sensor.sensor import Sensor


def characterise(sensor: Sensor, *, rng: np.random.Generator, n_frames: int | None = None) -> Characterisation:
    """Run a sensor before flat fields and compare what it reports with closed forms.

    Photon transfer is measured with steady light and no ambient light; range noise on surfaces of three albedos that
    face the camera; linearity along a delay line that keeps the light constant; patterns over many frames of one flat
    field; saturation with rising light; the amplitude threshold with rising distance. The validity threshold and the
    wrap guard are off but where they are measured, so that they select no samples.

    Parameters
    ----------
    sensor : Sensor
        Of one modulation frequency; of several, each of ``sensor.by_frequency`` has a data sheet of its own.
    rng : numpy.random.Generator
        Source of all noise.
    n_frames : int, optional
        Frames at each point, at least 2; by default as many as make 51 200 readings, and at least 8.

    Returns
    -------
    Characterisation

    Raises
    ------
    UsageError
        `n_frames` is less than 2, no pixel works, or the sensor has several modulation frequencies.
    """
    sensor.refuse_several_frequencies("a data sheet")
    if n_frames is None:
        samples_per_point = 51_200  # σ is known to 0.3 %
        fewest_frames = 8
        n_frames = max(fewest_frames, math.ceil(samples_per_point / (sensor.rows * sensor.cols)))
    if n_frames < 2:
        raise UsageError(f"'n_frames' must be at least 2, for one frame has no noise, got {n_frames}")
    bench = Bench(sensor, rng, n_frames)
    rows = list(direct_rows(bench) if sensor.kind == "direct" else phase_rows(bench))
    return Characterisation(
        sensor,
        n_frames,
        bench.reference_range_m,
        tuple(row for row in rows if isinstance(row, Comparison)),
        tuple(row for row in rows if isinstance(row, SheetQuantity)),
        {name: values for row in rows if isinstance(row, dict) for name, values in row.items()},
        {"dead": bench.unit.dead, "hot": bench.unit.hot},
        tuple(row for row in rows if isinstance(row, str)),
    )
