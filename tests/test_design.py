"""Landmark design: plan, rules, bound, separation, search, confirmation, and what is written."""

import csv
import io
import json
import math
import tomllib
from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest
from PIL import Image
from scipy import stats

from phasemark import InputFileError, UsageError
from phasemark.cli import main
from phasemark.data import BankPlan
from phasemark.data.plans import read_bank_plan
from phasemark.landmarks import LandmarkSpec, build_mesh, catalog, read_mesh
from phasemark.landmarks.spec import Box, Cone, Cylinder, Revolution, Sphere
from phasemark.matcher import Matcher, cramer_rao, kalman_filter
from phasemark.matcher.design import (
    AllowedDimensions,
    ClassDistances,
    DesignPlan,
    LimitsPlan,
    SamplingPlan,
    SearchPlan,
    choose_far_apart,
    confirm_design,
    default_design,
    example_design,
    landmarks_toml,
    mesh_stl,
    output_names,
    pareto_csv,
    range_bound,
    read_design_plan,
    run_design,
    summary,
    turn_distance,
    write_design,
)
from phasemark.matcher.design.measures import box_alone, upper_appearance
from phasemark.matcher.design.search import Search
from phasemark.matcher.design.shapes import Lattice, neighbours, sample_boxes, sample_uppers
from phasemark.matcher.statistics import ratio_interval, rms_interval
from phasemark.render import Renderer, Views, capture, predicted_range_std, preset

NEAR, FAR = 0.8, 2.0
TAN = math.tan(math.radians(11))  # of the preset's half angle
SMALL = DesignPlan(
    n_classes=3,
    symmetry=4,
    sampling=SamplingPlan(distances=3, delta_step_deg=7.5),
    search=SearchPlan(boxes=12, uppers=24, step_mm=3),
)


@pytest.fixture(scope="module")
def room():
    return AllowedDimensions(default_design(), default_design().build_sensor())


@pytest.fixture(scope="module")
def design():
    return run_design(SMALL, workers=1)


@pytest.fixture(scope="module")
def confirmed(design):
    return confirm_design(design, 2, workers=1)


# the plan


def test_the_shipped_plan_is_the_default():
    assert default_design() == DesignPlan()
    assert DesignPlan(**tomllib.loads(example_design())) == DesignPlan()


def test_the_schema_knows_every_key_of_the_shipped_plan():
    schema = DesignPlan.model_json_schema()
    for key, value in tomllib.loads(example_design()).items():
        part = schema["properties"][key]
        if isinstance(value, dict):
            named = schema["$defs"][part["$ref"].split("/")[-1]] if "$ref" in part else part
            assert set(value) == set(named["properties"])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("distance_m = [2.0, 0.8]", "'distance_m' must be (near, far), got (2.0, 0.8)"),
        ("n_classes = 0", "'n_classes' must be greater than or equal to 1, got 0"),
        ("[limits]\nfit = 'loose'", "limits: 'fit' must be 'axis' or 'whole', got 'loose'"),
        ("[limits]\nleast_pixels = 3", "limits: unknown key 'least_pixels'"),
        ("[limits]\nextents_m = [300, 300, 300]", "got 300 × 300 × 300 m; if that was in millimetres, write 0.3 × 0.3"),
        ("[search]\nstep_mm = 40", "'search.step_mm' must be at most a twentieth of the least extent, 15 mm, got 40"),
        ("symmetry = 3", "'symmetry'"),
    ],
)
def test_a_mistake_in_the_plan_names_file_key_and_value(tmp_path, text, said):
    file = tmp_path / "plan.toml"
    file.write_text(text)
    with pytest.raises(UsageError) as error:
        read_design_plan(file)
    assert str(error.value).startswith(f"{file}: ")
    assert said in str(error.value)


def _sensor_file(path, **changes):
    fields = {**preset("pmd-16x16").model_dump(mode="json", exclude_none=True), **changes}
    path.write_text("".join(f"{key} = {json.dumps(value)}\n" for key, value in fields.items()))


