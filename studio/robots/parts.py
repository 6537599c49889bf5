"""The parts of a design, named after the links that are made from them; and a model that shows them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np
from manifold3d import Manifold, Mesh64

from morph_core.tasks.printed import DENSITY, Inertial, Moments
from studio.robots import geometry
from studio.robots.geometry import Drilled
from studio.robots.stl import stl

STL_FOLDER = "parts"
BASE = "base"
"""The name of the link that stands still, as in the URDF."""
COLLISION_GROUP, VISUAL_GROUP = 3, 2
"""Groups of geoms: viewers show 0 to 2 unless told otherwise."""
MILLIMETRE = 0.001  # m
SKIN = 0.8
"""mm: thickness of a print's walls, top and bottom: two lines of a .4 mm nozzle, four layers of .2 mm."""


@dataclass(frozen=True)
class Part:
    """One part, in the frame of its link."""

    name: str
    """The name of the part's files: that of the first link that is made from it."""
    links: tuple[str, ...]
    """Every link that is made from the part."""
    vertices: np.ndarray  # (V, 3) mm
    faces: np.ndarray  # (F, 3)
    density: float = DENSITY
    """kg/m^3: the part's mass over its volume; of one that is not printed solid, less than what it is made of."""
    drilled: Drilled | None = field(default=None, repr=False)
    """The part as it was drawn, where it was."""

    @property
    def quantity(self) -> int:
        """Number of copies of the part that the robot needs."""
        return len(self.links)

    @property
    def size(self) -> np.ndarray:
        """Size (3,) of the box round the part, in mm along the axes of its link."""
        return np.ptp(self.vertices, axis=0)

    @property
    def infill(self) -> float:
        """Share of the material behind a skin of `SKIN` mm with which the printed part has its mass."""
        corners = self.vertices[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        volume, skin = self.moments.volume / MILLIMETRE**3, SKIN * float(np.linalg.norm(normals, axis=1).sum()) / 2
        return (self.density / DENSITY * volume - skin) / (volume - skin)

    @cached_property
    def moments(self) -> Moments:
        """Integrals over the part's volume, in metres."""
        return geometry.moments(self.vertices, self.faces).scaled(MILLIMETRE)

    @property
    def inertial(self) -> Inertial:
        """Mass properties of the part in the frame of its link, in SI units."""
        return self.moments.inertial(self.density)

    @cached_property
    def solid(self) -> Manifold:
        """The body in the frame of its link, in mm."""
        return Manifold(Mesh64(self.vertices, self.faces.astype(np.uint64)))

    @property
    def stl_path(self) -> str:
        """Path of the part's STL file in a bundle."""
        return f"{STL_FOLDER}/{self.name}.stl"


def parts_of(drawn: Mapping[str, Drilled], masses: Mapping[str, float]) -> list[Part]:
    """Return one part for each distinct drawing, by the names of the links; equal ones come from the same cache.

    `masses` are what links weigh in the simulation (kg); a link without one is solid.
    """
    links: dict[int, list[str]] = {}
    for name, drilled in drawn.items():
        links.setdefault(id(drilled), []).append(name)
    parts: list[Part] = []
    for names in links.values():
        drilled = drawn[names[0]]
        density = masses[names[0]] / (drilled.solid.volume() * MILLIMETRE**3) if names[0] in masses else DENSITY
        parts.append(Part(names[0], tuple(names), *geometry.mesh(drilled.solid), density, drilled))
    return parts


def stl_files(parts: Sequence[Part]) -> dict[str, bytes]:
    """Return the parts' STL files by path."""
    return {part.stl_path: stl(part.vertices, part.faces, f"{part.name}, millimetres") for part in parts}


def link_names(model: mujoco.MjModel) -> list[str]:
    """Return what the bodies of a model are called as links: unique, never empty; the world's is `BASE`."""
    names: list[str] = []
    for i in range(model.nbody):
        name = BASE if i == 0 else model.body(i).name or f"body_{i}"
        names.append(free_name(name, set(names)))
    return names


def free_name(name: str, taken: set[str]) -> str:
    """Return `name`, with a number behind it if it is taken."""
    number, free = 2, name
    while free in taken:
        free, number = f"{name}_{number}", number + 1
    return free


def body_of(model: mujoco.MjModel, link: str) -> int:
    """Return the index of the body that is called `link`; ValueError lists the links if there is none."""
    names = link_names(model)
    if link not in names:
        raise ValueError(f'the robot has no link "{link}"; it has: {", ".join(names)}')
    return names.index(link)


def colours_of(model: mujoco.MjModel, parts: Sequence[Part]) -> dict[str, np.ndarray]:
    """Return link -> red, green, blue, opacity (4,) of its first collision shape."""
    return {link: model.geom_rgba[model.body_geomadr[body_of(model, link)]] for part in parts for link in part.links}


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
