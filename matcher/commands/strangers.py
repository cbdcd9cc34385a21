"""The command ``phasemark bank strangers``: which parts that are not in a bank a match accepts all the same."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from phasemark.data.commands.command import Shown
from phasemark.data.commands.console import LongWork, echo_json, echo_table
from phasemark.data.commands.inputs import open_any_bank
from phasemark.data.commands.options import Count, Json, Seed, Workers


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
        echo_json([rate.as_dict() for rate in rates])
        return
    rows = [
        (rate.class_name, rate.change, f"{rate.accepted} of {rate.frames}",
         f"{100 * rate.share.value:.0f} % ({100 * rate.share.low:.0f} … {100 * rate.share.high:.0f} %)")
        for rate in rates
    ]  # fmt: skip
    echo_table(("made from", "change", "accepted", "share, 95 %"), rows)
