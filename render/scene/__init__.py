"""Scenes: bodies, their materials, a camera anywhere, and depth images of other programs (PHYSICS section 13)."""

from typing import TYPE_CHECKING

from phasemark.inputs import on_use

if TYPE_CHECKING:
    from phasemark.render.scene.body import Body
    from phasemark.render.scene.depth_zones import DepthZones, zones_from_depth
    from phasemark.render.scene.scene import Scene
    from phasemark.render.scene.scene_renderer import SceneRenderer
else:
    __getattr__, __dir__ = on_use.imported_on_use(__name__)

NEEDS_MUJOCO = "MuJoCo's models need the package mujoco: pip install -e '.[mujoco]' in the clone of phasemark"

__all__ = ["Body", "DepthZones", "Scene", "SceneRenderer", "zones_from_depth"]
