"""A sensor inside MuJoCo sees what MuJoCo's own rays hit, when a real one would report it."""

import importlib
import sys
import warnings
from dataclasses import replace

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from oracles.mujoco_rays import ray_images, ray_targets_m

from phasemark import InputFileError, UsageError
from phasemark.render import Scene, SceneRenderer, preset
from phasemark.render.direct import HistogramFrames
from phasemark.render.scene.mujoco_scene import seen_model
from phasemark.render.simulators.gymnasium import TofObservation
from phasemark.render.simulators.mujoco import Cadence, TofSensor

AHEAD = 'xyaxes="0 -1 0 0 0 1"'  # a MuJoCo camera that looks along x of the world
WALL = '<geom name="wall" type="box" size=".05 4 4" pos="2.05 0 0" rgba=".5 .5 .5 .9"/>'
CAMERA = f'<camera name="tof" {AHEAD}/>'


def in_mujoco(world, assets="", **options):
    """Return a sensor in a model, and its data."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><asset>{assets}</asset><worldbody>{world}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    if model.nhfield:
        model.hfield_data[:] = np.random.default_rng(8).uniform(size=model.hfield_data.shape)
    mujoco.mj_forward(model, data)
    return TofSensor(model, **{"camera": "tof", **options} if "site" not in options else options), data


def drawn(geoms, seed):
    """Return bodies of given shapes at random places before the camera."""
    rng = np.random.default_rng(seed)
    bodies = []
    for k, geom in enumerate(geoms):
        place = " ".join(f"{x:.4f}" for x in rng.uniform([0.8, -0.3, -0.3], [1.6, 0.3, 0.3]))
        turn = " ".join(f"{x:.4f}" for x in rng.normal(size=4))
        grey = rng.uniform(0.2, 1.0)
        bodies.append(
            f'<body name="b{k}" pos="{place}" quat="{turn}"><freejoint/>'
            f'<geom {geom} pos=".02 -.01 .03" euler="20 30 40" rgba="{grey} {grey} {grey} 1"/></body>'
        )
    return "".join(bodies)


FLAT = ('type="box" size=".1 .06 .15"', 'type="mesh" mesh="part"', 'type="mesh" mesh="part"')
ROUND = (
    'type="sphere" size=".12"',
    'type="capsule" size=".07 .1"',
    'type="ellipsoid" size=".1 .15 .06"',
    'type="cylinder" size=".1 .08"',
)
PART = '<mesh name="part" vertex="0 0 0  .2 0 0  0 .15 0  .2 .15 .02  .05 .03 .25"/>'
TERRAIN = '<hfield name="h" nrow="7" ncol="6" size="1 .8 .3 .1"/>'
ON_TERRAIN = '<geom type="hfield" hfield="h" pos="1.3 0 -.45" rgba=".6 .6 .6 1"/>'


@pytest.mark.parametrize(
    ("shapes", "on", "tolerance"),
    [
        # the error of 16 384 rays in a pixel; of curved surfaces also the facets that stand for them
        pytest.param(FLAT, '<geom type="plane" size="3 0 1" pos="0 0 -.4"/>', 1e-3, id="flat"),
        pytest.param(FLAT, ON_TERRAIN, 1e-3, id="on terrain"),
        pytest.param(ROUND, "", 1e-3, id="round"),
    ],
)
def test_images_and_shares_are_those_of_dense_rays(shapes, on, tolerance):
    camera = preset("pmd-16x16").with_(rows=6, cols=6)
    sensor, data = in_mujoco(WALL + CAMERA + on + drawn(shapes, 3), PART + TERRAIN, sensor=camera, smooth=False)
    camera2world = sensor.camera2world(data)
    seen = sensor.seen
    albedo = np.clip(sensor.model.geom_rgba[:, :3] @ [0.2126, 0.7152, 0.0722], 0, 1)
    phasor, shares = ray_images(sensor.model, data, camera2world, camera, albedo, rays=16384)
    image = sensor.renderer.phasors(camera2world, seen.poses(data, camera2world[:3, 3]))
    assert np.abs(image.phasor[0] - phasor).max() < tolerance * np.abs(phasor).max()
    of_body = sensor.read(data).truth.shares
    assert sensor.read(data).truth.bodies[0] == "world"
    assert np.abs(of_body - shares[..., np.unique(seen.owner)]).max() < 6e-3


def test_the_chip_reports_what_it_would_of_dense_rays():
    chip = preset("vl53l8cx-8x8").with_(rows=4, cols=4)
    sensor, data = in_mujoco(WALL + CAMERA + drawn((*FLAT, *ROUND), 4), PART, sensor=chip, smooth=False)
    camera2world = sensor.camera2world(data)
    poses = sensor.seen.poses(data, camera2world[:3, 3])
    expected = sensor.renderer.histograms(camera2world, poses).expected
    found = HistogramFrames(expected[:, None], sensor=chip).targets.distance_m[0, 0]
    albedo = np.clip(sensor.model.geom_rgba[:, :3] @ [0.2126, 0.7152, 0.0722], 0, 1)
    of_rays = ray_targets_m(sensor.model, data, camera2world, chip, albedo, rays=8192)
    assert np.array_equal(np.isnan(found), np.isnan(of_rays))
    assert np.nanmax(np.abs(found - of_rays)) < 1e-3


def test_a_wall_is_read_at_its_distance():
    sensor, data = in_mujoco(WALL + CAMERA)
    reading = sensor.read(data)
    assert reading.truth.z_m == pytest.approx(np.full((8, 8), 2.0), abs=1e-12)
    assert reading.truth.bodies == ("world",)
    assert reading.truth.shares == pytest.approx(np.ones((8, 8, 1)), abs=1e-12)
    assert not reading.status.any()
    assert reading.histogram.shape == (8, 8, 128)
    assert (reading.signal > 0).all()
    assert np.abs(reading.distance_m - 2.0).max() < 0.015  # five sigma, and 3 mm that ranges differ within a zone
    assert abs(reading.distance_m.mean() - 2.0) < 0.004


def test_a_phase_camera_gives_ranges_with_their_noise():
    sensor, data = in_mujoco(WALL + CAMERA, sensor="pmd-16x16")
    reading = sensor.read(data)
    range_m = reading.truth.z_m / sensor.sensor.axis_cosine()
    chi = (reading.distance_m - range_m) / reading.sigma_m
    assert reading.histogram is None
    assert not reading.status.any()
    assert 0.75 < chi.std() < 1.25  # 256 pixels, 99.9 %: ± 0.15, and patterns of the pixels
    assert (reading.signal > 0).all()


@pytest.mark.parametrize("on", ["camera", "site"])
def test_left_is_left_and_up_is_up(on):
    ball = '<body name="ball" pos="1 .25 .3"><geom type="sphere" size=".1"/></body>'
    site = '<site name="tof" xyaxes="0 1 0 0 0 1"/>'
    sensor, data = in_mujoco(WALL + CAMERA + site + ball, **{on: "tof"})
    seen = sensor.read(data).truth.shares[..., 1]
    row, col = np.unravel_index(seen.argmax(), seen.shape)
    # tangents .25 and .3 of .414 to the left and up, 4 zones to the middle
    assert (row, col) == (1, 1)


def test_an_infinite_plane_is_under_the_sensor_wherever_it_is():
    world = '<geom type="plane" size="0 0 1"/><body name="robot" mocap="true" pos="0 0 .5">' + CAMERA + "</body>"
    sensor, data = in_mujoco(world)
    here = sensor.read(data)
    data.mocap_pos[0, :2] = 7000.0, -7000.0
    mujoco.mj_forward(sensor.model, data)
    sensor.reset(0)
    there = sensor.read(data)
    assert there.truth.shares == pytest.approx(here.truth.shares, abs=2e-3)  # it ends 500 m away at the nearest
    assert there.distance_m[5:] == pytest.approx(here.distance_m[5:], abs=1e-5, nan_ok=True)


def test_what_is_hidden_or_left_out_is_not_seen():
    balls = "".join(
        f'<body name="{name}" pos="1 0 0"><geom type="sphere" size=".1" {options}/></body>'
        for name, options in (("clear", 'rgba="1 1 1 0"'), ("collision", 'group="3"'), ("housing", ""))
    )
    assert in_mujoco(WALL + CAMERA + balls)[0].bodies == ("world", "housing")
    assert in_mujoco(WALL + CAMERA + balls, exclude_body="housing")[0].bodies == ("world",)
    assert in_mujoco(WALL + CAMERA + balls, groups=(0, 3))[0].bodies == ("world", "collision", "housing")


def test_albedo_is_luminance_one_number_or_that_of_names():
    materials = '<material name="m" rgba="0 1 0 1"/>'
    world = CAMERA + '<geom name="a" size=".1" pos="1 0 0" material="m"/>' + WALL
    model = in_mujoco(world, materials)[0].model
    of = [seen_model(model, albedo, -1, (0,), True) for albedo in ("rgba", 0.3, {"a": 0.1})]
    assert [[body.albedo for body in one.bodies] for one in of] == [[0.7152, 0.5], [0.3, 0.3], [0.1, 0.5]]


def test_a_file_of_a_model_becomes_a_scene(tmp_path, monkeypatch):
    file = tmp_path / "hall.xml"
    file.write_text(
        '<mujoco><worldbody><geom type="plane" size="2 2 1" rgba=".5 .5 .5 1"/><body name="ball" pos="1 0 .3">'
        '<freejoint/><geom size=".1" rgba="1 1 1 1"/><geom type="box" size=".1 .1 .1" group="3"/></body>'
        "</worldbody></mujoco>"
    )
    scene = Scene.read(file)
    assert scene.names == ("world", "ball")
    assert scene["ball"].albedo == 1.0
    np.testing.assert_allclose(scene["ball"].pose[:3, 3], [1, 0, 0.3], atol=1e-6)
    file.write_text('<mujoco><worldbody><geom type="blob" size="1"/></worldbody></mujoco>')
    with pytest.raises(InputFileError, match=r"hall\.xml: MuJoCo cannot read it: XML Error: invalid keyword: 'blob'"):
        Scene.read(file)
    older = tmp_path / "hall.mjb"
    older.write_bytes(bytes(400))
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log there
    with pytest.raises(InputFileError, match=r"hall\.mjb: MuJoCo cannot read .* must be of its version, \d"):
        Scene.read(older)


def test_solids_of_a_body_that_overlap_fill_its_share_together():
    pair = '<geom size=".1" pos="0 -.05 0"/><geom size=".1" pos="0 .05 0"/><geom size=".1" pos="0 1 0"/>'
    sensor, data = in_mujoco(WALL + CAMERA + f'<body name="pair" pos="1 0 0"><freejoint/>{pair}</body>')
    _, shares = ray_images(sensor.model, data, sensor.camera2world(data), sensor.sensor, np.ones(4), rays=4096)
    assert np.abs(sensor.read(data).truth.shares[..., 1] - shares[..., 1]).max() < 6e-3


def test_the_curve_where_solids_of_a_body_meet_moves_with_it():
    pair = '<geom type="capsule" size=".08 .1"/><geom size=".1" pos="0 .05 .1"/>'
    sensor, data = in_mujoco(WALL + CAMERA + f'<body name="pair" pos="1 0 0"><freejoint/>{pair}</body>')
    sensor.read(data)
    for turn in ((0.9, 0.1, 0.3, 0.2), (0.5, 0.5, 0.5, 0.5)):
        data.qpos[:7] = 0.8, 0.05, 0.02, *np.array(turn) / np.linalg.norm(turn)
        mujoco.mj_forward(sensor.model, data)
        poses = sensor.seen.poses(data, np.zeros(3))
        bodies = [replace(body, pose=pose) for body, pose in zip(sensor.seen.bodies, poses, strict=True)]
        camera = sensor.camera2world(data)
        built = SceneRenderer(Scene(bodies), sensor.sensor).histograms(camera).signal
        moved = sensor.renderer.histograms(camera, poses).signal
        np.testing.assert_allclose(moved, built, rtol=1e-5)


def test_a_body_that_trembles_by_less_than_a_micrometre_stands_still():
    sensor, data = in_mujoco(WALL + CAMERA + '<body pos="1 0 0.1234567"><freejoint/><geom size=".1"/></body>')
    poses = sensor.seen.poses(data, np.zeros(3))
    data.qpos[:3] += 1e-9
    mujoco.mj_forward(sensor.model, data)
    assert np.array_equal(sensor.seen.poses(data, np.zeros(3)), poses)


@pytest.mark.parametrize("latency", [0, 1, 3])
def test_a_frame_is_reported_its_latency_after_its_exposure_and_held(latency):
    cadence = Cadence(15.0, latency)
    shown_at = {}
    for step in range(400):
        time_s = 1.0 + 0.002 * step
        exposed, reported = cadence.frames(time_s)
        shown_at |= dict.fromkeys(exposed, time_s)
        assert reported == int(0.002 * step * 15 + 1e-6)
        # at least the latency old, at most a step more and the period that it is held for
        age = time_s - shown_at[reported]
        assert max(latency - 1, 0) / 15 <= age + 1e-9 or time_s < 1.0 + latency / 15
        assert age < (latency + 1) / 15 + 0.002


def test_frames_between_two_readings_show_the_later_one():
    cadence = Cadence(10.0, 1)
    assert [cadence.frames(time_s) for time_s in (0.0, 0.05, 0.1, 0.45)] == [
        (range(0, 2), 0),
        (range(2, 2), 0),
        (range(2, 3), 1),
        (range(4, 6), 4),  # the frame of 0.4 s was not seen before
    ]


def moving_wall(**options):
    """Return a sensor before a wall that comes nearer by 1 m/s."""
    body = '<body name="b" mocap="true" pos="2 0 0"><geom type="box" size=".01 2 2"/></body>'
    return in_mujoco(CAMERA + body, **options)


def test_readings_show_the_scene_one_frame_ago():
    sensor, data = moving_wall(rate_hz=10)
    ages = []
    for step in range(60):
        data.time = 0.01 * step
        data.mocap_pos[0, 0] = 2.01 - data.time
        mujoco.mj_forward(sensor.model, data)
        reading = sensor.read(data)
        ages.append(data.time - reading.time_s)
        assert reading.truth.z_m[4, 4] == pytest.approx(2.0 - reading.time_s, abs=1e-9)
    assert ages[:10] == pytest.approx([0.01 * k for k in range(10)])
    assert ages[10:20] == pytest.approx([0.1 + 0.01 * k for k in range(10)])
    assert ages[50:] == pytest.approx(ages[10:20])


def readings(sensor, data, times):
    found = []
    for time_s in times:
        data.time = time_s
        found.append(sensor.read(data))
    return found


def test_noise_depends_on_seed_run_and_frame_alone():
    sensor, data = moving_wall(rate_hz=10)
    other, _ = moving_wall(rate_hz=10)
    every = readings(sensor, data, np.arange(0, 1, 0.02))
    few = readings(other, data, [0.0, 0.1, 0.5, 0.9])
    by_number = {reading.number: reading for reading in every}
    assert {reading.number for reading in few} == {0, 1, 5, 9}
    for reading in few:
        assert np.array_equal(reading.histogram, by_number[reading.number].histogram)
    again = readings(sensor, data, [0.0, 0.1])  # the time went back: another run
    assert not np.array_equal(again[0].histogram, every[0].histogram)
    sensor.reset(seed=0)
    assert np.array_equal(sensor.read(data).histogram, every[0].histogram)
    sensor.reset(seed=1)
    assert not np.array_equal(sensor.read(data).histogram, every[0].histogram)


BALL = '<body name="ball" pos="0 0 0"><geom name="shell" size=".1"/></body>'
WRONG = {
    "neither": (dict(camera=None), "give camera=… or site=…, and not both"),
    "both": (dict(camera="tof", site="s"), "not both"),
    "no camera": (dict(camera="tot"), "no camera 'tot': there are 'tof'"),
    "no site": (dict(camera=None, site="s"), "no site 's': there are none"),
    "number": (dict(camera=3), "no camera 3"),
    "no body": (dict(exclude_body="bal"), "no body 'bal': there are 'world', 'ball'"),
    "no preset": (dict(sensor="vl53"), "unknown sensor 'vl53'"),
    "albedo": (dict(albedo=1.2), r"'albedo' must be a number in \[0, 1\]"),
    "albedo of a word": (dict(albedo="grey"), "or 'rgba' for all geoms, got 'grey'"),
    "albedo of no geom": (dict(albedo={"shel": 0.2}), "names geom 'shel', which the model does not have: shell"),
    "albedo of a geom": (dict(albedo={"shell": -1}), "'albedo' of geom 'shell'"),
    "group": (dict(groups=(7,)), "'groups' must be numbers from 0 to 5"),
    "nothing": (dict(groups=(4,)), "no geom for the sensor to see"),
    "one group": (dict(groups=3), "'groups' must be numbers from 0 to 5"),
    "rate": (dict(rate_hz=0), "'rate_hz' must be positive"),
    "rate as text": (dict(rate_hz="15"), "'rate_hz' must be positive"),
    "seed": (dict(seed=-1), "'seed' must be a whole number, at least 0"),
    "half a seed": (dict(seed=1.5), "'seed' must be a whole number, at least 0"),
    "half a latency": (dict(latency_frames=np.nan), "'latency_frames' must be 0, 1"),
    "latency": (dict(latency_frames=-1), "'latency_frames' must be 0, 1"),
}


@pytest.mark.parametrize(("options", "message"), WRONG.values(), ids=WRONG)
def test_wrong_arguments_end_in_one_line(options, message):
    with pytest.raises(UsageError, match=message) as raised:
        in_mujoco(CAMERA + BALL, **options)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("field", "albedo", "refused"),
    [
        ("geom_size", "rgba", True),
        ("hfield_data", "rgba", True),
        ("geom_rgba", "rgba", True),
        ("geom_rgba", 0.5, False),  # colours may change where they are no albedos
    ],
)
def test_data_of_a_model_with_other_geoms_is_refused(field, albedo, refused):
    scene = (
        '<asset><hfield name="h" nrow="3" ncol="3" size="1 1 1 .1"/></asset><worldbody>'
        '<geom type="hfield" hfield="h" pos="2 0 -1"/><geom size=".1" pos="1 0 0"/>'
        '<camera name="tof" xyaxes="0 -1 0 0 0 1"/></worldbody>'
    )
    sensors, data = [], []
    for _ in range(2):
        model = mujoco.MjModel.from_xml_string(f"<mujoco>{scene}</mujoco>")
        sensors.append(TofSensor(model, camera="tof", albedo=albedo))
        data.append(mujoco.MjData(model))
        mujoco.mj_forward(model, data[-1])
    sensors[0].read(data[0])
    sensors[0].read(data[1])  # of the same geoms
    getattr(sensors[0].model, field).flat[0] += 0.25
    data[0].time += 1.0  # another frame
    if not refused:
        sensors[0].read(data[0])
        return
    with pytest.raises(UsageError, match="with other geoms make another sensor"):
        sensors[0].read(data[0])


def test_sensors_of_one_seed_on_other_cameras_have_other_noise():
    back = CAMERA.replace('name="tof"', 'name="back"')
    front, data = in_mujoco(CAMERA + back + WALL)
    other = TofSensor(front.model, camera="back")
    again = TofSensor(front.model, camera="tof")
    ahead, behind, same = (sensor.read(data).histogram for sensor in (front, other, again))
    assert np.array_equal(ahead, same)
    assert not np.array_equal(ahead, behind)


def test_what_cannot_be_rendered_is_named():
    sensor, _ = in_mujoco(CAMERA + BALL + WALL)
    model = sensor.model
    model.geom_type[1] = mujoco.mjtGeom.mjGEOM_SDF
    with pytest.raises(UsageError, match=r"shell of body 'ball' is of type 8 \(mjGEOM_SDF\)"):
        TofSensor(model, camera="tof")
    model.geom_type[1] = 77
    with pytest.raises(UsageError, match=r"is of type 77 \(unknown\)"):
        TofSensor(model, camera="tof")
    with pytest.raises(UsageError, match=r"'model' must be a mujoco\.MjModel, got str"):
        TofSensor("model.xml", camera="tof")
    grid = 'type="grid" count="3 3 1" spacing=".1 .1 .1" dim="2" mass="1" pos="1 0 0"'
    cloth = f'<flexcomp name="c" {grid}><edge equality="true"/></flexcomp>'
    with pytest.raises(UsageError, match="flex 0 of the model cannot be rendered"):
        in_mujoco(CAMERA + WALL + cloth)


def test_wrong_states_end_in_one_line():
    sensor, data = in_mujoco(CAMERA + BALL + WALL)
    with pytest.raises(UsageError, match=r"lens is inside body 'ball'.*exclude_body="):
        sensor.read(data)
    sensor, data = in_mujoco(CAMERA + WALL + '<body name="b" pos="1 0 0"><freejoint/><geom size=".1"/></body>')
    with pytest.raises(UsageError, match=r"call mujoco\.mj_forward"):
        sensor.read(mujoco.MjData(sensor.model))
    with pytest.raises(UsageError, match="of the sensor's model"):
        sensor.read(in_mujoco(CAMERA + WALL)[1])
    with pytest.raises(UsageError, match="of the sensor's model"):
        sensor.read(None)
    data.xpos[1] = np.nan
    with pytest.raises(UsageError, match="pose of body 'b' is not finite"):
        sensor.read(data)
    data.time = np.nan
    with pytest.raises(UsageError, match="the time of the data is nan"):
        sensor.read(data)


@pytest.mark.parametrize(
    ("missing", "module"),
    [("mujoco", "simulators.mujoco"), ("mujoco", "scene.mujoco_scene"), ("gymnasium", "simulators.gymnasium")],
)
def test_without_the_package_the_extra_is_named(missing, module, monkeypatch):
    module = f"phasemark.render.{module}"
    monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(UsageError, match=rf"need.* the package {missing}: pip install -e '\.\[mujoco\]'"):
        importlib.import_module(module)


class Slider(gymnasium.Env):
    """A wall that slides towards a sensor."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, space=None, render_mode=None):
        wall = '<body pos="2 0 0"><joint type="slide" axis="1 0 0"/><geom type="box" size=".01 1 1"/></body>'
        self.model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{CAMERA}{wall}</worldbody></mujoco>")
        self.data = mujoco.MjData(self.model)
        self.observation_space = space or gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def observed(self):
        own = self.data.qpos.copy()
        return {"place": own} if isinstance(self.observation_space, gymnasium.spaces.Dict) else own

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[0] = self.np_random.uniform(-0.2, 0.2)
        mujoco.mj_forward(self.model, self.data)
        return self.observed(), {}

    def step(self, action):
        self.data.qvel[0] = float(action[0])
        mujoco.mj_step(self.model, self.data, nstep=25)
        return self.observed(), 0.0, False, False, {}


