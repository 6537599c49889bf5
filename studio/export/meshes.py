"""Parts as mesh files beside STL: 3MF in millimetres for printing, one GLB of the assembly in metres for looking at."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from xml.sax.saxutils import escape

import mujoco
import numpy as np

from studio.export.archive import zipped
from studio.robots.parts import MILLIMETRE, Part, body_of

_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_RELATIONS = """\
<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
<Relationship Target="/3D/3dmodel.model" Id="rel0" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>
</Relationships>
"""
_TYPES = """\
<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">
<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>
<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>
</Types>
"""


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh as a 3MF holds it."""

    vertices: np.ndarray  # (V, 3) mm
    faces: np.ndarray  # (F, 3)

    @cached_property
    def xml(self) -> str:
        """The mesh in words, which are the same in the file of its part and on a plate."""
        lines = [
            "<mesh><vertices>",
            *(f'<vertex x="{x!r}" y="{y!r}" z="{z!r}"/>' for x, y, z in self.vertices.tolist()),
            "</vertices><triangles>",
            *(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in self.faces.tolist()),
            "</triangles></mesh>",
        ]
        return "\n".join(lines)


@dataclass(frozen=True)
class Body:
    """An object of a 3MF: a shape, and where its copies lie."""

    name: str
    shape: Shape
    poses: Sequence[np.ndarray]
    """Rotation and place (3, 4) mm of each copy on the bed."""


def three_mf(title: str, description: str, bodies: Sequence[Body]) -> bytes:
    """Return a 3MF in millimetres: each mesh once, in its own frame, and its copies as items of the build."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<model unit="millimeter" xml:lang="en-US" xmlns="{_CORE}">',
        f'<metadata name="Title">{_quoted(title)}</metadata>',
        f'<metadata name="Description">{_quoted(description)}</metadata>',
        "<resources>",
    ]
    for number, body in enumerate(bodies, start=1):
        lines.append(f'<object id="{number}" type="model" name="{_quoted(body.name)}">{body.shape.xml}</object>')
    lines.append("</resources><build>")
    for number, body in enumerate(bodies, start=1):
        for pose in body.poses:  # 3MF multiplies rows: the transposed rotation, then the place
            transform = " ".join(repr(x) for x in pose.T.ravel().tolist())
            lines.append(f'<item objectid="{number}" transform="{transform}"/>')
    lines.append("</build></model>")
    text = "\n".join(lines).encode()
    return zipped(
        {"[Content_Types].xml": _TYPES.encode(), "_rels/.rels": _RELATIONS.encode(), "3D/3dmodel.model": text}
    )


def _quoted(text: str) -> str:
    return escape(text, {'"': "&quot;"})


def glb(parts: Sequence[Part], model: mujoco.MjModel, colours: Mapping[str, np.ndarray]) -> bytes:
    """Return the assembly in the model's start posture, in metres, its nodes named like the links; y is up."""
    import trimesh  # slow to load, and a server must start fast
    from trimesh.exchange.gltf import export_glb
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    data = start_posture(model)
    scene = trimesh.Scene(base_frame="world")
    upright = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    for part in parts:
        for link in part.links:
            body = body_of(model, link)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
            mesh = trimesh.Trimesh(part.vertices * MILLIMETRE, part.faces, process=False)
            mesh.visual = TextureVisuals(
                material=PBRMaterial(
                    baseColorFactor=np.round(255 * colours[link]).astype(np.uint8), metallicFactor=0.0,
                    roughnessFactor=0.7,
                )
            )  # fmt: skip
            mesh.unmerge_vertices()  # sharp edges
            scene.add_geometry(mesh, node_name=link, geom_name=link, transform=upright @ pose)
    return export_glb(scene)


def start_posture(model: mujoco.MjModel) -> mujoco.MjData:
    """Return the model in its first keyframe, if it has one."""
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    return data
