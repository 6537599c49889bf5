"""Draw learning curves of studies: `python tests/bench/curves.py --out docs/hands.svg Pen=DIR,DIR Mouse=DIR`.

One panel for each name before a `=`, from the folders of studies of one task; success of the sampled policy on Hw-Phy
with the present phi over the steps of the simulation, relabelling and search counted: a line per seed, and a thick one
for their median while all of them run.
"""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import tyro

from morph_core.history import History
from morph_core.run_folder import RunFolder
from studio.study.plan import read_study

mpl.use("svg")
import matplotlib.pyplot as plt

COLOURS = {"morph": "#0f7dc2", "direct": "#e07b00", "no_hw_opt": "#7a828e"}


@dataclass(frozen=True)
class Curves:
    """What to draw."""

    panels: tyro.conf.Positional[tuple[str, ...]]
    """TITLE=DIR,DIR,... with the folders of one or more studies."""
    out: Path = Path("curves.svg")


def curve(history: History) -> np.ndarray:
    """Return (n, 2): million steps of the simulation, and success in percent, at each evaluation."""
    steps = {p.iteration: p.env_steps + p.relabelled_steps + p.search_steps for p in history.progress}
    evaluations = [e for e in history.evaluations if not e.final]
    return np.array([(steps[e.iteration] / 1e6, 100 * e.sampled_success) for e in evaluations])


def draw(axes: Any, title: str, curves: dict[str, list[np.ndarray]]) -> None:
    for method, some in curves.items():
        colour = COLOURS.get(method, "black")
        for one in some:
            axes.plot(*one.T, color=colour, alpha=0.35, linewidth=0.8)
        grid = np.linspace(max(c[0, 0] for c in some), min(c[-1, 0] for c in some), 200)
        median = np.median([np.interp(grid, *one.T) for one in some], axis=0)
        axes.plot(grid, median, color=colour, linewidth=2.2, label=f"{method}, {len(some)} seeds")
    axes.set(title=title, xlabel="steps of the simulation [million]", ylabel="episodes held [%]", ylim=(-2, 102))
    axes.grid(alpha=0.25)
    axes.legend(edgecolor="none", framealpha=0.85, loc="lower right", bbox_to_anchor=(1.0, 0.04), fontsize=8)


def read(folders: str) -> dict[str, list[np.ndarray]]:
    """Return the curves of all runs of some studies that have been evaluated, by the label of their method."""
    curves: dict[str, list[np.ndarray]] = defaultdict(list)
    for directory in map(Path, folders.split(",")):
        for planned in read_study(directory).runs:
            history = History(RunFolder(directory / planned.run))
            if history.evaluations:
                curves[planned.variant].append(curve(history))
    return curves


def main(options: Curves) -> None:
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "morph", "font.size": 9, "figure.facecolor": "white"})
    _, panels = plt.subplots(1, len(options.panels), figsize=(3.6 * len(options.panels), 3.2), squeeze=False)
    for axes, panel in zip(panels[0], options.panels, strict=True):
        title, folders = panel.split("=", 1)
        draw(axes, title, read(folders))
    plt.tight_layout()
    plt.savefig(options.out, metadata={"Date": None})


if __name__ == "__main__":
    main(tyro.cli(Curves, description=__doc__))
