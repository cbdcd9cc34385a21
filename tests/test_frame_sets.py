"""Frame sets: what is drawn, what lies in the file, the same bytes however it is built, and what verify finds."""

import hashlib
import pickle
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray
from programs.system_calls import in_fork
from scipy import stats

from phasemark import InputFileError, OutputExistsError, UsageError
from phasemark.data import BankPlan, FramePlan, build_bank, build_frames, open_frames, read_frames
from phasemark.data.files import write_checksum
from phasemark.data.partial_outputs import build_part, estimate_build, job_for, merge_parts, parse_part
from phasemark.data.plans import Distribution, planned_size
from phasemark.data.seeds import stream
from phasemark.data.verify import verify_bank, verify_frames
from phasemark.inputs import checksum_path
from phasemark.landmarks import build_mesh, catalog
from phasemark.render import Background, Renderer, capture, preset

PLAN = FramePlan(
    classes=["cone", "post"],
    views=20,
    frames_per_view=3,
    seed=7,
    distance_m={"uniform": [0.8, 1.2]},
    delta_deg={"sobol": [0, 180]},
    bearing_deg={"normal": [0, 1.5], "within": [-4, 4]},
    height_m={"sobol": [-0.02, 0.02]},
    albedo={"uniform": [0.5, 0.9]},
    wall_m={"uniform": [3, 5]},
    variants=["hard", "mixed", "shot"],
    keep_taps=True,
)


@pytest.fixture(scope="module")
def frames_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("frames") / "frames.h5"
    build_frames(PLAN, path, workers=1).close()
    return path


@pytest.fixture
def frames(frames_file):
    with open_frames(frames_file) as opened:
        yield opened


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


# --- plans -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, "'views' is missing"),
        ({"views": 0}, "'views' must be greater than or equal to 1, got 0"),
        ({"views": 1, "distance_m": {"normal": [1, 0.1]}}, "'distance_m' must be positive throughout"),
        ({"views": 1, "distance_m": {}}, "'distance_m': must be a number or have one of fixed, uniform"),
        ({"views": 1, "delta_deg": {"uniform": [0, 1], "fixed": 3}}, "'delta_deg': must be a number or have one of"),
        ({"views": 1, "delta_deg": {"uniform": [1, 0]}}, "low ≤ high"),
        ({"views": 1, "wall_m": -1}, "'wall_m' must be positive"),
        ({"views": 1, "albedo": {"uniform": [0, 1]}}, "'albedo' must be in"),
        ({"views": 1, "splits": {"train": 0.5}}, "'splits' must be shares that add up to 1"),
        ({"views": 1, "splits": {f"s{k}": 1 / 300 for k in range(300)}}, "'splits' must be at most 256, got 300"),
        ({"views": 1, "colour": "red"}, "unknown key 'colour'"),
        (
            {"views": 1, "distance_m": "near"},
            "'distance_m' must be a number or a table with .*, got 'near'",
        ),
        ({"views": 1, "splits": {"a b": 1.0}}, "each key of 'splits' must begin with a letter or digit .*, got 'a b'"),
        ({"views": 1, "delta_deg": {"gauss": [0, 1]}}, "unknown key 'gauss'"),
        ({"views": 1, "delta_deg": {"fixed": 0, "within": [0, 1]}}, "'within' cuts the tails of 'normal'"),
        ({"views": 1, "delta_deg": {"normal": [1, 0.1], "within": [50, 60]}}, "no draw of 'normal'"),
        ({"views": 1, "delta_deg": {"normal": [1, 0], "within": [1.1, 1.3]}}, "no draw of 'normal'"),
    ],
)
def test_a_plan_that_cannot_be_is_refused_by_its_key(fields, message):
    with pytest.raises(UsageError, match=message.replace("(", r"\(")):
        FramePlan(**fields)


def test_a_resolved_plan_says_everything_and_resolves_to_itself():
    resolved = PLAN.resolve()
    assert resolved.resolve() == resolved
    assert FramePlan(**resolved.model_dump(mode="json")) == resolved
    assert [part.name for part in resolved.landmarks] == ["cone", "post"]


def test_a_view_that_cannot_be_seen_is_named_before_anything_is_rendered(tmp_path):
    plan = FramePlan(classes=["cone"], views=50, distance_m={"uniform": [0.7, 1.5]}, wall_m=1.3, seed=1)
    with pytest.raises(UsageError, match=r"view \d+ of the plan cannot be rendered: the wall at 1.3 m is before"):
        build_frames(plan, tmp_path / "frames.h5")
    assert list(tmp_path.iterdir()) == []


