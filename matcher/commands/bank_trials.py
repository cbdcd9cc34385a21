"""Commands of ``phasemark bank`` that match: what the spacing of a grid costs, and which other parts are accepted."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from phasemark.data.commands.command import Shown
from phasemark.data.commands.console import LongWork, echo_facts, echo_json, echo_table
from phasemark.data.commands.inputs import open_any_bank
from phasemark.data.commands.options import Count, Json, Sample, Seed, Workers


def bank_verify(
    bank: Path, *, population: Count | None = None, sample: Sample = 16, seed: Seed = 0, as_json: Json = False
) -> None:
    """Check a bank: checksum, schema, values, random images rendered again; and what its grid's spacing costs.

    Parameters
    ----------
    bank
        A bank, its checksum beside it.
    population
        Number of random views to match against the bank.
    """
    from phasemark.data.verify import verify_bank

    with LongWork("verifying"):
        report = verify_bank(bank, sample=sample, seed=seed)
    if population is not None:
        from phasemark.matcher.accuracy.grid_spacing import grid_loss

        with open_any_bank(bank) as opened, LongWork("matching random views"):
            loss = grid_loss(opened, population, seed=seed).as_dict()
        report |= {key: float(f"{value:.3g}") if isinstance(value, float) else value for key, value in loss.items()}
    echo_facts(report, as_json=as_json)


def bank_strangers(
    bank: Path,
    *,
    population: Count = 20,
    n_frames: Annotated[Count, Shown("--frames")] = 50,
    seed: Seed = 0,
    workers: Workers = None,
    as_json: Json = False,
) -> None:
    """Match frames of the bank's landmarks at other sizes or with a piece cut off, and count which are accepted.

    The sensor cannot distinguish a part that is accepted in every second frame from the landmark: keep that part away
    from where the robot looks.

    Parameters
    ----------
    bank
        A bank.
    population
        Frames of each part.
    n_frames
        Exposures averaged in each frame.
    """
    from phasemark.matcher import Matcher
    from phasemark.matcher.accuracy.strangers import stranger_rates

    with open_any_bank(bank) as opened, LongWork("matching strangers"):
        on: Literal["ranges", "reported"] = "ranges" if opened.sensor.histogram is None else "reported"
        matcher = Matcher(opened, "refine", on=on, workers=workers)
        rates = stranger_rates(matcher, population, n_frames=n_frames, seed=seed)
    if as_json:
        return echo_json([rate.as_dict() for rate in rates])
    rows = [
        (rate.class_name, rate.change, f"{rate.accepted} of {rate.frames}",
         f"{100 * rate.share.value:.0f} % ({100 * rate.share.low:.0f} … {100 * rate.share.high:.0f} %)")
        for rate in rates
    ]  # fmt: skip
    echo_table(("made from", "change", "accepted", "share, 95 %"), rows)
