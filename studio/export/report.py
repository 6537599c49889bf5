"""report.html: what a person who opens the bundle wants to know, on one page."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from morph_core.protocol import Evaluation
from morph_core.what_if import wilson_interval
from studio.export.design_file import Design, Value
from studio.export.loading import LOADINGS, POLICY_LOADINGS, Loading
from studio.export.policy import Score
from studio.export.ros import package_name
from studio.export.views import GAP, Label, View, Views
from studio.robots.parts import Part
from studio.robots.robot import Program, Robot
from studio.units import unit_of

_STYLE = Path(__file__).parent / "shipped" / "report.css"
_RADIUS = 13
"""Radius of a label's ring, in pixels of the picture."""
_CM = 100.0
"""Centimetres per metre."""


@dataclass(frozen=True)
class Section:
    """A heading of the page and what stands below it, as HTML."""

    title: str
    html: str


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """All that the page tells."""

    title: str
    """The task in words."""
    design: Design
    robot: Robot
    parts: Sequence[Part]
    views: Views | None
    """Pictures of the robot; None for a robot without a shape that has a volume."""
    formats: Sequence[str]
    """Formats that the bundle holds, with "onnx" where it holds policy.onnx."""
    scores: Sequence[Score]
    recorded: Evaluation | None
    """What training has measured of this design, where it has."""
    episodes: int | None
    """Number of episodes of what training has measured, where it is known."""
    program: Program | None
    """Program that runs the policy; None where the bundle holds none."""
    no_onnx: str = ""
    """Why a bundle with a policy holds no policy.onnx."""
    more: Sequence[Section] = ()
    """What others have to say, between the parts and how the robot is loaded."""


def report(sheet: Sheet) -> bytes:
    """Return the page; everything in it that came from a run is escaped, and nothing in it is loaded from elsewhere."""
    design = sheet.design
    sections = [
        Section("The robot", _pictures(sheet)),
        Section("Design φ", _phi(design.parameters)),
        Section("Success", _success(sheet)),
        Section("Parts to print" if sheet.robot.printed else "Parts", _parts(sheet)),
        *sheet.more,
        Section("Load it", _loading(sheet)),
        Section("Run the policy", _policy(sheet)),
        Section("Check it", _CHECK),
    ]
    body = "\n".join(f"<section><h2>{escape(s.title)}</h2>\n{s.html}</section>" for s in sections)
    page = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<title>{escape(design.task)}, iteration {design.iteration}: {escape(design.run)}</title>
<style>
{_STYLE.read_text(encoding="utf-8").strip()}
</style>
<header>
<h1>{escape(sheet.title)}</h1>
<p class=dim>Design “{escape(design.design)}”, iteration {design.iteration} of run {escape(design.run)}
{_facts(sheet)}
</header>
<main>
{body}
</main>
</html>
"""
    return page.encode()


_CHECK = """<p>All files were read back and compared with the simulated robot before they were offered. To do so again:
<pre>morph-studio verify THIS_BUNDLE</pre>
<p class=dim>Run, settings, versions and commands behind this design: provenance.json"""


def _facts(sheet: Sheet) -> str:
    """Return the few numbers that are looked for first."""
    facts = []
    if bars := _bars(sheet):
        best = max(bars, key=lambda bar: bar.episodes or 0)
        facts.append(("Success", _percent(best.share, 0), best.about))
    if sheet.views is not None:
        size = " × ".join(f"{_CM * length:.{int(length < 0.1)}f}" for length in sheet.views.size)
        facts.append(("Size at the start", f"{size} cm", "width × depth × height"))
    if sheet.parts:
        mass = sum(part.quantity * part.inertial.mass for part in sheet.parts)
        total, kinds = sum(part.quantity for part in sheet.parts), len(sheet.parts)
        facts.append(
            ("Mass of the parts", f"{1000 * mass:,.0f} g" if mass < 10 else f"{mass:,.1f} kg", "without what is bought")
        )
        facts.append(("Parts", f"{total}", "all alike" if kinds == 1 else f"{kinds} different ones"))
    facts.append(("Design parameters", f"{len(sheet.design.parameters)}", _locked(sheet.design.parameters)))
    cells = "".join(
        f"<div><dt>{name}<dd>{escape(value)} <small>{escape(about)}</small></div>" for name, value, about in facts
    )
    return f"<dl class=facts>{cells}</dl>"


def _locked(parameters: Sequence[Value]) -> str:
    locked = sum(p.locked_at is not None for p in parameters)
    return f"{locked} locked" if locked else "all free"


# --- the robot ---


def _pictures(sheet: Sheet) -> str:
    if sheet.views is None:
        return "<p>No picture: the robot's model has no shape with a volume."
    views = sheet.views
    sides = "".join(_figure(view, _scale(views, view)) for view in views.sides)
    return f"""<div class=views>{_figure(views.oblique)}<div>{sides}</div></div>