def test_the_truth_of_a_view_depends_on_its_number_alone():
    plan = PLAN.resolve()
    whole = plan.draw_truth()
    for start, stop in ((0, 1), (3, 4), (5, 11), (19, 20)):
        for name, values in plan.draw_truth(start, stop).items():
            np.testing.assert_array_equal(values, whole[name][start:stop])


def test_values_follow_their_distributions():
    n = 20_000
    plan = FramePlan(
        views=n,
        seed=3,
        distance_m={"uniform": [1, 2]},
        delta_deg={"sobol": [0, 180]},
        bearing_deg={"normal": [0.5, 2]},
        height_m={"normal": [0, 1], "within": [-1, 2]},
        floor_m=1.0,
        splits={"a": 0.25, "b": 0.75},
    ).resolve()
    truth = plan.draw_truth()
    # Kolmogorov's distance of n independent values exceeds 2.2 / √n with probability 1.3e-4; seven are looked at
    limit = 2.2 / np.sqrt(n)
    from scipy import stats

    assert stats.kstest(truth["distance_m"], stats.uniform(1, 1).cdf).statistic < limit
    assert stats.kstest(truth["bearing_deg"], stats.norm(0.5, 2).cdf).statistic < limit
    assert stats.kstest(truth["height_m"], stats.truncnorm(-1, 2).cdf).statistic < limit
    # a Sobol sequence fills the interval far more evenly than independent draws do
    assert stats.kstest(truth["delta_deg"], stats.uniform(0, 180).cdf).statistic < 0.05 * limit
    assert np.all(truth["floor_m"] == 1)
    assert np.isnan(truth["wall_m"]).all()
    # binomial counts, 99.9 % corrected for five: 4.1 standard deviations
    assert abs((truth["split_index"] == 0).mean() - 0.25) < 4.1 * np.sqrt(0.25 * 0.75 / n)
    for k in range(4):
        assert abs((truth["class_index"] == k).mean() - 0.25) < 4.1 * np.sqrt(0.25 * 0.75 / n)


def test_each_of_256_splits_has_a_number():
    plan = FramePlan(classes=["cone"], views=300, splits={f"s{k}": 1 / 256 for k in range(256)})
    assert plan.resolve().draw_truth()["split_index"].max() > 200


def test_quantities_are_independent_of_one_another():
    truth = PLAN.model_copy(update={"views": 4000}).resolve().draw_truth()
    names = ["distance_m", "delta_deg", "bearing_deg", "height_m", "albedo", "wall_m", "class_index", "split_index"]
    correlation = np.corrcoef([truth[name] for name in names]) - np.eye(len(names))
    assert np.abs(correlation).max() < 4.3 / np.sqrt(4000)  # 99.9 % over 28 pairs


# --- bytes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{"workers": 3, "shard_items": 7}, {"workers": 8, "shard_items": 1}], ids=str)
def test_workers_and_shards_do_not_change_the_bytes(frames_file, tmp_path, options):
    build_frames(PLAN, tmp_path / "again.h5", **options).close()
    assert sha256(tmp_path / "again.h5") == sha256(frames_file)


def test_parts_built_apart_merge_to_the_bytes_of_one_run(frames_file, tmp_path):
    parts = [build_part(PLAN, (i, 3), tmp_path / f"part{i}.h5") for i in (1, 2, 3)]
    merge_parts(parts[::-1], tmp_path / "merged.h5")
    assert sha256(tmp_path / "merged.h5") == sha256(frames_file)
    with pytest.raises(InputFileError, match=r"shards are missing: no items 6 … 12 of 20"):
        merge_parts([parts[0], parts[2]], tmp_path / "other.h5")
    with pytest.raises(InputFileError, match="repeats items from 0 on"):
        merge_parts([*parts, parts[0]], tmp_path / "other.h5")
    stranger = build_part(PLAN.model_copy(update={"seed": 8}), (2, 3), tmp_path / "stranger.h5")
    with pytest.raises(InputFileError, match=r"is of another run than .*plan\.seed: 7 → 8"):
        merge_parts([parts[0], stranger, parts[2]], tmp_path / "other.h5")


