"""The command ``phasemark bank verify``, which matches random views against the bank if it is asked to."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from pathlib import Path

from phasemark.data.commands.console import LongWork, echo_facts
from phasemark.data.commands.inputs import open_any_bank
from phasemark.data.commands.options import Count, Json, Sample, Seed


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
