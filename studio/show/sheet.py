"""One HTML file that loads nothing: a template, what it carries, and a policy that lets nothing else in."""

import base64
import gzip
import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from morph_core.picture import png
from morph_core.task import Task

PICTURE_WIDTH, PICTURE_HEIGHT = 960, 720
_FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class Page:
    """A page that has been written."""

    content: bytes
    """The bytes of the HTML file."""
    missing: str
    """A sentence on what the page lacks; empty where it has everything."""


def filled(
    template: str,
    known: Mapping[str, str],
    *,
    vendor: Sequence[str],
    scripts: Sequence[str],
    styles: Sequence[str],
    packed: Mapping[str, str],
) -> bytes:
    """Return the template with all that it names, and a policy that allows exactly the scripts and the style in it.

    `known` is HTML. Each of the `vendor` scripts has a place of its own, by its name without its ending; the page's own
    `scripts` become one module. `packed` is text in base64.
    """
    code = {Path(name).stem: _read(f"vendor/{name}") for name in vendor}
    code["script"] = "\n".join(_read(f"shipped/{name}") for name in scripts)
    style = "".join(_read(f"shipped/{name}") for name in styles)
    carried = {**packed, "licences": packed_text((_FOLDER / "vendor" / "LICENSES.txt").read_bytes())}
    allowed = [_hash(script) for script in code.values()]
    if "mujoco.js" in vendor:
        allowed.append("'wasm-unsafe-eval'")
    policy = (
        f"default-src 'none'; script-src {' '.join(allowed)}; style-src {_hash(style)}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    values = {**known, **code, **carried, "style": style, "policy": policy}
    page = re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], _read(f"shipped/{template}"))
    return page.encode()


def wasm() -> str:
    """Return MuJoCo in WebAssembly, compressed, in base64."""
    return base64_of((_FOLDER / "vendor" / "mujoco.wasm.gz").read_bytes())


def picture(task: Task, phi: np.ndarray) -> str:
    """Return the design phi (d,) in its start posture as a data URL."""
    from morph_core.envs.view import View  # with it comes Gymnasium

    hw_phy = task.hw_phy(phi)
    start = task.reset(hw_phy, 1, np.random.default_rng(0))[0]
    image = View(task, phi, hw_phy, PICTURE_WIDTH, PICTURE_HEIGHT).on_clear_ground(start)
    return f"data:image/png;base64,{base64_of(png(image))}"


def base64_of(content: bytes) -> str:
    """Return bytes in base64."""
    return base64.b64encode(content).decode()


def packed_text(content: bytes) -> str:
    """Return bytes compressed, in base64; the same bytes give the same text."""
    return base64_of(_compressed(content))


def _read(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64_of(hashlib.sha256(text.encode()).digest())}'"


_compressed = partial(gzip.compress, compresslevel=9, mtime=0)