def test_a_sensor_file_is_relative_to_the_plan(tmp_path):
    with pytest.raises(InputFileError, match="cannot be read"):
        read_design_plan(tmp_path / "plan.toml")
    _sensor_file(tmp_path / "cam.toml", half_angle_h_deg=15.0)
    (tmp_path / "plan.toml").write_text('sensor = "cam.toml"\n')
    assert read_design_plan(tmp_path / "plan.toml").build_sensor().half_angle_h_deg == 15.0


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"sensor": "vl53l5cx-8x8"}, "must measure phases"),
        ({"sensor_overrides": {"pitch_deg": 1.0}}, "the sensor is tilted"),
        ({"sensor_overrides": {"rows": 15}}, "odd number of rows"),
    ],
)
def test_a_sensor_that_does_not_suit_is_refused(fields, said):
    with pytest.raises(UsageError, match=said):
        DesignPlan(**fields).build_sensor()


# the rules


def test_the_field_at_the_near_end_is_0_31_m(room):
    # PHYSICS section 5: "at 0.8 m the camera sees 0.31 m"
    assert room.widest_m == pytest.approx(2 * NEAR * TAN, rel=1e-12)
    assert room.tallest_m == pytest.approx(NEAR * TAN, rel=1e-12)
    assert round(room.widest_m, 2) == 0.31


def test_in_view_as_a_whole_is_what_projection_says():
    whole = DesignPlan(limits=LimitsPlan(fit="whole"))
    room = AllowedDimensions(whole, whole.build_sensor())
    rng = np.random.default_rng(1)
    for length, width, height, r, h in rng.uniform((0.1, 0.1, 0.05, 0.02, 0.05), (0.3, 0.3, 0.2, 0.1, 0.2), (200, 5)):
        box, upper = Box(length_m=length, width_m=width, height_m=height), Cylinder(radius_m=r, height_m=h)
        checks = {c.rule: c.passes for c in room.checks(LandmarkSpec(name="x", box=box, upper=upper))}
        # every corner turns about the axis in a circle; the rim of the cylinder is one
        turn = np.radians(np.arange(0, 360, 0.05))
        for radius, z, rules in (
            (math.hypot(length, width) / 2, height, ("in view sideways, near end", "in view downwards, near end")),
            (r, h, (None, "in view upwards, near end")),
        ):
            x, y = NEAR + radius * np.cos(turn), radius * np.sin(turn)
            for rule, inside in zip(rules, ((np.abs(y) / x).max() <= TAN, (z / x).max() <= TAN), strict=True):
                assert rule is None or checks[rule] == inside


def test_the_catalogue_keeps_the_geometric_rules_and_a_broken_one_says_its_number_and_its_limit(room):
    for spec in catalog().values():
        assert [str(check) for check in room.checks(spec) if not check.passes] == []
    wide = LandmarkSpec(name="wide", box=Box(length_m=0.31, width_m=0.05, height_m=0.1))
    broken = {check.rule: check for check in room.checks(wide) if not check.passes}
    assert set(broken) == {"extent x'", "in view sideways, near end", "edges of the box resolvable, far end"}
    pixel = 2 * FAR * TAN / 16
    assert broken["edges of the box resolvable, far end"].value == pytest.approx(0.05 / pixel)
    assert str(broken["extent x'"]) == "extent x': 0.31 m, must be at most 0.3 m"


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        (
            {"distance_m": (0.4, 6.0)},
            r"'edges resolvable' asks for a box so wide: 0\.292 m, 2 pixels of 0\.1458 m at 6 m",
        ),
        ({"distance_m": (0.8, 16.0)}, r"rule reflecting enough, far end: 0\.1897 rad, must be at most 0\.1 rad"),
        (
            {"distance_m": (0.8, 16.0), "sensor_overrides": {"signal_e": 1e6}},
            r"rule within the unambiguous range: 16 m, must be at most 14\.99 m",
        ),
        ({"albedo": 0.02}, r"rule reflecting enough, far end: 0\.15 rad, must be at most 0\.1 rad"),
        ({"limits": LimitsPlan(extents_m=(0.3, 0.3, 0.1))}, "'edges resolvable' asks for a box so high: 0.097 m"),
        ({"limits": LimitsPlan(least_lower_px=60)}, "rule pixels on the box, far end: .* must be at least 60 px"),
        ({"limits": LimitsPlan(least_class_distance=80)}, "rule classes told apart, d: .* must be at least 80 σ"),
    ],
)
def test_a_range_that_no_landmark_can_serve_names_the_rule_and_its_number(fields, said):
    plan = SMALL.model_copy(update=fields)
    with pytest.raises(UsageError, match=r"^no landmark can serve .*" + said):
        run_design(plan, workers=1)