class Still(Slider):
    """A wall that stands still."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=0, options=options)
        return self.observed(), {}


DICTIONARY = gymnasium.spaces.Dict({"place": gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)})


@pytest.mark.parametrize("space", [None, DICTIONARY], ids=["box", "dictionary"])
@pytest.mark.parametrize("replace", [False, True])
def test_an_environment_with_readings_passes_the_checker(space, replace):
    gymnasium.register("Slider-v0", lambda **options: Slider(space, **options))
    try:
        env = TofObservation(gymnasium.make("Slider-v0"), camera="tof", replace=replace)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*different from the unwrapped version")
            warnings.filterwarnings("ignore", message=".*(infinity|minimum value|maximum value)")
            check_env(env)
    finally:
        gymnasium.registry.pop("Slider-v0")
    observation, _ = env.reset(seed=3)
    distances = observation if replace else observation["tof"]
    assert (distances == env.reading.distance_m.astype(np.float32)).all()
    assert replace or set(observation) == {"tof", "place" if space else "observation"}


def test_every_episode_has_noise_of_its_own_and_a_seed_repeats_it():
    env = TofObservation(Slider(), camera="tof", replace=True)
    first, second, again = (env.reset(seed=seed)[0] for seed in (5, None, 5))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, second)


@pytest.mark.parametrize(("options", "the_same"), [({}, False), ({"seed": 4}, True)])
def test_environments_without_a_seed_have_noise_of_their_own(options, the_same):
    readings = []
    for _ in range(2):
        readings.append(TofObservation(Still(), camera="tof", replace=True, **options).reset()[0])
    assert np.array_equal(*readings) is the_same


def test_a_zone_without_target_has_the_largest_distance():
    slider = Slider()
    env = TofObservation(slider, camera="tof", replace=True)
    env.reset(seed=0)
    slider.data.qpos[0] = 50.0
    mujoco.mj_forward(slider.model, slider.data)
    env.tof.reset()
    distances, *_ = env.step(np.zeros(1, np.float32))
    nothing = env.reading.status != 0
    assert nothing.sum() > 60  # noise alone may rise above the threshold
    assert np.array_equal(distances == np.float32(4.8), nothing)  # 128 bins of 37.5 mm


def test_environments_without_a_model_and_taken_keys_are_refused():
    with pytest.raises(UsageError, match="has no 'model' and 'data' of MuJoCo"):
        TofObservation(gymnasium.Env(), camera="tof")
    with pytest.raises(UsageError, match="observes something under 'place' already"):
        TofObservation(Slider(DICTIONARY), camera="tof", key="place")


def test_rays_read_the_same_scene_to_a_hundredth():
    world = CAMERA + WALL + drawn(ROUND + FLAT[:1], 3)
    exact, data = in_mujoco(world, PART)
    quick, again = in_mujoco(world, PART, rays=10)
    seen, close = exact.read(data).truth, quick.read(again).truth
    assert np.sqrt(((seen.shares - close.shares) ** 2).mean()) < 1e-2
    assert not np.array_equal(seen.shares, close.shares)
