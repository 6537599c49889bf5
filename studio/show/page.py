"""hand.html: one file that needs no network, in which a hand runs live, and what is known of its design as text."""

import base64
import gzip
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path

import numpy as np

from morph_core.history import History
from morph_core.picture import png
from morph_core.protocol import Evaluation
from morph_core.run_folder import RunFolderError
from morph_core.task import Task
from studio.export.bundle import task_of
from studio.export.errors import ExportError
from studio.show.hand import check_hand, hand_of, rule_of
from studio.show.shaping import shaping_of

SCRIPTS = ("policy.js", "world.js", "shape.js", "stage.js", "pull.js", "hand.js")
"""The page's own scripts, in the order in which they are put together as one module."""
PICTURE_WIDTH, PICTURE_HEIGHT = 960, 720
_FOLDER = Path(__file__).parent
_NO_POLICY = (
    "This run holds no checkpoint of this design, so that there is no policy: the hand holds its start posture. "
    "It can be pulled and pushed all the same."
)


@dataclass(frozen=True)
class Page:
    """A page that has been written."""

    content: bytes
    """The bytes of the HTML file."""
    missing: str
    """A sentence on what the page lacks; empty where it has everything."""


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
        missing = f"This design can't run: {error}. Its picture and its numbers are below."
    hands["missing"] = missing
    known = {
        "title": escape(task.title),
        "run": escape(history.folder.id),
        "iteration": str(iteration),
        "rule": escape(task.success_rule),
        "success": _success(_recorded(history, iteration, phi)),
        "rows": _rows(history, iteration, phi),
        "picture": _picture(task, phi),
        "missing": escape(missing),
    }
    return Page(_filled(known, hands), missing)


def _filled(known: Mapping[str, str], hands: Mapping[str, object]) -> bytes:
    """Return the template with all that it names, and a policy that allows exactly the scripts and the style in it."""
    scripts = {
        "three": _read("vendor/three.js"),
        "mujoco": _read("vendor/mujoco.js"),
        "script": "\n".join(_read(f"shipped/{name}") for name in SCRIPTS),
    }
    style = _read("shipped/hand.css")
    blobs = {
        "wasm": _base64((_FOLDER / "vendor" / "mujoco.wasm.gz").read_bytes()),
        "hands": _packed(json.dumps(hands, allow_nan=False).encode()),
        "licences": _packed((_FOLDER / "vendor" / "LICENSES.txt").read_bytes()),
    }
    allowed = " ".join(_hash(script) for script in scripts.values())
    policy = (
        f"default-src 'none'; script-src {allowed} 'wasm-unsafe-eval'; style-src {_hash(style)}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    values = {**known, **scripts, **blobs, "style": style, "policy": policy}
    page = re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], _read("shipped/hand.html"))
    return page.encode()


def _recorded(history: History, iteration: int, phi: np.ndarray) -> Evaluation | None:
    found = (e for e in reversed(history.evaluations) if e.iteration == iteration and e.phi == phi.tolist())
    return next(found, None)


def _success(recorded: Evaluation | None) -> str:
    if recorded is None:
        return "Its success was not measured in training."
    return (
        f"In training this design succeeded in {recorded.deterministic_success:.0%} of its episodes with the policy's "
        f"mean, which acts here, and in {recorded.sampled_success:.0%} with actions drawn around it."
    )


def _rows(history: History, iteration: int, phi: np.ndarray) -> str:
    return "".join(
        f"<tr><th scope=row>{escape(p.name)}<td>{value:.3f}<td>{p.initial:.3f}<td>{value - p.initial:+.3f}"
        f"<td>{escape(p.unit)}<td>"
        for p, value in zip(history.at(iteration).space.parameters, phi, strict=True)
    )


def _picture(task: Task, phi: np.ndarray) -> str:
    """Return the design in its start posture as a data URL."""
    from morph_core.envs.view import View  # with it comes Gymnasium

    hw_phy = task.hw_phy(phi)
    start = task.reset(hw_phy, 1, np.random.default_rng(0))[0]
    image = View(task, phi, hw_phy, PICTURE_WIDTH, PICTURE_HEIGHT).on_clear_ground(start)
    return f"data:image/png;base64,{_base64(png(image))}"


def _read(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{_base64(hashlib.sha256(text.encode()).digest())}'"


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


_compressed = partial(gzip.compress, compresslevel=9, mtime=0)


def _packed(content: bytes) -> str:
    return _base64(_compressed(content))
