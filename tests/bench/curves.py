"""Draw what `study.py --out` wrote: `python tests/bench/curves.py --out docs/hands.svg pen=pen_morph.jsonl,...`.

One panel for each name before a `=`; success of the sampled policy on Hw-Phy with the present phi over the steps of the
simulation, relabelling counted: a line per seed, and a thick one for their median while all of them run.
"""

import json
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import tyro

mpl.use("svg")
import matplotlib.pyplot as plt

COLOURS = {"morph": "#0f7dc2", "direct": "#e07b00", "no_hw_opt": "#7a828e"}


@dataclass(frozen=True)
class Curves:
    """What to draw."""

    panels: tyro.conf.Positional[tuple[str, ...]]
    """TITLE=FILE,FILE,... with the rows of one or more methods."""
    out: Path = Path("curves.svg")


def draw(axes: Any, title: str, rows: list[dict[str, Any]]) -> None:
    by_method: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        by_method[row["method"]].append(row)
    for method, some in by_method.items():
        colour = COLOURS.get(method, "black")
        curves = [np.array(row["curve"])[:, [0, 2]] * [1e-6, 100] for row in some]
        for curve in curves:
            axes.plot(*curve.T, color=colour, alpha=0.35, linewidth=0.8)
        grid = np.linspace(max(c[0, 0] for c in curves), min(c[-1, 0] for c in curves), 200)
        median = np.median([np.interp(grid, *curve.T) for curve in curves], axis=0)
        axes.plot(grid, median, color=colour, linewidth=2.2, label=f"{method}, {len(some)} seeds")
    axes.set(title=title, xlabel="steps of the simulation [million]", ylabel="episodes held [%]", ylim=(-2, 102))
    axes.grid(alpha=0.25)
    axes.legend(edgecolor="none", framealpha=0.85, loc="lower right", bbox_to_anchor=(1.0, 0.04), fontsize=8)


def main(options: Curves) -> None:
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "morph", "font.size": 9, "figure.facecolor": "white"})
    _, panels = plt.subplots(1, len(options.panels), figsize=(3.6 * len(options.panels), 3.2), squeeze=False)
    for axes, panel in zip(panels[0], options.panels, strict=True):
        title, files = panel.split("=", 1)
        draw(axes, title, [json.loads(row) for name in files.split(",") for row in Path(name).read_text().splitlines()])
    plt.tight_layout()
    plt.savefig(options.out, metadata={"Date": None})


if __name__ == "__main__":
    main(tyro.cli(Curves, description=__doc__))