def test_parts_of_a_bank_merge_too_whatever_workers_and_shards(tmp_path):
    plan = BankPlan(classes=["cone", "post"], distance_m="0.9:1.1:0.1", delta_deg="0:180:30")
    build_bank(plan, tmp_path / "whole.h5", workers=1, shard_items=7).close()
    parts = [build_part(plan, (i, 4), tmp_path / f"part{i}.h5") for i in (1, 2, 3, 4)]
    merge_parts(parts, tmp_path / "merged.h5")
    assert sha256(tmp_path / "merged.h5") == sha256(tmp_path / "whole.h5")


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "a/b", "1/", "-1/3"])
def test_a_shard_is_written_i_of_n(text):
    with pytest.raises(UsageError, match="part=… must be I/N"):
        parse_part(text)


def test_resuming_a_finished_set_changes_nothing_and_of_another_plan_is_refused(frames_file, tmp_path):
    before = sha256(frames_file)
    build_frames(PLAN, frames_file, resume=True).close()
    assert sha256(frames_file) == before
    with pytest.raises(OutputExistsError, match=r"plan\.seed: 7 → 8"):
        build_frames(PLAN.model_copy(update={"seed": 8}), frames_file, resume=True)
    for n_views in (3, 2):
        plan = PLAN.model_copy(update={"views": n_views})
        with build_frames(plan, tmp_path / "frames.h5", resume=True, force=True) as built:
            assert len(built) == n_views * PLAN.frames_per_view


@pytest.mark.parametrize(
    ("small", "large"),
    [
        (FramePlan(classes=["cone"], views=100, frames_per_view=3), {"views": 300}),
        (FramePlan(classes=["cone"], views=100), {"frames_per_view": 4}),
        (FramePlan(classes=["cone"], views=100, variants=["shot"], keep_taps=True), {"views": 300}),
        (FramePlan(classes=["cone"], views=100, sensor="vl53l5cx-8x8", variants=["mixed"]), {"views": 300}),
        (BankPlan(classes=["cone"], distance_m=[1, 2], delta_deg=[0, 10], layout="full", harmonics=[3, 5]),
         {"distance_m": "1:2:0.02"}),
        (BankPlan(classes=["cone", "cylinder"], distance_m=[1, 2], delta_deg="0:170:5"), {"distance_m": "1:2:0.02"}),
    ],
)  # fmt: skip
def test_a_larger_plan_makes_the_file_larger_by_what_the_arithmetic_says(small, large):
    large = type(small)(**{**small.model_dump(), **large})
    files = [job_for(plan).lay_out()[0].size for plan in (small, large)]
    planned = [planned_size(plan)["bytes"] for plan in (small, large)]
    # coordinates and the text of the plan are not counted
    assert files[1] - files[0] == pytest.approx(planned[1] - planned[0], abs=4096)
    assert 0 < files[0] - planned[0] < 1_000_000  # the meshes


@pytest.mark.parametrize("trial_seconds", [None, 0.0])
def test_a_dry_run_knows_the_size_and_estimates_the_time(frames_file, trial_seconds):
    facts = estimate_build(PLAN, trial_seconds=trial_seconds)
    assert facts["bytes"] == frames_file.stat().st_size
    assert (facts["views"], facts["frames"]) == (20, 60)
    assert 0 < facts["seconds"] < 600


# --- content ---------------------------------------------------------------------------------------------------------


def test_the_file_holds_what_renderer_and_sensor_make_of_each_view(frames):
    sensor = preset("pmd-16x16")
    truth = frames.truth
    for view in (0, 7, 19):
        name = frames.classes[truth["class_index"][view]]
        renderer = Renderer(build_mesh(catalog()[name]), sensor, albedo=truth["albedo"][view])
        where = [truth[key][view] for key in ("distance_m", "delta_rad", "bearing_rad", "height_m")]
        background = Background(wall_m=truth["wall_m"][view])
        image = renderer.render(*where, background=background)
        hard = renderer.render(*where, background=background, variant="hard")
        expected = capture(image, sensor, rng=stream(7, "frames.noise", 0), n_frames=3, first_view=view, keep_taps=True)
        sample = frames[3 * view : 3 * view + 3]
        assert sample["class_name"].tolist() == [name] * 3
        assert sample["view"].tolist() == [view] * 3
        for key, values in (
            ("range_m", expected.range_m[0]),
            ("amplitude_e", expected.amplitude_e[0]),
            ("intensity_e", expected.intensity_e[0]),
            ("flags", expected.flags[0]),
            ("taps_e", expected.taps_e[0]),
            ("range_hard_m", np.repeat(hard.range_m, 3, axis=0)),
            ("range_mixed_m", np.repeat(image.range_m, 3, axis=0)),
            ("coverage", np.repeat(image.coverage, 3, axis=0)),
        ):
            np.testing.assert_array_equal(sample[key], values.astype(sample[key].dtype), err_msg=key)


