"""Robots of URDF files become scenes, or end in one line that names what is wrong."""

import numpy as np
import pytest
import trimesh

from phasemark import InputFileError
from phasemark.render import Scene

ROBOT = """<robot name="arm">
  <material name="red"><color rgba="1 0 0 1"/></material>
  <link name="base"><visual><geometry><box size=".2 .2 .1"/></geometry><material name="red"/></visual></link>
  <link name="arm">
    <visual><origin xyz="0 0 .2"/><geometry><cylinder radius=".04" length=".4"/></geometry></visual>
    <visual><origin rpy="0 1.5707963 0"/><geometry>
      <mesh filename="package://arm/meshes/tip.stl" scale=".001 .001 .001"/></geometry>
      <material name="grey"><color rgba=".5 .5 .5 1"/></material></visual>
    <collision><geometry><sphere radius="9"/></geometry></collision>
  </link>
  <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 .05" rpy="0 0 1.5707963"/>
    <axis xyz="0 1 0"/></joint>
</robot>"""


def test_a_urdf_becomes_the_bodies_of_its_links(tmp_path):
    (tmp_path / "arm" / "meshes").mkdir(parents=True)
    (tmp_path / "arm" / "urdf").mkdir()
    trimesh.creation.box((400, 20, 60)).export(tmp_path / "arm" / "meshes" / "tip.stl")
    file = tmp_path / "arm" / "urdf" / "arm.urdf"
    file.write_text(ROBOT)
    scene = Scene.read(file)
    assert scene.names == ("base", "arm")
    assert scene["base"].albedo == pytest.approx(0.2126)
    np.testing.assert_allclose(sorted(set(np.asarray(scene["arm"].albedo).tolist())), [0.5, 0.8])
    pose = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0.05], [0, 0, 0, 1]])
    np.testing.assert_allclose(scene["arm"].pose, pose, atol=1e-7)
    across = np.asarray(scene["arm"].mesh.vertices)[:, 1:]
    np.testing.assert_allclose(np.ptp(across, axis=0), [0.08, 0.6], atol=1e-4)  # the plate's x is the link's −z
    assert Scene.read(file, albedo=0.3)["arm"].albedo == 0.3


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<box size", "<blob size", "link 'base': geometry <blob> is unknown: there are box"),
        ('"package://arm/meshes/tip.stl"', '"tip.dae"', r"link 'arm': there is no mesh 'tip\.dae'"),
        (".2 .2 .1", ".2 -.2 .1", "link 'base': 'size_m' must be 3 positive numbers"),
        (
            '<link name="arm">',
            '<link name="base"/><link name="arm">',
            "link 'base': there is another link of this name",
        ),
        (".2 .2 .1", ".2 .2", "link 'base': size of <box> must be 3 numbers, got '.2 .2'"),
        ('<child link="arm"/>', '<child link="hand"/>', "joint 'j': joins 'hand', which is no link of the robot"),
        ('<child link="arm"/>', '<child link="base"/>', "form a ring"),
        ("robot name", "model name", "is not XML"),
        (
            '<robot name="arm">',
            '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="arm"><xacro:a/>',
            "expand them first, with xacro",
        ),
    ],
)
def test_what_is_wrong_with_a_urdf_is_named(tmp_path, old, new, message):
    file = tmp_path / "arm.urdf"
    assert old in ROBOT
    file.write_text(ROBOT.replace(old, new).replace('<blob size=".2 .2 .1"/>', "<blob/>"))
    with pytest.raises(InputFileError, match=message) as caught:
        Scene.read(file)
    assert "\n" not in str(caught.value)
