"""The data sheet of a sensor as files: a report, its pictures, and its numbers for machines."""

from __future__ import annotations

from pathlib import Path

from phasemark.data.files.atomic_write import write_files
from phasemark.data.files.csv_cell import csv_text
from phasemark.data.files.json_text import json_text
from phasemark.data.files.provenance import versions
from phasemark.data.pages.page import embedded_png, figure_png, page_template
from phasemark.render.bench.data_sheet.bench import ALBEDOS
from phasemark.render.bench.data_sheet.results import FIGURES, Z95, Characterisation, SheetQuantity
from phasemark.render.integral.rounding import value_and_error
from phasemark.render.sensor.range_noise import predicted_range_std

REPORT = "report.html"
NAMES = (REPORT, "characterisation.json", "points.csv", *(f"{name}.png" for name in FIGURES))
"""What :func:`write_characterisation` may write; a sensor that lacks a figure lacks its picture."""

_CAPTIONS = {
    "photon_transfer": "Variance of the taps over time against their mean, steady light of rising strength. The slope"
    " is the gain, the floor is read noise and quantisation, and where taps saturate the variance collapses.",
    "range_noise": "Standard deviation of the range in one frame, of surfaces that face the camera. The curve is the"
    " noise law of this very camera, its patterns and the exact density of the phase included; dotted, the law alone.",
    "linearity": "Error of the mean range along a delay line that keeps the light constant. The curve is worked out"
    " from the correlation curve, sampled in time; beyond c / 2f the range wraps and the errors repeat.",
    "fixed_pattern": "What stays from frame to frame: each pixel's range offset, its sensitivity, its dark signal.",
    "saturation": "Share of frames in which a pixel is flagged, against the signal.",
    "threshold": "Share of frames in which a pixel shows no return, against distance.",
}

_DIRECT_CAPTIONS = {
    "range_noise": "Standard deviation of the range in one frame, of a surface that faces the camera, beside the one"
    " figure that the sensor states.",
    "linearity": "Error of the mean range against distance, beside the sensor's global offset.",
    "threshold": "Share of frames in which a pixel drops out, against distance.",
    "histogram": "Mean counts of the zones in the middle and in the corner before a plane of albedo 0.8, beside a"
    " quadrature of the zone, the response, ambient light and pile-up.",
    "merging": "Share of frames in which the chip reports two targets of equal light, against their separation. The"
    " prediction is two standard deviations of response and bin, or the least separation that the chip keeps.",
    "ambient": "Distance at which half of the frames find a surface, against ambient light. The prediction is that of"
    " Poisson counts above the threshold over their median.",
}


def write_characterisation(
    found: Characterisation, name: str, folder: Path, *, seed: int, bound: str | None = None, force: bool = False
) -> list[Path]:
    """Write ``report.html``, ``characterisation.json``, ``points.csv``, and a PNG for each figure.

    The files hold no time: the same sensor and seed make the same bytes.

    Parameters
    ----------
    found : Characterisation
        Result of :func:`phasemark.render.characterise`.
    name : str
        What the sensor is called: preset or file.
    folder : Path
        It exists.
    seed : int
        What the noise was drawn from, for the report.
    bound : str, optional
        Best accuracy of a match with this sensor in one line, for the report.
    force : bool
        Whether files may be replaced.

    Returns
    -------
    list of Path
        The files, the report first.

    Raises
    ------
    OutputExistsError, StorageError
        As in :func:`phasemark.data.files.write_atomically`.
    """
    from phasemark.render.bench.figures import characterisation_figures

    pictures = {title: figure_png(figure) for title, figure in characterisation_figures(found).items()}
    facts = {"name": name, "seed": seed, "versions": versions(), **found.as_dict()}
    files = {
        REPORT: _report(found, name, seed, pictures, bound).encode(),
        "characterisation.json": (json_text(facts, indent=1, allow_nan=False) + "\n").encode(),
        "points.csv": _points_csv(found).encode(),
        **{f"{title}.png": png for title, png in pictures.items()},
    }
    return write_files(folder, files, force=force)


def summary_sentences(found: Characterisation, name: str) -> list[str]:
    """Summarise a data sheet in three sentences: noise, systematic errors, and agreement with the prediction.

    Parameters
    ----------
    found : Characterisation
        Result of :func:`phasemark.render.characterise`.
    name : str
        What the sensor is called.

    Returns
    -------
    list of str
    """
    return [_noise_sentence(found, name), _systematic_sentence(found), _agreement_sentence(found)]


