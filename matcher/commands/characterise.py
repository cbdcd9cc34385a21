"""The command ``phasemark sensor characterise``: the data sheet of a camera, and the accuracy that it allows."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from phasemark import PhasemarkError
from phasemark.data.commands.command import Shown
from phasemark.data.commands.console import LongWork, echo, echo_json, readable
from phasemark.data.commands.inputs import class_renderers, read_sensor
from phasemark.data.commands.options import Force, Json, Out, Seed, SensorName
from phasemark.data.commands.outputs import output_folder
from phasemark.data.commands.sensor import Frequency, which_frequency

if TYPE_CHECKING:
    from phasemark.render import Sensor


def sensor_characterise(
    name_or_file: SensorName,
    *,
    out: Out,
    n_frames: Annotated[int | None, Shown("--frames", min=2)] = None,
    seed: Seed = 2005,
    frequency: Frequency = None,
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Measure a sensor before flat fields, as EMVA 1288 would, and compare it with what its numbers predict.

    Parameters
    ----------
    out
        Folder for the report, its pictures and numbers.
    n_frames
        Frames at each point; by default 51200 readings a point.
    """
    from phasemark.data.pages.characterisation import NAMES, summary_sentences, write_characterisation
    from phasemark.data.seeds import stream
    from phasemark.render import characterise

    sensor = read_sensor(name_or_file)
    sensor = sensor.by_frequency[which_frequency(sensor, frequency)]
    with output_folder(out, "sensor characterise", NAMES, force), LongWork("measuring"):
        found = characterise(sensor, rng=stream(seed, "characterise", 0), n_frames=n_frames)
        bound = _bound(sensor, found.reference_range_m)
        report = write_characterisation(found, readable(name_or_file), out, seed=seed, bound=bound, force=force)[0]
    if as_json:
        facts = found.as_dict()
        return echo_json({"report": str(report), "agreement": facts["agreement"], "quantities": facts["quantities"]})
    echo(*summary_sentences(found, name_or_file), *found.notes, report)


def _bound(sensor: Sensor, distance_m: float) -> str | None:
    """Return in one line the best accuracy of a match with a sensor, for the first class of the catalogue.

    None for a sensor without noise, or one that cannot see the landmark there.
    """
    from phasemark.landmarks import catalog
    from phasemark.matcher.accuracy.expected_accuracy import accuracy_card, sides_of
    from phasemark.render.view import delta_period_rad

    name, spec = next(iter(catalog().items()))
    try:
        others = class_renderers(sensor)
        renderer = others.pop(name)
        views = sides_of(distance_m, delta_period_rad(spec.symmetry))
        renderer.check_in_view(views)
        card = accuracy_card(renderer, views, others=others)
    except PhasemarkError:
        return None
    return f"{name} {card.line()}"
