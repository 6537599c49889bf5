"""A MuJoCo model as MJCF text with exact numbers, and the mesh files it refers to."""

from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import mujoco

from studio.export.errors import ExportError


def write_mjcf(
    spec: mujoco.MjSpec, name: str, folder: str, files: Mapping[str, bytes] | None = None
) -> dict[str, bytes]:
    """Return {`name`: XML, `folder`/...: meshes} and leave the spec alone. Raise ExportError if it can't be built.

    Meshes that are in `files` already stay where they are.
    """
    spec, shared = spec.copy(), dict(files or {})
    # Numbers as authored (exact when read again); the compiled form is printed with seven digits.
    spec.compiler.savecompiled = False
    own: dict[str, bytes] = {}
    for i, mesh in enumerate(spec.meshes):
        if mesh.file and mesh.file not in shared:
            path = f"{folder}/{i}_{PurePosixPath(mesh.file).name}"
            own[path] = _mesh_file(spec, mesh.file)
            mesh.file = path
    spec.meshdir = ""
    try:
        spec.assets = {**shared, **own}
        spec.compile()
        return {name: spec.to_xml().encode(), **own}
    except (ValueError, mujoco.FatalError) as error:
        raise ExportError(f"MuJoCo can't build this design: {error}") from error


def _mesh_file(spec: mujoco.MjSpec, file: str) -> bytes:
    if file in spec.assets:
        return spec.assets[file]
    try:
        return (Path(spec.modelfiledir) / spec.meshdir / file).read_bytes()
    except OSError as error:
        raise ExportError(f"the mesh {file} can't be read: {error.strerror}") from error
