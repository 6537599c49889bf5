"""Parts as STEP files, by build123d in a process of its own: it is large, slow to load, and optional."""

import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from studio.export.errors import ExportError
from studio.robots.parts import Part

TIMEOUT = 300.0  # s
_WORKER = Path(__file__).parent / "shipped" / "write_step.py"


def step_files(parts: Sequence[Part], python: str = sys.executable) -> dict[str, bytes]:
    """Return step/NAME.step of each part; raise ExportError where build123d is missing or fails."""
    if python == sys.executable and importlib.util.find_spec("build123d") is None:
        raise ExportError('the format step needs build123d: pip install "morph-studio[cad]"')
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in parts:
            np.savez(folder / f"{part.name}.npz", vertices=part.vertices, faces=part.faces)
        try:
            done = subprocess.run(
                [python, "-P", str(_WORKER), str(folder)], capture_output=True, text=True, timeout=TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise ExportError(f"build123d took longer than {TIMEOUT:g} s") from error
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise ExportError(f"build123d could not write STEP: {reason}")
        return {f"step/{part.name}.step": (folder / f"{part.name}.step").read_bytes() for part in parts}