def test_frames_come_by_number_slice_and_list(frames):
    assert len(frames) == 60
    one, some, picked = frames[17], frames[10:20], frames[[17, 3, 17]]
    assert one["range_m"].shape == (16, 16)
    assert isinstance(one["distance_m"], float)
    assert isinstance(one["class_name"], str)
    np.testing.assert_array_equal(one["range_m"], some["range_m"][7])
    np.testing.assert_array_equal(picked["range_m"][[0, 2]], [one["range_m"]] * 2)
    assert frames[-1]["view"] == 19
    assert frames[5:5]["range_m"].shape == (0, 16, 16)
    with pytest.raises(IndexError):
        frames[60]
    assert frames.frames([17]).range_m.shape == (1, 1, 16, 16)
    assert frames.view(5).range_m.shape == (1, 3, 16, 16)


def test_splits_share_the_views_and_no_view_is_in_two(frames):
    numbers = [frames.split(name) for name in frames.splits]
    assert sorted(np.concatenate(numbers)) == list(range(60))
    views = [set(frames.view_index[part]) for part in numbers]
    assert sum(map(len, views)) == 20
    with pytest.raises(UsageError, match="unknown split 'night'"):
        frames.split("night")


def distance_of(sample):
    return sample["distance_m"]


def test_it_is_a_map_style_data_set_that_other_processes_can_read(frames, frames_file):
    subset = frames.subset("train", transform=distance_of)
    again = pickle.loads(pickle.dumps(subset))
    assert [again[k] for k in range(len(again))] == [subset[k] for k in range(len(subset))]
    expected = frames[17]["range_m"]  # and after a fork, which leaves the child no handle of the file
    assert in_fork(lambda: int(not np.array_equal(frames[17]["range_m"], expected, equal_nan=True))) == 0


def test_a_closed_set_says_so(frames_file):
    frames = open_frames(frames_file)
    frames.close()
    with pytest.raises(UsageError, match="closed"):
        frames[0]


def test_a_packed_copy_reads_the_same(frames, frames_file, tmp_path):
    copy = tmp_path / "packed.h5"
    with h5py.File(frames_file) as source, h5py.File(copy, "w") as target:
        for key, value in source.attrs.items():
            target.attrs[key] = value
        for name, item in source.items():
            if isinstance(item, h5py.Group):
                source.copy(item, target)
            elif item.ndim > 1:
                target.create_dataset(name, data=item[...], chunks=True, compression="gzip")
            else:
                target.create_dataset(name, data=item[...])
    with open_frames(copy) as packed:
        for index in (5, slice(3, 30, 4)):
            np.testing.assert_array_equal(packed[index]["range_m"], frames[index]["range_m"])


def test_xarray_shows_labelled_axes_with_units(frames, frames_file):
    with xarray.open_dataset(frames_file, engine="h5netcdf") as data:
        assert data["range"].dims == ("frame", "row", "col")
        assert data["coverage"].dims == ("view", "row", "col")
        assert data["taps"].dims == ("frame", "phase", "tap", "row", "col")
        assert data["range"].attrs["units"] == "m"
        assert data["delta"].attrs["units"] == "degree"
        np.testing.assert_array_equal(data["range"].values, frames[:]["range_m"])


def test_the_matcher_reads_a_frame_set_as_measured_frames(frames, frames_file):
    measured = read_frames(frames_file, sensor=frames.sensor)
    np.testing.assert_array_equal(measured.range_m[0], frames[:]["range_m"].astype(float))


# --- verify ----------------------------------------------------------------------------------------------------------


def test_verify_passes_what_was_built(frames_file):
    report = verify_frames(frames_file, sample=20)
    assert report["rendered_again"] == 20
    assert report["sha256"] == sha256(frames_file)


