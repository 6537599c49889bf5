"""The curves of a run, drawn with matplotlib: success, return, the proxy's agreement with the physics, and phi."""

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from morph_core.protocol import Evaluation, Parameter, Progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#a569ff", "#a53c1e", "#780ff0",
)  # fmt: skip
"""Colours that people with a colour blindness tell apart, on white and on dark ground: six of Okabe and Ito (2008), and
three that keep the largest distance from these and from one another."""
INK = "#1c2733"
"""Colour of text and axes."""
FAINT = "#8a929c"
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "font.size": 9,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.7,
    "figure.facecolor": "white",
    "axes.facecolor": "none",
    **{
        name: INK
        for name in ("text.color", "axes.edgecolor", "axes.labelcolor", "axes.titlecolor", "xtick.color", "ytick.color")
    },
}
"""How all figures look, as settings of matplotlib."""

_WIDTH, _HEIGHT = 9.6, 2.5
"""Inches: width of a figure, and height of a row of its panels."""
_COLUMNS = 2
Draw = Callable[[Any], None]


@dataclass(frozen=True, eq=False)
class Curves:
    """A figure that a notebook shows by itself."""

    figure: "Figure"
    """The figure of matplotlib, to be changed or saved: `curves.figure.savefig("run.pdf")`."""

    def _repr_svg_(self) -> str:
        import matplotlib as mpl

        written = io.StringIO()
        with mpl.rc_context(STYLE):
            self.figure.savefig(written, format="svg", metadata={"Date": None})
        return written.getvalue()


def draw_run(
    title: str, progress: Sequence[Progress], evaluations: Sequence[Evaluation], parameters: Sequence[Parameter]
) -> Curves:
    """Return a panel for each thing that was measured, over environment steps; what was never measured has none.

    Raise ImportError that names the extra where matplotlib is missing.
    """
    try:
        import matplotlib as mpl
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('curves need matplotlib: pip install "morph-studio[notebook]"') from error
    drawn = list(_panels(progress, evaluations, parameters))
    rows = -(-len(drawn) // _COLUMNS)
    unit, steps = (1e6, "million") if progress and progress[-1].env_steps >= 1e6 else (1e3, "thousand")
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(_WIDTH, 0.4 + _HEIGHT * rows), layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        for place, panel in enumerate(drawn):
            axes = figure.add_subplot(rows, _COLUMNS, place + 1)
            panel(axes)
            axes.xaxis.set_major_formatter(lambda value, _: f"{value / unit:g}")
            axes.set_xlabel(f"environment steps [{steps}]")
            axes.set_xlim(left=0)
            if axes.get_legend_handles_labels()[0]:
                axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7.5, handlelength=1.6)
    return Curves(figure)


def _panels(
    progress: Sequence[Progress], evaluations: Sequence[Evaluation], parameters: Sequence[Parameter]
) -> Iterator[Draw]:
    yield lambda axes: _success(axes, progress, evaluations)
    yield lambda axes: _return(axes, progress, evaluations)
    if any(p.cosine is not None for p in progress):
        yield lambda axes: _cosine(axes, progress)
    if any(p.divergence for p in progress):
        yield lambda axes: _divergence(axes, progress)
    for unit in dict.fromkeys(p.unit for p in parameters):
        yield lambda axes, unit=unit: _phi(axes, progress, parameters, unit)


def _success(axes: Any, progress: Sequence[Progress], evaluations: Sequence[Evaluation]) -> None:
    _line(axes, progress, "success", 100, label="in training", color=FAINT, linewidth=1)
    _line(axes, evaluations, "sampled_success", 100, label="sampled", color=COLOURS[0], marker="o", markersize=3)
    _line(axes, evaluations, "deterministic_success", 100, label="mean action", color=COLOURS[1], linestyle="--")
    axes.set(ylabel="success [% of episodes]", ylim=(-3, 103))


def _return(axes: Any, progress: Sequence[Progress], evaluations: Sequence[Evaluation]) -> None:
    _line(axes, progress, "episode_return", label="in training", color=FAINT, linewidth=1)
    _line(axes, evaluations, "sampled_return", label="sampled", color=COLOURS[0], marker="o", markersize=3)
    _line(axes, evaluations, "deterministic_return", label="mean action", color=COLOURS[1], linestyle="--")
    axes.set(ylabel="return [reward]")


def _cosine(axes: Any, progress: Sequence[Progress]) -> None:
    _line(axes, progress, "cosine", color=COLOURS[2])
    axes.axhline(0, color=FAINT, linewidth=1)
    axes.set(ylabel="cosine of g_task, g_hw", ylim=(-1.05, 1.05))


def _divergence(axes: Any, progress: Sequence[Progress]) -> None:
    _line(axes, progress, "divergence", label="divergence D", color=COLOURS[3])
    _line(axes, progress, "search_cost", label="search cost", color=INK, linestyle="--")
    axes.set(ylabel="mean squared distance", yscale="log")


def _phi(axes: Any, progress: Sequence[Progress], parameters: Sequence[Parameter], unit: str) -> None:
    steps = [0, *(p.env_steps for p in progress)]
    shown = [(i, p) for i, p in enumerate(parameters) if p.unit == unit]
    for place, (i, parameter) in enumerate(shown):
        values = [parameter.initial, *(p.phi[i] for p in progress)]
        axes.plot(steps, values, color=COLOURS[place % len(COLOURS)], label=parameter.name, drawstyle="steps-post")
    axes.set(ylabel=f"φ [{unit}]" if unit else "φ")


def _line(axes: Any, rows: Sequence[Progress | Evaluation], measure: str, factor: float = 1, **look: Any) -> None:
    """Draw one measure of iterations or evaluations over environment steps, where it was taken."""
    known = [(row.env_steps, factor * value) for row in rows if (value := getattr(row, measure)) is not None]
    if known:
        axes.plot(*zip(*known, strict=True), **look)
