"""How figures look: colours, lines and markers of the variants, and SVG that is small and takes a page's colours."""

import io
import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from morph_core.curves import COLOURS, INK, STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DASHES: tuple[object, ...] = ("-", (0, (5, 2)), (0, (1, 1.4)), (0, (5, 1.5, 1, 1.5)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
STANDARD = (
    "studio", "paper", "direct", "cmaes_rl", "paper,projection=none", "transform2act", "value_gradient",
    "paper,projection=as_printed", "no_hw_opt",
)  # fmt: skip
"""Variants that look the same in the report of every study, each in its own colour."""
DOTS_PER_INCH = 150
PIXELS_PER_POINT = 1.75
"""Scale of a figure in a page, where there is room for it."""
PAGE_WIDTH = 9.6
"""Width of a figure in inches."""

_SVG = "{http://www.w3.org/2000/svg}"
_HREF = "{http://www.w3.org/1999/xlink}href"
_PRESENTATION = re.compile(r"([\w-]+):\s*([^;]+)")
_OWN = frozenset({"d", "x", "y", "id", "href", "transform", "points", "opacity", "width", "height"})
_LONG = re.compile(r"-?\d+\.\d{2,}(?:e-?\d+)?")


Share = bool | Literal["none", "all", "row", "col"]
"""What panels have in common: an axis of all, of a row, of a column."""


@dataclass(frozen=True)
class Look:
    """How a variant is drawn in every figure."""

    colour: str
    dash: object
    marker: str


@dataclass(frozen=True)
class Drawing:
    """A figure, and what is said about it."""

    name: str
    """File name without its ending."""
    title: str
    caption: str
    figure: "Figure"


def looks(variants: Sequence[str]) -> dict[str, Look]:
    """Return the look of each variant: no two of 36 share colour and dash, nor colour and marker."""
    taken = {label: STANDARD.index(label) for label in variants if label in STANDARD}
    free = (place for place in itertools.count() if place not in taken.values())
    return {label: _look(taken[label] if label in taken else next(free)) for label in variants}


def _look(place: int) -> Look:
    again, number = divmod(place, len(COLOURS))
    return Look(COLOURS[number], DASHES[again % len(DASHES)], MARKERS[(number + again) % len(MARKERS)])


def new_figure(
    rows: int, columns: int, height: float, width: float = PAGE_WIDTH, sharex: Share = False, sharey: Share = False
) -> tuple["Figure", Any]:
    """Return a figure of axes (rows, columns), `height` inches high for each row."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    mpl.rcParams.update(STYLE)
    figure = Figure(figsize=(width, rows * height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey)


def save(drawing: Drawing, folder: Path, *, pixels: bool) -> str:
    """Write the figure as SVG and, with `pixels`, as PNG; return it as SVG for a page, in the colours of its text."""
    import matplotlib as mpl

    folder.mkdir(parents=True, exist_ok=True)
    engine = drawing.figure.get_layout_engine()
    if engine is not None:  # laid out once: each time costs as much as the drawing
        engine.execute(drawing.figure)
        drawing.figure.set_layout_engine(None)
    if pixels:
        drawing.figure.savefig(folder / f"{drawing.name}.png", dpi=DOTS_PER_INCH)
    buffer = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": drawing.name}):  # ids that no other figure of the page has
        drawing.figure.savefig(buffer, format="svg", metadata={"Date": None})
    standalone = slim(buffer.getvalue())
    (folder / f"{drawing.name}.svg").write_text(standalone, encoding="utf-8")
    return for_page(standalone, drawing.title)


def slim(svg: bytes) -> str:
    """Return matplotlib's SVG without metadata, with short numbers, and with attributes in place of styles.

    A page's Content-Security-Policy may forbid styles inside it; attributes are always allowed.
    """
    root = etree.fromstring(svg, etree.XMLParser(remove_comments=True, remove_blank_text=True, resolve_entities=False))
    for element in [*root.iter(f"{_SVG}metadata", f"{_SVG}style")]:
        element.getparent().remove(element)
    root.set("stroke-linejoin", "round")
    root.set("stroke-linecap", "butt")
    root.set("font-family", "DejaVu Sans, Verdana, sans-serif")
    used = set(re.findall(r'(?:#)([\w-]+)[")]', etree.tostring(root, encoding="unicode")))
    for element in root.iter():
        for name, value in _PRESENTATION.findall(element.attrib.pop("style", "")):
            if name != "font-family":
                element.set(name, value.strip())
        if _HREF in element.attrib:
            element.set("href", element.attrib.pop(_HREF))
        if element.get("id") not in used:
            element.attrib.pop("id", None)
        for name in ("d", "x", "y", "transform", "points"):
            if "scale" not in element.get(name, "scale"):
                short = _shortened(element.attrib.pop(name))
                if short:
                    element.set(name, short)
    _drop_bare_groups(root)
    _share_attributes(root)
    etree.cleanup_namespaces(root)
    return etree.tostring(root, encoding="unicode")


def _drop_bare_groups(root: etree._Element) -> None:
    """Put the content of groups without attributes in their place; remove what is empty."""
    for group in [*root.iter(f"{_SVG}g", f"{_SVG}defs")][::-1]:
        above = group.getparent()
        if above is not None and not group.attrib and (group.tag == f"{_SVG}g" or not len(group)):
            place = above.index(group)
            above[place : place + 1] = list(group)


def _share_attributes(root: etree._Element) -> None:
    """Put neighbours that are drawn alike into a group that says once how."""
    for parent in [*root.iter(f"{_SVG}svg", f"{_SVG}g")]:
        for (_, shared), alike in itertools.groupby([*parent], _way_of_drawing):
            siblings = [*alike]
            if len(siblings) < 2 or not shared:
                continue
            group = etree.Element(f"{_SVG}g", dict(shared))
            parent.insert(parent.index(siblings[0]), group)
            for sibling in siblings:
                for name, _ in shared:
                    sibling.attrib.pop(name)
                group.append(sibling)


def _way_of_drawing(element: etree._Element) -> tuple[str, tuple[tuple[str, str], ...]]:
    """Return what elements must have in common to share a group: their tag, and all but where and what they are."""
    return element.tag, tuple((name, value) for name, value in element.attrib.items() if name not in _OWN)


def _shortened(numbers: str) -> str:
    """Return numbers of a path with one digit behind the point: a tenth of a typographic point."""
    short = _LONG.sub(lambda found: f"{float(found[0]):.1f}".removesuffix(".0"), numbers)
    short = re.sub(r"rotate\(-?0 [^)]*\)", "", short)
    return re.sub(r"\s*([A-Za-z,()])\s*", r"\1", re.sub(r"\s+", " ", short)).strip()


def for_page(svg: str, label: str) -> str:
    """Return an SVG as part of a page: as wide as its column, its ink that of the page's text, on the page's ground."""
    root = etree.fromstring(svg.encode())
    ground = root.find(f".//{_SVG}path[@fill='#ffffff']")
    if ground is not None:
        ground.getparent().remove(ground)
    for name in ("height", "version"):
        root.attrib.pop(name, None)
    root.set("width", f"{PIXELS_PER_POINT * float(root.get('viewBox').split()[2]):.0f}")
    root.set("role", "img")
    root.set("aria-label", label)
    return etree.tostring(root, encoding="unicode").replace(INK, "currentColor")