<p class="dim small">At the start of an episode. The three small ones are to one scale, which their bars show.
{_exploded(sheet, views)}"""


def _figure(view: View, beside: str = "") -> str:
    return (
        f'<figure><div class=sheet><img alt="the robot {view.caption}" width={view.width} height={view.height} '
        f'src="{view.image}"></div><figcaption>{view.caption}{beside}</figcaption></figure>'
    )


def _scale(views: Views, view: View) -> str:
    width = 100 * views.bar_pixels / view.width
    return f'<span class=scale style="width:{width:.2f}%">{_length(views.bar)}<i></i></span>'


def _length(metres: float) -> str:
    return f"{metres:g} m" if metres >= 1 else f"{_CM * metres:g} cm"


def _exploded(sheet: Sheet, views: Views) -> str:
    """Return the picture with the parts apart, its labels, and the names that belong to them."""
    view = views.exploded
    masses = {link: 1000 * part.inertial.mass for part in sheet.parts for link in part.links}
    rings = "".join(_ring(number, label) for number, label in enumerate(views.labels, 1))
    names = "".join(
        f"<li><b>{number}</b>{escape(label.link)}<span>{masses[label.link]:,.1f} g</span>"
        for number, label in enumerate(views.labels, 1)
    )
    alt = escape("the parts drawn apart: " + ", ".join(label.link for label in views.labels), quote=True)
    return f"""<figure class=exploded>
<div class=sheet><svg viewBox="{-GAP} 0 {view.width + 2 * GAP} {view.height}" role=img aria-label="{alt}">
<image href="{view.image}" width="{view.width}" height="{view.height}"/>{rings}</svg></div>
<div><h3>Its parts</h3><ol class=names>{names}</ol></div></figure>"""


def _ring(number: int, label: Label) -> str:
    (x, y), (u, v) = label.at, label.beside
    return (
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{u:.1f}" y2="{v:.1f}"/>'
        f'<circle class=middle cx="{x:.1f}" cy="{y:.1f}" r="3.5"/>'
        f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{_RADIUS}"/><text x="{u:.1f}" y="{v:.1f}">{number}</text>'
    )


# --- the design and its success ---


def _phi(parameters: Sequence[Value]) -> str:
    rows = []
    for p in parameters:
        unit = unit_of(p)
        between = _range(p.lo, p.hi, at=p.value, mark=p.initial)
        bounds = f"<span class=bounds>{unit.number(p.lo)}{between}{unit.words(p.hi)}</span>"
        locked = "" if p.locked_at is None else " <span class=dim>locked</span>"
        value = f"<b>{escape(unit.words(p.value))}</b>"
        rows.append([escape(p.name) + locked, value, bounds, escape(unit.words(p.initial))])
    headings = ("parameter", "value", "bounds in force", "initial")
    return (
        _table(headings, rows, numbers={1, 3}, graphic=2)
        + "<p class='dim small'>Dot: the value. Stroke: the initial design. All digits: design.json"
    )


def _range(
    lo: float, hi: float, *, at: float, mark: float | None = None, span: tuple[float, float] | None = None
) -> str:
    """Return a value between two bounds as a line with a dot; `mark` is a stroke across it, `span` a bar along it."""

    def share(value: float) -> float:
        return 100 * float(np.clip((value - lo) / (hi - lo), 0, 1)) if hi > lo else 50.0

    bar = f'<i style="left:{share(span[0]):.2f}%;width:{share(span[1]) - share(span[0]):.2f}%"></i>' if span else ""
    stroke = "" if mark is None else f'<s style="left:{share(mark):.2f}%"></s>'
    return f'<span class=range>{bar}{stroke}<b style="left:{share(at):.2f}%"></b></span>'


@dataclass(frozen=True)
class _Bar:
    """A share of successful episodes."""

    of: str
    share: float
    episodes: int | None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The interval of the share at 95 %; None where nobody knows of how many episodes it is."""
        return wilson_interval(round(self.share * self.episodes), self.episodes) if self.episodes else None

    @property
    def about(self) -> str:
        """Number of episodes and interval, in words."""
        if not self.interval or not self.episodes:
            return "of how many episodes is not known"
        low, high = self.interval
        return f"of {self.episodes} episodes; {_percent(low, 0)} to {_percent(high, 0)}"


def _bars(sheet: Sheet) -> list[_Bar]:
    bars = []
    if sheet.recorded:
        bars.append(_Bar("in training, sampled", sheet.recorded.sampled_success, sheet.episodes))
        bars.append(_Bar("in training, mean", sheet.recorded.deterministic_success, sheet.episodes))
    bars += [_Bar("these files, sampled", s.success, s.episodes) for s in sheet.scores if s.where == "at export"]
    return bars


def _percent(share: float, digits: int = 1) -> str:
    return f"{100 * share:.{digits}f}\N{NO-BREAK SPACE}%"


