"""Whether an exported hand does its task wherever MuJoCo is: success over fresh starts, here and in other interpreters.

`--beside PATH/python` names an interpreter that has numpy and a MuJoCo of its own, such as 3.10; several may be given.
"""

import json
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from morph_core.catalogue import make_task
from morph_core.tasks.grasp import GraspTask
from studio.export.design_file import phi_for, read_design
from studio.show.hand import rule_of


@dataclass(frozen=True)
class ExportedPolicy:
    """Which export, and who runs it."""

    bundle: tyro.conf.Positional[Path]
    """Zip of an exported hand with its policy."""
    episodes: int = 256
    seed: int = 12345
    beside: list[Path] = field(default_factory=list)
    """Other interpreters."""


def main(options: ExportedPolicy) -> None:
    """Draw starts as the task does, and let each interpreter play them with the files of the export."""
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(options.bundle) as archive:
        archive.extractall(folder)
        design = read_design(options.bundle.read_bytes())
        task = make_task(design.task, design.task_options)
        assert isinstance(task, GraspTask), "the task's rule is known for hands alone"
        starts = task.reset(
            task.hw_phy(phi_for(design, task.name, task.design_space)),
            options.episodes,
            np.random.default_rng(options.seed),
        )
        np.savez(Path(folder) / "starts.npz", starts=starts, rule=json.dumps(rule_of(task), default=list))
        program = Path(__file__).with_name("exported_episodes.py")
        for python in [Path(sys.executable), *options.beside]:
            subprocess.run([python, program, folder], check=True)


if __name__ == "__main__":
    main(tyro.cli(ExportedPolicy))
