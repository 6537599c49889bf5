"""hand.html: one file that needs no network, in which a hand runs live, and what is known of its design as text."""

import json
from html import escape

import numpy as np

from morph_core.history import History
from morph_core.protocol import Evaluation
from morph_core.run_folder import RunFolderError
from studio.export.bundle import task_of
from studio.export.errors import ExportError
from studio.show.hand import check_hand, hand_of, rule_of
from studio.show.shaping import shaping_of
from studio.show.sheet import Page, filled, packed_text, picture, wasm

SCRIPTS = ("page.js", "policy.js", "world.js", "shape.js", "stage.js", "view.js", "pull.js", "hand.js")
"""The page's own scripts, in the order in which they are put together as one module."""
STYLES = ("page.css", "hand.css")
_NO_POLICY = (
    "This run holds no checkpoint of this design, so that there is no policy: the hand holds its start posture. "
    "It can be pulled and pushed all the same."
)


def build_page(history: History, which: str) -> Page:
    """Return the page of the design `which`: "best", "latest" or an iteration.

    A design that can't be built is shown as a picture and a table alone. Raise ExportError for a run that is not of a
    hand.
    """
    try:
        iteration, phi = history.design(which)
    except RunFolderError as error:
        raise ExportError(str(error)) from error
    task = check_hand(task_of(history))
    initial = np.array([parameter.initial for parameter in history.record.parameters])
    hands: dict[str, object] = {"rule": rule_of(task), "designs": []}
    missing = ""
    try:
        shown = [("This design", phi)] if np.array_equal(phi, initial) else [("Evolved", phi), ("Initial", initial)]
        made = [hand_of(history, task, iteration, design) | {"label": label} for label, design in shown]
        hands |= {"designs": made, "shaping": shaping_of(history, task, iteration, phi)}
        missing = _NO_POLICY if made[0]["layers"] is None else ""
    except ExportError as error:
        missing = f"This design can't run: {error}. Its picture and its numbers are on the page."
    hands["missing"] = missing
    known = {
        "title": escape(task.title),
        "run": escape(history.folder.id),
        "iteration": str(iteration),
        "rule": escape(task.success_rule),
        "success": _success(_recorded(history, iteration, phi)),
        "rows": _rows(history, iteration, phi),
        "picture": picture(task, phi),
        "missing": escape(missing),
    }
    packed = {"wasm": wasm(), "hands": packed_text(json.dumps(hands, allow_nan=False).encode())}
    vendor = ("three.js", "mujoco.js")
    content = filled("hand.html", known, vendor=vendor, scripts=SCRIPTS, styles=STYLES, packed=packed)
    return Page(content, missing)


def _recorded(history: History, iteration: int, phi: np.ndarray) -> Evaluation | None:
    found = (e for e in reversed(history.evaluations) if e.iteration == iteration and e.phi == phi.tolist())
    return next(found, None)


def _success(recorded: Evaluation | None) -> str:
    if recorded is None:
        return "Its success was not measured in training."
    return (
        f"In training this design succeeded in {100 * recorded.deterministic_success:.0f} % of its episodes with the "
        f"policy's mean, which acts here, and in {100 * recorded.sampled_success:.0f} % with actions drawn around it."
    )


def _rows(history: History, iteration: int, phi: np.ndarray) -> str:
    return "".join(
        f"<tr><th scope=row>{escape(p.name)}<td>{value:.3f}<td>{p.initial:.3f}<td>{value - p.initial:+.3f}"
        f"<td>{escape(p.unit)}<td>"
        for p, value in zip(history.at(iteration).space.parameters, phi, strict=True)
    )