# the bound


def test_the_position_bound_is_the_trace_of_the_positions_covariance():
    plan = default_design()
    sensor, spec = plan.build_sensor(), catalog()["cone"]
    bound = range_bound(spec, sensor, plan, distance_m=np.array([1.1]), delta_rad=np.array([0.4]))
    of_view = cramer_rao(Renderer(build_mesh(spec), sensor), Views.broadcast(1.1, 0.4), pixels="lower").covariance[0]
    heading = 0.4 + 0.3  # anywhere
    towards = np.array([math.cos(heading), math.sin(heading)])
    jacobian = np.c_[-towards, -1.1 * np.array([-towards[1], towards[0]])]  # PHYSICS section 8
    expected = math.sqrt(np.trace(jacobian @ of_view @ jacobian.T))
    # the meshes differ by 1e-4 m at the upper part, which the lower pixels hardly see
    assert bound.worst_m == pytest.approx(expected, rel=1e-3)


def test_neither_the_mirror_side_nor_an_upper_part_changes_the_bound_of_the_lower_pixels():
    plan = default_design()

    def bound(spec, delta_rad):
        distance_m = np.array([0.9, 2.0])
        return range_bound(spec, plan.build_sensor(), plan, distance_m=distance_m, delta_rad=delta_rad).position_std_m

    post = catalog()["post"]
    delta = np.radians([13.0, 41.0, 77.0])
    alone = bound(box_alone(post.box, plan), delta)
    # slopes are differences over 1e-5 of an integral good to 1e-8 or so
    np.testing.assert_allclose(bound(box_alone(post.box, plan), math.pi - delta), alone, rtol=1e-3)
    np.testing.assert_allclose(bound(post, delta)[1], alone[1], rtol=5e-3)  # kinks, PHYSICS 7


# distinguishing landmarks


def test_the_distance_of_two_classes_is_the_matchers_cost_without_noise(design):
    plan, sensor = design.plan, design.search.sensor
    specs = [catalog()["cylinder"], catalog()["cone"]]
    seen = [upper_appearance(spec.upper, sensor, plan) for spec in specs]
    at = 1  # 1.4 m
    cost, gradient, information = (part[0, at] for part in ClassDistances.row(seen[0], seen[1:]))
    distance = plan.sampled_distance_m[at]
    # the other class at the best of many distances, the box's information as a parabola
    renderer = Renderer(build_mesh(specs[1], part="upper", tolerance_m=1e-4), sensor)
    shifts = np.linspace(-0.02, 0.02, 401)
    others = renderer.render(distance + shifts, rows=(0, 8)).phasor.reshape(401, -1)
    ranges = sensor.metres_per_radian * np.angle(others)
    both = (seen[0].weight[at] > 0) & seen[1].may[at]
    misfit = (seen[0].weight[at] * (seen[0].range_m[at] - ranges) ** 2)[:, both].sum(axis=1)
    for box_information in (1e4, 1e6):
        total = misfit + box_information * shifts**2
        penalty = cost - misfit[200]
        assert penalty == pytest.approx(25 * round(penalty / 25), abs=1e-3 * cost)
        expected = total.min() + penalty
        # ranges of mixed pixels bend over the shift of some millimetres
        assert cost - gradient**2 / (box_information + information) == pytest.approx(expected, rel=0.02)
    alike = ClassDistances.between(seen[:1] * 2).least(np.full(3, 1e5))
    assert alike[0, 1] == 0
    assert np.isinf(np.diag(alike)).all()


