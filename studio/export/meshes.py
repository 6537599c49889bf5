"""Parts as mesh files beside STL: 3MF in millimetres for printing, one GLB of the assembly in metres for looking at."""

from collections.abc import Mapping, Sequence
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
BETWEEN_COPIES = 10.0  # mm on the print bed


def three_mf(part: Part) -> bytes:
    """Return a 3MF with the part once as an object, and as many copies on the bed as the robot needs."""
    name, links = escape(part.name, {'"': "&quot;"}), escape(", ".join(part.links))
    step = float(part.size[1]) + BETWEEN_COPIES
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<model unit="millimeter" xml:lang="en-US" xmlns="{_CORE}">',
        f'<metadata name="Title">{name}</metadata>',
        f'<metadata name="Description">print {part.quantity}: {links}</metadata>',
        f'<resources><object id="1" type="model" name="{name}"><mesh><vertices>',
        *(f'<vertex x="{x!r}" y="{y!r}" z="{z!r}"/>' for x, y, z in part.vertices.tolist()),
        "</vertices><triangles>",
        *(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in part.faces.tolist()),
        "</triangles></mesh></object></resources><build>",
        *(f'<item objectid="1" transform="1 0 0 0 1 0 0 0 1 0 {i * step!r} 0"/>' for i in range(part.quantity)),
        "</build></model>",
    ]
    text = "\n".join(lines).encode()
    return zipped(
        {"[Content_Types].xml": _TYPES.encode(), "_rels/.rels": _RELATIONS.encode(), "3D/3dmodel.model": text}
    )


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
