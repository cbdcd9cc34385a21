"""Parts that are in no bank, made from its landmarks: what they are, and how many of their frames are accepted."""

import json

import numpy as np
import pytest
import trimesh

from phasemark import UsageError
from phasemark.cli import main
from phasemark.data import BankPlan, build_bank, open_bank
from phasemark.matcher import Matcher
from phasemark.matcher.accuracy.strangers import CUTS, SCALES, changed_parts, stranger_rates


@pytest.fixture(scope="module")
def bank_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("strangers") / "bank.h5"
    plan = BankPlan(classes=("cylinder",), distance_m="0.7:1.1:0.02", delta_deg="0:180:2", layout="full")
    build_bank(plan, path).close()
    return path


def test_copies_have_the_volume_of_their_size_and_of_what_is_left():
    box = trimesh.creation.box((0.4, 0.2, 0.6))
    parts = dict(changed_parts(box))
    assert len(parts) == len(SCALES) + 2 * len(CUTS)
    for scale in SCALES:
        assert parts[f"size {scale:g}"].volume == pytest.approx(scale**3 * box.volume)
    for cut in CUTS:
        for where, axis in (("top", 2), ("side", 0)):
            part = parts[f"{where} cut by {cut:g}"]
            assert part.is_volume
            assert part.volume == pytest.approx((1 - cut) * box.volume)
            assert part.extents[axis] == pytest.approx((1 - cut) * box.extents[axis])
            assert part.bounds[0] == pytest.approx(box.bounds[0])
    sheet = trimesh.Trimesh(box.vertices, box.faces[2:], process=False)  # open: not cut
    assert [name for name, _ in changed_parts(sheet)] == [f"size {scale:g}" for scale in SCALES]


def test_what_differs_more_is_accepted_less(bank_file, monkeypatch):
    with open_bank(bank_file) as bank:
        monkeypatch.setattr("phasemark.matcher.accuracy.strangers.CUTS", CUTS[:1])  # half of the parts
        matcher = Matcher(bank, "refine", free=("distance_m", "delta_rad"))
        rates = {rate.change: rate for rate in stranger_rates(matcher, 5, n_frames=10)}
        for n, message in ((0, "must be at least 1, got 0"), (10**18, "made in memory: at most 39062 together")):
            with pytest.raises(UsageError, match=message):
                stranger_rates(matcher, n)
    assert {rate.frames for rate in rates.values()} == {5}
    assert rates["size 0.8"].accepted + rates["size 1.25"].accepted <= 1
    assert rates["size 0.95"].accepted > rates["size 0.8"].accepted
    for rate in rates.values():
        assert rate.share.low <= rate.accepted / 5 <= rate.share.high


def test_the_command_prints_each_part(bank_file, capsys, monkeypatch):
    monkeypatch.setattr("phasemark.matcher.accuracy.strangers.SCALES", SCALES[:1])  # each part is matched twice
    monkeypatch.setattr("phasemark.matcher.accuracy.strangers.CUTS", CUTS[:1])
    command = ["bank", "strangers", str(bank_file), "--population", "1", "--frames", "4"]
    assert main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["made", "from", "change", "accepted", "share,", "95", "%"]
    assert len(lines) == 1 + 1 + 2
    assert main([*command, "--json"]) == 0
    rates = json.loads(capsys.readouterr().out)
    assert [f"{rate['accepted']} of 1" in line for rate, line in zip(rates, lines[1:], strict=True)] == [True] * len(
        rates
    )
    assert rates[0]["change"] == f"size {SCALES[0]:g}"
    assert all(rate["share"] == rate["accepted"] and rate["frames"] == 1 for rate in rates)
    assert np.isfinite([rate["share_high"] for rate in rates]).all()