def test_confusion_follows_the_distance_of_classes():
    # frames of the one are nearer to the other with probability Q(d/2): both must show in simulated frames
    plan = DesignPlan(distance_m=(1.9, 2.0), sampling=SamplingPlan(distances=2))
    sensor, specs = plan.build_sensor(), [catalog()["cylinder"], catalog()["sphere"]]
    seen = [upper_appearance(spec.upper, sensor, plan) for spec in specs]
    d = ClassDistances.between(seen).least(np.full(2, 1e9))[0, 1]  # D known
    n = 300
    images = [Renderer(build_mesh(spec), sensor).render(np.full(n, 2.0), math.pi / 4) for spec in specs]
    frames = capture(images[0], sensor, rng=np.random.default_rng(11), n_frames=50)
    filtered = kalman_filter(frames)
    returned = np.isfinite(filtered.range_m[:, :8]) & (seen[0].weight[-1] > 0).reshape(8, 16)
    upper = [image.coverage[0, :8] for image in images]
    std = [predicted_range_std(np.abs(image.phasor[0, :8]), image.intensity[0, :8], sensor) for image in images]
    may = np.stack([one >= 0.005 for one in upper])
    sure_m = 0.05 * sensor.metres_per_radian
    must = np.stack([(one > 0.3) & (own <= sure_m) for one, own in zip(upper, std, strict=True)])
    costs = []
    for k, image in enumerate(images):
        residual = (filtered.range_m - image.range_m)[:, :8] / filtered.std_m[:, :8]
        fit = np.where(returned & may[k], np.nan_to_num(residual) ** 2, 0).sum(axis=(1, 2))
        costs.append(fit + 25 * ((returned & ~may[k]) | (~returned & must[k])).sum(axis=(1, 2)))
    wrong = int((costs[1] < costs[0]).sum())
    low, high = stats.binomtest(wrong, n).proportion_ci(0.999)
    # cylinder taken for sphere may be the better direction of the two, and weak pixels are not quite Gaussian
    assert low <= 1.5 * stats.norm.sf(d / 2)
    assert high >= stats.norm.sf(d / 2) / 20


def test_the_best_set_is_found_among_few():
    rng = np.random.default_rng(3)
    points = rng.random((14, 2))
    distance = np.hypot(*(points[:, None] - points).transpose(2, 0, 1))
    np.fill_diagonal(distance, np.inf)
    chosen = choose_far_apart(distance, 2)
    assert distance[chosen[0], chosen[1]] == distance[np.isfinite(distance)].max()
    for n in (3, 4):
        best = max(distance[np.ix_(c, c)].min() for c in map(list, combinations(range(14), n)))
        chosen = choose_far_apart(distance, n)
        assert len(set(chosen.tolist())) == n
        # exchanges reach an optimum that no single exchange improves; the farthest-first start is within a factor of 2
        assert distance[np.ix_(chosen, chosen)].min() >= 0.85 * best
    assert choose_far_apart(distance, 20).tolist() == list(range(14))


def test_faces_that_reach_into_the_same_pixels_are_taken_for_one_another():
    # 0.25 × 0.2 seen along x' at 2 m: a face 0.2 m wide at 1.875 m; a quarter-turn on, 0.25 m at 1.9 m
    plan = default_design()
    sensor = plan.build_sensor()
    for half_width, range_m in ((0.1, 1.875), (0.125, 1.9)):
        assert math.ceil(half_width / range_m / (TAN / 8)) == 3  # pixels from the middle
    alike, square, known = (
        turn_distance(Box(length_m=length, width_m=width, height_m=0.15), sensor, plan)
        for length, width in ((0.25, 0.2), (0.2, 0.2), (0.24, 0.16))
    )
    assert alike < 1
    assert known > 6
    assert math.isinf(square)


# shapes


