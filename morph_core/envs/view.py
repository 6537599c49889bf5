"""Pictures of a task's scene with one design, from a camera that stands still."""

import mujoco
import numpy as np

from morph_core.geoms import Geoms
from morph_core.picture import Camera, Light, Surface, draw
from morph_core.task import Hardware, Task

WIDTH, HEIGHT = 640, 480
_OBLIQUE, _ABOVE = np.array([0.55, -1.0, 0.5]), np.array([0.0, 0.0, 1.0])
"""From the middle of the scene to the camera, where there is height and where there is none."""
_FLAT = 0.25
"""A scene is flat where its height is less than this share of its shorter side."""
_AIR = 0.1
"""Margin beyond each side of a flat scene, as a share of it: arms swing out of the box in which they start."""
_LAMP = np.array([-0.35, -0.5, 0.8])
"""From the middle of the scene to the lamp."""
_AMBIENT = 0.6
_SHADOW = 0.8
"""Share of its colour that a plane keeps where it lies in the shadow."""
_LIFT = 1e-4
"""m: a shadow is drawn this far above its plane."""
_BACKGROUND = np.array([247, 247, 249])


class View:
    """A camera on one design's scene. It frames the start and, where something is to be lifted, the way up."""

    def __init__(self, task: Task, phi: np.ndarray, hw_phy: Hardware, width: int = WIDTH, height: int = HEIGHT) -> None:
        self._task = task
        self._geoms = Geoms.of(task.scene(phi).compile())
        start = task.qpos(task.reset(hw_phy, 1, np.random.default_rng(0)))[0]
        low, high = _framed(self._geoms, start)
        size = high - low
        flat = size[2] < _FLAT * min(size[:2])
        low, high = (low - _AIR * size, high + _AIR * size) if flat else (low, high)
        corners = np.stack(np.meshgrid(*np.stack([low, high], 1)), -1).reshape(-1, 3)
        self._camera = Camera.framing(corners, _ABOVE if flat else _OBLIQUE, width, height)
        self._light = Light(self._camera.axes @ _LAMP, _AMBIENT)

    def on_clear_ground(self, s: np.ndarray) -> np.ndarray:
        """Return red, green, blue and opacity (height, width, 4) uint8 at one state s (state_size,)."""
        surfaces = self._geoms.at(self._task.qpos(s[None])[0])
        return draw([*surfaces, *self._shadows(surfaces)], self._camera, self._light)

    def frame(self, s: np.ndarray) -> np.ndarray:
        """Return the picture (height, width, 3) uint8 at one state s (state_size,)."""
        image = self.on_clear_ground(s).astype(float)
        opacity = image[..., 3:] / 255
        return np.round(opacity * image[..., :3] + (1 - opacity) * _BACKGROUND).astype(np.uint8)

    def _shadows(self, surfaces: list[Surface]) -> list[Surface]:
        """Return what lies in the shadow of the rest, on every level plane."""
        planes = self._geoms.are_planes
        lit = np.concatenate([t for (t, _), plane in zip(surfaces, planes, strict=True) if not plane])
        normals = np.cross(lit[:, 1] - lit[:, 0], lit[:, 2] - lit[:, 0])
        lit = lit[normals @ _LAMP > 0]
        shadows = []
        for (plane, colour), is_plane in zip(surfaces, planes, strict=True):
            level = plane[0, 0, 2]
            if is_plane and np.ptp(plane[..., 2]) < 1e-9:
                above = lit[lit[..., 2].min(1) > level]
                fallen = above - (above[..., 2:] - level) / _LAMP[2] * _LAMP
                shadows.append((fallen + _ABOVE * _LIFT, _SHADOW * colour))
        return shadows


def _framed(geoms: Geoms, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two corners (3,) of a box round all that is no plane, and the room above that lifting needs."""
    model = geoms.model
    boxes = np.array([[t.min((0, 1)), t.max((0, 1))] for t, _ in geoms.at(start)])  # (n, 2, 3)
    bodies = model.geom_bodyid[list(geoms.ids)]
    root = model.body_rootid[bodies]
    fixed = model.body_weldid[bodies] == 0
    loose = ~fixed & np.isin(root, model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE])
    solid = ~np.array(geoms.are_planes)
    low, high = boxes[solid, 0].min(0), boxes[solid, 1].max(0)
    robot, goal = solid & ~fixed & ~loose, solid & fixed
    if loose.any() and robot.any() and goal.any():
        high[2] = max(high[2], boxes[goal, 1, 2].max() + boxes[robot, 1, 2].max() - boxes[loose, 1, 2].max())
    return low, high