@pytest.mark.parametrize("n", [100, pytest.param(5000, marks=pytest.mark.soak)])
def test_verify_reports_every_flipped_bit_and_every_cut(frames_file, tmp_path, n):
    rng = np.random.default_rng(5)
    content = frames_file.read_bytes()
    path = tmp_path / "frames.h5"
    (tmp_path / "frames.h5.sha256").write_bytes((frames_file.parent / "frames.h5.sha256").read_bytes())
    reported = 0
    for k in range(n):
        data = bytearray(content)
        if k % 4 == 3:
            del data[int(rng.integers(len(data))) :]
        else:
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            verify_frames(path)
        except InputFileError:
            reported += 1
    assert reported == n


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("range", np.inf, "'range' has inf"),
        ("coverage", np.nan, "'coverage' has nan"),
        ("range_mixed", 0.01, "'range_mixed' of item"),
        ("range", 0.01, "'range' of item"),
        ("flags", 1, "'range' has"),
        *((name, None, f"'{name}' is not what its plan draws") for name in ("split", "distance", "seed_index")),
    ],
)
def test_verify_finds_what_a_forged_checksum_hides(frames_file, tmp_path, name, change, message):
    path = Path(shutil.copy(frames_file, tmp_path))
    with h5py.File(path, "r+") as file:
        if change is None:
            file[name][...] = np.roll(file[name][...], 1)
        elif np.isfinite(change) and name.startswith("range"):
            file[name][...] = file[name][...] + np.float32(change)
        else:
            file[name][0, 8, 8] = change
    write_checksum(path)
    with pytest.raises(InputFileError, match=message):
        verify_frames(path, sample=20)


def test_verify_renders_a_bank_again(tmp_path):
    path = tmp_path / "bank.h5"
    build_bank(BankPlan(classes=["cone"], distance_m="0.9,1", delta_deg="0:90:45"), path).close()
    assert verify_bank(path)["rendered_again"] > 0
    checksum_path(path).unlink(missing_ok=True)
    with h5py.File(path, "r+") as file:
        file["lower/phasor"][1, 1] *= 1.001
    write_checksum(path, force=True)
    with pytest.raises(InputFileError, match="'phasor' of item"):
        verify_bank(path, sample=100)


@pytest.mark.parametrize("within", [(-9.0, -8.0), (-0.5, 0.7), (0.9, 3.0), (7.0, 9.0), (20.0, 30.0)])
def test_a_normal_with_cut_tails_is_truncated_at_either_end(within):
    share = np.linspace(0.001, 0.999, 999)
    drawn = Distribution(normal=(1, 0.1), within=tuple(1 + 0.1 * bound for bound in within)).values(share)
    np.testing.assert_allclose(drawn, stats.truncnorm.ppf(share, *within, 1, 0.1), rtol=1e-12)


def test_a_part_is_one_of_how_many(tmp_path):
    for part in ((3, 2), (0, 2), (1, 0)):
        with pytest.raises(UsageError, match=r"'part' must be \(i, n\) with 1 ≤ i ≤ n, got"):
            build_part(PLAN, part, tmp_path / "part.h5")
    assert not list(tmp_path.iterdir())


def test_a_subset_is_of_numbers_a_mask_or_a_split(frames):
    chosen = np.arange(len(frames)) % 3 == 0
    assert frames.subset(chosen).numbers.tolist() == np.flatnonzero(chosen).tolist()
    assert len(frames.subset([])) == 0
    for wrong, message in (
        (chosen[1:], "must be whole numbers or a mask of"),
        ([0.5], "must be whole numbers or a mask of"),
        ([0, len(frames)], f"there is no frame {len(frames)}"),
    ):
        with pytest.raises(UsageError, match=message):
            frames.subset(wrong)


def test_a_distribution_knows_its_bounds():
    assert Distribution(normal=(1, 2)).lowest == -np.inf
    assert Distribution(normal=(1, 2), within=(0, 3)).highest == 3
    assert Distribution(fixed=2).highest == 2


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("range", np.inf, r"'range' must be NaN or in 0 … 14\.99 m, got inf"),
        ("range_mixed", -1.0, r"'range_mixed' must be NaN or in 0 … 14\.99 m, got -1"),
        ("amplitude", np.nan, "'amplitude' must be finite, got nan"),
        ("intensity", 1e38, r"'intensity' must be finite, got 1e\+38"),
    ],
)
def test_values_that_no_run_writes_are_refused_when_they_are_read(frames_file, tmp_path, name, value, message):
    path = Path(shutil.copy(frames_file, tmp_path))
    with h5py.File(path, "r+") as file:
        file[name][0, 8, 8] = value
    with open_frames(path) as frames, pytest.raises(InputFileError, match=message):
        frames[0]