def test_shapes_that_are_tried_lie_on_the_lattice_and_keep_the_limits(room):
    plan, lattice = default_design(), Lattice(1.0)
    boxes = sample_boxes(plan, room, lattice)
    assert len(boxes) == len(set(boxes)) > 100
    for length, width, height in boxes:
        assert width <= length
        box = Box(length_m=length / 1000, width_m=width / 1000, height_m=height / 1000)
        assert all(check.passes for check in room.checks(box_alone(box, plan)))
    for symmetry, square in (("any", {True, False}), (2, {False}), (4, {True})):
        tried = sample_boxes(DesignPlan(symmetry=symmetry), room, lattice)
        assert {length == width for length, width, _ in tried} == square
    uppers = sample_uppers(plan, room, lattice)
    assert {type(upper) for upper in uppers} == {Cylinder, Cone, Sphere, Revolution}


def test_neighbours_differ_in_one_dimension_by_the_step():
    profile = Revolution(profile_m=((0.05, 0.0), (0.06, 0.05), (0.07, 0.1)))
    for changed in neighbours(profile, 2, Lattice(1.0)):
        assert isinstance(changed, Revolution)
        a, b = np.array(profile.profile_m), np.array(changed.profile_m)
        moved = np.abs(a - b)
        assert moved[:, 0].sum() == pytest.approx(0.002) or moved[1, 1] == pytest.approx(0.002)
    spheres = neighbours(Sphere(radius_m=0.05), 1, Lattice(1.0))
    radii = {upper.radius_m for upper in spheres if isinstance(upper, Sphere)}
    assert radii == {0.051, 0.049}


# the search


def test_a_design_keeps_every_rule_and_beats_the_catalogue(design):
    broken = [str(c) for checks in design.result.checks.values() for c in checks if not c.passes]
    assert broken == []
    # 12 boxes on a coarse lattice: the default plan reaches 1.68
    assert design.factor > 1.5
    assert design.result.class_distance > design.catalogue.class_distance
    assert len({spec.box for spec in design.result.specs}) == 1
    for spec in design.result.specs:
        assert (build_mesh(spec).extents <= np.array(design.plan.limits.extents_m) + 1e-6).all()


def test_refining_loses_nothing_and_no_feasible_candidate_beats_one_of_the_front_in_both(design):
    tried = [c for c in design.candidates if c.feasible and not c.refined]
    assert design.chosen.bound.worst_m <= min(c.bound.worst_m for c in tried)
    # the same measure: cached appearances of the parts, on the chosen box
    assert design.result.class_distance >= design.chosen.class_distance * (1 - 1e-9)
    front = design.front()
    assert front
    for one, other in product(front, design.candidates):
        better = other.bound.worst_m < one.bound.worst_m and other.class_distance > one.class_distance
        assert not (other.feasible and better)


def test_the_same_plan_gives_the_same_design(design):
    again = run_design(SMALL, workers=2)
    assert [spec.model_dump() for spec in again.result.specs] == [spec.model_dump() for spec in design.result.specs]
    assert pareto_csv(again) == pareto_csv(design)


# the confirmation


def test_errors_of_simulated_frames_are_at_the_bound(confirmed):
    for confirmation in confirmed:
        # maximum likelihood at signals this weak: 1.03 for the set, 1.11 for the catalogue with many frames; N = 42 and
        # 52, which scatter by 11 %
        assert 0.75 < confirmation.sides.efficiency.value < 1.5
        assert confirmation.sides.missed.value == 0
        assert confirmation.anywhere.class_errors.value < 0.05


def test_the_worst_side_is_measured_with_fresh_frames(confirmed):
    for confirmation in confirmed:
        mean_square = [confirmation.sides.rmse(k).value for k in range(len(confirmation.sides.error_m))]
        contenders = confirmation.sides.delta_rad[np.argsort(mean_square)[-3:], 0]
        assert confirmation.worst.delta_rad[0, 0] in contenders
        assert np.ptp(confirmation.worst.delta_rad) == 0
        assert not np.isin(confirmation.worst.error_m, confirmation.sides.error_m).any()


def test_the_intervals_of_a_root_mean_square_and_of_a_ratio_of_two_cover_the_truth():
    rng, inside = np.random.default_rng(5), np.zeros(2, int)
    for _ in range(400):
        two, three = (rms_interval(rng.normal(0, std, 300), law="normal") for std in (2, 3))
        quotient = ratio_interval(three, two)
        inside += two.low <= 2 <= two.high, quotient.low <= 1.5 <= quotient.high
    low, high = stats.binom.ppf([0.0005, 0.9995], 400, 0.95)
    assert ((low <= inside) & (inside <= high)).all()