def _noise_sentence(found: Characterisation, name: str) -> str:
    sensor, where, albedo = found.sensor, found.reference_range_m, ALBEDOS[-1]
    std = float(predicted_range_std(albedo / where**2, albedo / where**2, sensor))
    noise = f"{name} measures a surface of albedo {albedo:g} at {where:g} m with {_length(std)} of noise in one frame"
    ends = []
    if begin := found.quantity("saturation_flags_begin_e"):
        ends.append(f"saturates from {begin.simulated:.0f} electrons of signal on (predicted {begin.predicted:.0f})")
    if lost := found.quantity(f"threshold_distance_albedo_{albedo:g}_m"):
        ends.append(f"loses it at {lost.simulated:.2f} m (predicted {lost.predicted:.2f} m)")
    return f"{noise}{''.join(f', {end}' for end in ends)}."


def _systematic_sentence(found: Characterisation) -> str:
    parts = []
    if wiggling := found.quantity("wiggling_peak_to_peak_m"):
        if wiggling.predicted < 1e-9:
            parts.append("its mean range does not depend on the distance in any systematic way")
        else:
            parts.append(
                f"its mean range wiggles by {_length(wiggling.simulated)} from peak to peak over the unambiguous range "
                f"(predicted {_length(wiggling.predicted)})"
            )
    pattern = found.quantity("fixed_pattern_range_std_m")
    if pattern is not None and pattern.predicted > 1e-9:
        parts.append(
            f"its pixels differ by {_length(pattern.simulated)} (standard deviation, predicted "
            f"{_length(pattern.predicted)})"
        )
    elif pattern is not None:
        parts.append("its pixels are all alike")
    dead, hot = (int(found.defects[kind].sum()) for kind in ("dead", "hot"))
    parts.append(f"{dead} of its pixels {'is' if dead == 1 else 'are'} dead and {hot} hot")
    text = ", ".join(parts[:-1]) + (", and " if len(parts) > 1 else "") + parts[-1]
    return f"{text[0].upper()}{text[1:]}."


def _agreement_sentence(found: Characterisation) -> str:
    degrees = found.degrees_of_freedom
    if not degrees:
        return "It has no noise, so there is no χ² to judge the prediction by."
    statistics = f"χ² = {found.chi2:.0f} over {degrees} points, p = {found.p_value:.2g}"
    if not found.disagreements:
        return f"The simulation agrees with the prediction: {statistics}."
    where = "; ".join(f"{one.figure.replace('_', ' ')} ({one.label})" for one in found.disagreements)
    return f"The simulation does NOT agree with the prediction in {where}: {statistics}."


def _report(found: Characterisation, name: str, seed: int, pictures: dict[str, bytes], bound: str | None) -> str:
    sensor = found.sensor
    captions = _CAPTIONS if sensor.kind == "phase" else _DIRECT_CAPTIONS
    return page_template("phasemark.data.pages", "characterisation.html.j2").render(
        name=name,
        summary=summary_sentences(found, name),
        bound=bound,
        notes=found.notes,
        contents=[
            *(["Data sheet"] if found.quantities else []),
            *(title.replace("_", " ").capitalize() for title in pictures),
            "How it was made",
            "Make this page again",
        ],
        quantities=[_quantity_row(one) for one in found.quantities],
        figures=[
            {
                "title": title.replace("_", " ").capitalize(),
                "caption": captions[title],
                "picture": embedded_png(png, captions[title]),
                "tests": [one for one in found.of_figure(title) if one.degrees_of_freedom],
            }
            for title, png in pictures.items()
        ],
        facts={
            "sensor": f"{name}: {sensor.rows} × {sensor.cols} pixels, {2 * sensor.half_angle_v_deg:g}° × "
            f"{2 * sensor.half_angle_h_deg:g}°, kind {sensor.kind}",
            "frames": f"{found.n_frames} at each point",
            "seed": str(seed),
            "versions": ", ".join(f"{package} {version}" for package, version in versions().items()),
        },
        fields=[
            (field, value)
            for field, value in sensor.model_dump(mode="json").items()
            if value != type(sensor).model_fields[field].default
            and not (field == "modulation_hz" and sensor.kind == "direct")
        ],
        command=f"phasemark sensor characterise {name} --seed {seed} --frames {found.n_frames} -o DIR",
    )


def _quantity_row(one: SheetQuantity) -> dict[str, str]:
    simulated, half = value_and_error(one.simulated, Z95 * one.std_error)
    return {
        "title": one.title,
        "predicted": value_and_error(one.predicted, Z95 * one.std_error)[0],
        "simulated": simulated,
        "half": half or "0",
        "samples": f"{one.samples:,}".replace(",", " "),
    }


def _points_csv(found: Characterisation) -> str:
    header = (
        "figure", "label", "x_name", "x", "y_name", "predicted", "simulated", "low95", "high95", "samples", "compared"
    )  # fmt: skip
    points = [
        {**one, **point, "compared": int(point["compared"])}
        for one in found.as_dict()["comparisons"]
        for point in one["points"]
    ]
    return csv_text([header, *([point.get(name) for name in header] for point in points)])


def _length(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm" if abs(metres) < 0.1 else f"{metres:.3g} m"
