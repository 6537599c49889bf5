"""Write NAME.step (mm) beside each NAME.npz of a folder: a solid of plane faces, those in one plane made one."""

import sys
from pathlib import Path

import numpy as np
from build123d import Face, Shell, Solid, Wire, export_step  # pyright: ignore[reportMissingImports]

for path in sorted(Path(sys.argv[1]).glob("*.npz")):
    with np.load(path, allow_pickle=False) as arrays:
        corners = arrays["vertices"][arrays["faces"]]
    faces = [Face(Wire.make_polygon([tuple(point) for point in triangle])) for triangle in corners.tolist()]
    solid = Solid(Shell(faces)).clean()
    if not solid.is_valid:
        raise SystemExit(f"{path.stem} is no valid solid")
    solid.label = path.stem
    export_step(solid, path.with_suffix(".step"))
