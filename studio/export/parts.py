"""The printed parts of a design, named after the links that are made from them; and a model that shows them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from manifold3d import Manifold

from morph_core.task import Task
from morph_core.tasks.grasp import GraspTask
from morph_core.tasks.printed import Inertial, Moments
from studio import geometry
from studio.export.errors import ExportError

STL_FOLDER = "parts"
BASE = "base"
"""The name of the link that stands still, as in the URDF."""
COLLISION_GROUP, VISUAL_GROUP = 3, 2
"""Viewers show the groups 0 to 2 unless told otherwise."""
MILLIMETRE = 0.001  # m


@dataclass(frozen=True)
class Part:
    """One printed part, in the frame of its link."""

    name: str
    """Of the first link that is made from it: the name of its files."""
    links: tuple[str, ...]
    """Every link that is made from it."""
    vertices: np.ndarray  # (V, 3) mm
    faces: np.ndarray  # (F, 3)

    @property
    def quantity(self) -> int:
        return len(self.links)

    @property
    def size(self) -> np.ndarray:
        """(3,) mm."""
        return np.ptp(self.vertices, axis=0)

    @property
    def moments(self) -> Moments:
        """In metres."""
        return geometry.moments(self.vertices, self.faces).scaled(MILLIMETRE)

    @property
    def inertial(self) -> Inertial:
        return self.moments.inertial()

    @property
    def stl_path(self) -> str:
        return f"{STL_FOLDER}/{self.name}.stl"


def printed_parts(task: Task, phi: np.ndarray) -> list[Part]:
    """Return the parts of a design, none for a task without printable geometry.

    Raise ExportError for a design that can't be put together.
    """
    try:
        task.check_buildable(phi)
    except ValueError as error:
        raise ExportError(str(error)) from error
    if isinstance(task, GraspTask):
        return _unique(_hand(task, phi))
    if task.name == "reacher":
        return _unique(_arm(phi))
    return []


def dress(spec: mujoco.MjSpec, parts: Sequence[Part], files: Mapping[str, bytes]) -> mujoco.MjSpec:
    """Return the robot, or a scene with it, showing its printed parts; collision shapes stay, in a group of their own.

    `files` holds the parts' STL files by path.
    """
    spec = spec.copy()
    # Only what is drawn: every mesh is read from the files as they are exported.
    spec.assets = {**spec.assets, **{part.stl_path: files[part.stl_path] for part in parts}}
    for part in parts:
        spec.add_mesh(name=part.name, file=part.stl_path, scale=[MILLIMETRE] * 3)
        for link in part.links:
            body = spec.worldbody if link == BASE else spec.body(link)
            own = [geom for geom in body.geoms if link != BASE or geom.name == BASE]
            for geom in own:
                geom.group = COLLISION_GROUP
            shown = body.add_geom(
                name=f"{link}_visual", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=part.name, group=VISUAL_GROUP, mass=0,
                rgba=own[0].rgba,
            )  # fmt: skip
            shown.contype = shown.conaffinity = 0
    return spec


def _hand(task: GraspTask, phi: np.ndarray) -> dict[str, Manifold]:
    n = task.fingers
    solids = {"palm": geometry.palm(tuple(float(a) for a in task.hand.base_angles + phi[:n]), task.servo)}
    for i, length in enumerate(phi[n:], start=1):
        solids[f"finger_{i}_proximal"] = geometry.link("proximal", float(length) / MILLIMETRE)
        solids[f"finger_{i}_distal"] = geometry.link("distal", float(length) / MILLIMETRE)
    return solids


def _arm(phi: np.ndarray) -> dict[str, Manifold]:
    last = len(phi)
    return {BASE: geometry.arm_base()} | {
        f"link_{i}": geometry.arm_link("distal" if i == last else "proximal", float(length) / MILLIMETRE)
        for i, length in enumerate(phi, start=1)
    }


def _unique(solids: Mapping[str, Manifold]) -> list[Part]:
    """Return one part for each distinct solid; equal ones come from the same cache."""
    links: dict[int, list[str]] = {}
    for name, solid in solids.items():
        links.setdefault(id(solid), []).append(name)
    return [Part(names[0], tuple(names), *geometry.mesh(solids[names[0]])) for names in links.values()]