# meshes and files


def test_a_mesh_file_is_in_millimetres(tmp_path):
    spec = catalog()["cone"]
    file = tmp_path / "cone.stl"
    file.write_bytes(mesh_stl(spec))
    np.testing.assert_allclose(read_mesh(file, unit="mm").extents, (0.24, 0.16, 0.3), atol=1e-6)


def test_the_files_say_what_the_design_is(design, confirmed, tmp_path):
    files = write_design(design, confirmed, tmp_path)
    assert [file.name for file in files] == output_names(design.plan)
    plan = read_bank_plan(tmp_path / "landmarks.toml")
    assert isinstance(plan, BankPlan)
    assert plan.landmarks == design.result.specs
    assert plan.resolve().build_sensor() == design.search.sensor
    rows = list(csv.DictReader(io.StringIO((tmp_path / "pareto.csv").read_text())))
    assert len(rows) == len(design.candidates) + 1
    chosen = next(row for row in rows if row["box"] == "chosen")
    assert float(chosen["worst_position_bound_m"]) == pytest.approx(design.chosen.bound.worst_m, rel=1e-8)
    assert chosen["on_front"] == "1"
    facts = json.loads((tmp_path / "design.json").read_text())
    table = facts.pop("pareto")
    assert facts == json.loads(json.dumps(summary(design, confirmed)))
    assert [row["broken_rules"] for row in table] == [row["broken_rules"] for row in rows]
    assert facts["confirmation"]["worst_rmse_factor"]["low"] < facts["confirmation"]["worst_rmse_factor"]["value"]
    for name in ("pareto.png", "bound.png"):
        assert np.asarray(Image.open(tmp_path / name).convert("L")).std() > 10


def test_a_sensor_from_a_file_travels_with_the_landmarks(design, tmp_path):
    _sensor_file(tmp_path / "cam.toml", signal_e=30000.0)
    plan = DesignPlan(sensor=str(tmp_path / "cam.toml"))
    (tmp_path / "landmarks.toml").write_text(landmarks_toml(replace(design, plan=plan, search=Search(plan))))
    (tmp_path / "cam.toml").unlink()
    read = read_bank_plan(tmp_path / "landmarks.toml")
    assert read.build_sensor() == preset("pmd-16x16").with_(signal_e=30000.0)
    assert read.landmarks == design.result.specs


def test_the_command_writes_and_refuses_to_overwrite(tmp_path, capsys):
    file = tmp_path / "plan.toml"
    file.write_text(
        "n_classes = 1\nsymmetry = 4\n[sampling]\ndistances = 2\ndelta_step_deg = 15\n"
        "[search]\nboxes = 8\nuppers = 8\nstep_mm = 5\n"
    )
    out = tmp_path / "out"
    arguments = ["landmark", "design", str(file), "--out", str(out), "--confirm", "0", "--workers", "1"]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "times lower than the catalogue's" in said
    assert str(out / "mark-1.stl") in said
    assert main(arguments) == 4
    assert "exists already" in capsys.readouterr().err
    assert main(["bank", "build", str(out / "landmarks.toml"), "--dry-run", "-o", str(out / "bank.h5")]) == 0
    capsys.readouterr()
    assert main(["landmark", "design", "--example"]) == 0
    assert capsys.readouterr().out == example_design()


def test_a_design_can_be_matched_against_its_own_bank(design):
    from phasemark.data import build_bank

    bank = build_bank(BankPlan(landmarks=design.result.specs, distance_m="0.95:1.05:0.01"), workers=1)
    spec = design.result.specs[1]
    image = Renderer(build_mesh(spec), bank.sensor, albedo=spec.albedo).render(1.0, 0.2)
    frames = kalman_filter(capture(image, bank.sensor, rng=np.random.default_rng(2), n_frames=50))
    match = Matcher(bank, method="refine", workers=1).match(frames)[0]
    assert match.class_name == spec.name
    assert match.symmetry == spec.symmetry
