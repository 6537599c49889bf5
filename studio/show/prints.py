"""A hand's printed parts as pages draw any design from them: links whose shaft grows, and a palm put together."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeGuard

import manifold3d
import numpy as np
from manifold3d import Manifold

from morph_core.task import Task
from morph_core.tasks import hand
from morph_core.tasks.grasp import GraspTask
from studio.robots import geometry
from studio.robots.chooser import robot_of
from studio.viewer.figure import Mesh

LENGTH = 200.0
"""mm: length of the links whose meshes are carried; only their shaft, in the middle, grows with their length."""
_MOUNT = 40.0
"""mm: where on the palm the piece begins that carries a finger, and how wide it is."""

_SEEN = 0.4
"""Millimetres by which a surface that is drawn may differ from the one that is printed, less than a pixel of a page."""


def is_printed(task: Task) -> TypeGuard[GraspTask]:
    """Return whether the task's robot is a hand whose prints are known for any phi."""
    return isinstance(task, GraspTask) and type(task.hand) is hand.Hand


def surfaces(task: GraspTask) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return surfaces in mm: a palm without fingers, the piece of a palm that carries one at angle 0, and its links."""
    design = np.concatenate([np.zeros(task.hand.fingers), np.full(task.hand.fingers, LENGTH / 1000)])
    parts = {link: part for part in robot_of(task).parts(design) for link in part.links}
    mount = geometry.palm((0.0,), (geometry.SIZES.radius,)).solid
    for normal, distance in (((1, 0, 0), _MOUNT), ((0, 1, 0), -_MOUNT / 2), ((0, -1, 0), -_MOUNT / 2)):
        mount = mount.trim_by_plane(normal, distance)
    links = {kind: parts[f"finger_1_{kind}"] for kind in ("proximal", "distal")}
    return {
        "plate": geometry.mesh(geometry.palm((), ()).solid.simplify(_SEEN)),
        "mount": geometry.mesh(mount.simplify(_SEEN)),
        **{kind: lightened(part.vertices, part.faces) for kind, part in links.items()},
    }


def angles_of(task: GraspTask, phi: np.ndarray) -> tuple[float, ...]:
    """Return where on the palm the fingers of a design phi (d,) stand, in rad."""
    return tuple((task.hand.base_angles + phi[: task.hand.fingers]).tolist())


def lightened(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a surface (V, 3) mm with fewer faces, each of which takes a processor that draws time; one that is not
    closed stays as it is."""
    solid = Manifold(manifold3d.Mesh(vertices.astype(np.float32), faces.astype(np.uint32)))
    return geometry.mesh(solid.simplify(_SEEN)) if solid.status() is manifold3d.Error.NoError else (vertices, faces)


@dataclass(frozen=True)
class Shape:
    """What a part is drawn as: of the kinds of `Figure`, or a "link", a mesh that is stretched to the part's length."""

    name: str
    kind: str
    mesh: Mesh | None
    pose: np.ndarray
    """Position in m and orientation w, x, y, z at T instants, (T, 7)."""


@dataclass(frozen=True)
class Prints:
    """The printed parts of a hand, each in the frame of the collision shape that it is drawn in place of."""

    proximal: Mesh
    """Link with its ends at LENGTH / 2 above and below its middle."""
    distal: Mesh
    plate: Mesh
    mount: Mesh
    """The piece of the palm that carries a finger at angle 0, in the palm's frame as the plate is."""

    @classmethod
    def of(cls, task: GraspTask) -> "Prints":
        """Return the prints of a hand of which `is_printed` holds."""
        made = surfaces(task)
        link, palm = np.array([0, 0, LENGTH / 2]), np.array([0, 0, -1000 * hand.FINGER_RADIUS])

        def mesh(name: str, moved: np.ndarray) -> Mesh:
            vertices, faces = made[name]
            return Mesh(((vertices + moved) / 1000).astype(np.float32), faces.astype(np.uint32))

        return cls(mesh("proximal", link), mesh("distal", link), mesh("plate", palm), mesh("mount", palm))

    def shapes(self, name: str, pose: np.ndarray, angles: Sequence[float]) -> list[Shape]:
        """Return what the part of this name is drawn as where its collision shape is at `pose` (T, 7); nothing for a
        part that is not printed. Fingers stand on the palm at `angles` in rad."""
        if name == "palm":
            mounts = [Shape("mount", "mesh", self.mount, _turned(pose, angle)) for angle in angles]
            return [Shape(name, "mesh", self.plate, pose), *mounts]
        mesh = {"proximal": self.proximal, "distal": self.distal}.get(name.rpartition("_")[2])
        return [Shape(name, "link", mesh, pose)] if mesh else []


def _turned(pose: np.ndarray, angle: float) -> np.ndarray:
    """Return poses (T, 7) turned by an angle in rad about their own z."""
    (w, x, y, z), c, s = pose[:, 3:].T, np.cos(angle / 2), np.sin(angle / 2)
    return np.column_stack([pose[:, :3], w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s])