def _success(sheet: Sheet) -> str:
    bars = _bars(sheet)
    if not bars:
        return "<p>Not measured: the run holds neither an evaluation nor a policy of this design."
    rows = []
    for bar in bars:
        low, high = bar.interval or (bar.share, bar.share)
        said = (
            f"of {bar.episodes} episodes; 95\N{NO-BREAK SPACE}%: {_percent(low)} to {_percent(high)}"
            if bar.interval
            else bar.about
        )
        graphic = _range(0, 1, at=bar.share, span=(low, high))
        shown = f"<span class=bounds>0{graphic}100\N{NO-BREAK SPACE}%</span><span class='dim small'>{said}</span>"
        rows.append([escape(bar.of), f"<b>{_percent(bar.share)}</b>", shown])
    table = _table(("policy", "success", "with its interval"), rows, numbers={1}, graphic=2)
    milestones = sheet.recorded.milestones if sheet.recorded else {}
    before = ", ".join(f"{escape(name)} {_percent(share, 0)}" for name, share in milestones.items())
    return table + (f"<p>On the way, of the sampled policy's episodes in training: {before}." if before else "")


# --- its parts ---


def _parts(sheet: Sheet) -> str:
    if not sheet.parts:
        return "<p>None: the robot's model has no shape with a volume."
    rows = [
        [
            escape(part.name), str(part.quantity), f"{1000 * part.inertial.mass:,.1f}",
            *([_percent(part.infill, 0)] * sheet.robot.printed),
            " × ".join(f"{length:.1f}" for length in part.size), escape(", ".join(part.links)),
        ]
        for part in sheet.parts
    ]  # fmt: skip
    infill = ["infill"] * sheet.robot.printed
    heads = ("part", "quantity", "g each", *infill, "size in mm", "links")
    table = _table(heads, rows, numbers={1, 2, 3, 3 + len(infill)})
    return f"{table}\n{sheet.robot.about_parts}"


# --- how it is used ---


def _loading(sheet: Sheet) -> str:
    return f"<div class=tools>{''.join(_tool(tool, sheet) for tool in LOADINGS)}</div>"


def _tool(tool: Loading, sheet: Sheet) -> str:
    size = len(sheet.program.sees) if sheet.program else 0
    text = tool.text(sheet.design.robot, package_name(sheet.design.task), size)
    lacks = "" if tool.needs in sheet.formats else f"Not in this bundle: export it with the format {tool.needs}."
    notes = " ".join(filter(None, (lacks, tool.note.replace("{robot}", sheet.design.robot), tool.untried)))
    marked = re.sub(r"`(.+?)`", r"<code>\1</code>", escape(notes))
    said = f"<p class='dim small'>{marked}" if notes else ""
    return f"<h3>{escape(tool.tool)}</h3><div><pre>{escape(text)}</pre>{said}</div>"


def _policy(sheet: Sheet) -> str:
    program = sheet.program
    if program is None:
        return "<p>No policy: the run holds none of this design, or the export left out mjcf, in which it runs."
    about = "".join(f"<p class=dim>{escape(line)}" for line in program.about)
    ways = "".join(_tool(way, sheet) for way in POLICY_LOADINGS if way.needs in sheet.formats)
    entries = [
        [str(i), *map(escape, seen), *map(escape, given)]
        for i, (seen, given) in enumerate(_paired(program.sees, program.gives))
    ]
    table = _table(("entry", "observation", "unit", "action", "unit"), entries, numbers={0})
    missing = f"<p>No policy.onnx: {escape(sheet.no_onnx)}" if sheet.no_onnx else ""
    return f"""<p>With numpy and mujoco alone:
<pre>{escape(program.command)}</pre>{about}
<p>As a function, from what is measured to what is commanded, in physical units; it is the policy's mean:
<div class=tools>{ways}</div>{missing}
<details><summary>What its entries are</summary>{table}</details>"""


def _paired(sees: Sequence[tuple[str, str]], gives: Sequence[tuple[str, str]]) -> Iterable[tuple]:
    """Return both side by side; the shorter one is filled up with nothing."""
    length, nothing = max(len(sees), len(gives)), ("", "")
    return zip([*sees, *[nothing] * (length - len(sees))], [*gives, *[nothing] * (length - len(gives))], strict=True)


def _table(headings: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: set[int], graphic: int = -1) -> str:
    """Return a table of cells that are HTML; the columns of `numbers` are flush right, `graphic` takes what is left."""

    def kind(column: int) -> str:
        return " class=n" if column in numbers else " class=graphic" if column == graphic else ""

    head = "".join(f"<th{kind(i)}>{heading}" for i, heading in enumerate(headings))
    body = "".join("<tr>" + "".join(f"<td{kind(i)}>{cell}" for i, cell in enumerate(row)) for row in rows)
    full = " class=full" if graphic >= 0 else ""
    return f"<div class=wide><table{full}><thead><tr>{head}<tbody>{body}</table></div>"
