"""Files of a robot, compared without a folder at hand."""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco

from studio.export.archive import unpack
from studio.export.check import Check
from studio.export.verify import verify_folder


def verify(files: Mapping[str, bytes], model: mujoco.MjModel | None = None, **how: Any) -> list[Check]:
    """Do as `verify_folder` with files that are laid out in a folder for as long as it takes."""
    with tempfile.TemporaryDirectory() as name:
        unpack(files, Path(name))
        return verify_folder(Path(name), files, model, **how)
