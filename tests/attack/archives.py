"""Archives that were changed at random, into import and `verify`: nothing crashes, hangs, grows or is written outside.

Bytes of the zip, its entries, the XML and JSON in it; each is sent to a running studio as a design to start from, and
proved as `morph-studio verify` does.
"""

import concurrent.futures
import contextlib
import io
import json
import os
import random
import resource
import struct
import tempfile
import threading
import time
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import httpx
import msgspec
import numpy as np
from trimesh.transformations import euler_matrix

from morph_core.catalogue import make_task
from studio.export import apart
from studio.export.apart import MEMORY_BYTES, prove_apart
from studio.export.archive import read_files
from studio.export.bundle import robot_files
from studio.export.check import Check
from studio.export.design_file import Design, Value
from studio.export.errors import ExportError
from studio.export.proof import unpack
from studio.robots.chooser import robot_of
from tests.attack.outcome import Outcome
from tests.attack.target import Target, target
from tests.forked import Forked

PATHS = (
    "../escaped", "../../../escaped", "{outside}/escaped", "a/../../escaped", "C:/escaped", "..\\escaped", "\0", "",
    "robot.xml/x", "n" * 300, "design.json/", "con", "\u202egnp.exe", "~/escaped", "./design.json",
)  # fmt: skip
NUMBERS = ("nan", "inf", "-inf", "1e308", "-1", "0", "60000", "1e-300", "99", "0x7fffffff", "", "words", "1 " * 5000)
ELEMENTS = (
    '<include file="{outside}/secret"/>', '<include file="../secret"/>', '<frame><replicate count="9999"/></frame>',
    '<extension><plugin plugin="mujoco.sdf.bolt"/></extension>',
    '<asset><hfield name="h" nrow="60000" ncol="60000" size="1 1 1 1"/></asset>',
    '<asset><mesh name="m" file="{outside}/secret"/></asset>', "<size memory='100G'/>",
    '<asset><texture type="2d" builtin="flat" width="99999" height="99999"/></asset>',
)  # fmt: skip
SORTS = {"bytes": 30, "entries": 20, "sizes": 5, "xml": 30, "json": 10, "any": 5}
"""The sorts of changes, and how often each comes."""
GROWTH = 100.0
"""Largest growth in MB of the studio's memory while archives are imported."""
EVERY = 20
"""One of so many is proved in a process that is begun anew, as `verify` does it; the others in forked ones."""
_AT_ONCE = 3


def attack_archives(archives: int, seed: int, quiet: bool = False) -> Outcome:
    """Change a bundle so many times at random, and import and verify what comes of it."""
    outcome = Outcome("archives", archives, "archives", seed, quiet=quiet)
    with tempfile.TemporaryDirectory() as name, target(asleep=True, MORPH_TRAINERS="1") as server:
        trap = Trap(Path(name))
        began, honest = server.megabytes(), _bundle()
        for forked in (False, True):  # the one that forks keeps its socket outside of the trap
            if faults := _faults(_prove(trap, _zip(honest), outcome, forked=forked)):
                outcome.fault(f"the bundle that nobody has changed fails: {faults[0]}")
        mutants = [Mutant(i, random.Random(seed * 1_000_003 + i), honest, trap) for i in range(archives)]
        with trap.set(), concurrent.futures.ThreadPoolExecutor(_AT_ONCE) as both:
            for _ in both.map(lambda mutant: _try(mutant, server, outcome), mutants):
                outcome.add()
        if found := trap.sprung():
            outcome.fault(f"written outside: {', '.join(found[:5])}")
        grown, peak = server.megabytes() - began, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
        if grown > GROWTH:
            outcome.fault(f"the studio has grown by {grown:.0f} MB")
        if peak > MEMORY_BYTES:
            outcome.fault(f"a process that verifies has taken {peak / 1e6:.0f} MB")
        outcome.figures |= {"server MB": f"{began:.0f} to {server.megabytes():.0f}", "largest verifier, MB": peak / 1e6}
        for error in server.errors():
            outcome.fault(f"a traceback in the server's log: {error}")
    return outcome.end()


@dataclass
class Trap:
    """A folder in which archives are unpacked, with room around it into which nothing may be written."""

    root: Path
    home: Path = field(init=False)

    def __post_init__(self) -> None:
        self.home = self.root / "a" / "b" / "c" / "home"
        self.home.mkdir(parents=True)
        (self.root / "outside").mkdir()
        (self.root / "outside" / "secret").write_text("<mujoco/>")

    def sprung(self) -> list[str]:
        """Return what was written into the room around, and what was left in the folder."""
        known = {self.root / "outside" / "secret"}
        found = (path for path in self.root.rglob("*") if not path.is_dir() and path not in known)
        return [str(path.relative_to(self.root)) for path in found]

    @contextlib.contextmanager
    def set(self) -> Iterator[None]:
        """Let what is unpacked, by this process and those that it starts, be unpacked in the trap."""
        before, tempfile.tempdir = tempfile.tempdir, str(self.home)
        os.environ["TMPDIR"] = str(self.home)
        try:
            yield
        finally:
            tempfile.tempdir = before
            del os.environ["TMPDIR"]


@dataclass
class Mutant:
    """A bundle that is changed at random."""

    number: int
    rng: random.Random
    files: Mapping[str, bytes]
    trap: Trap
    said: str = ""
    """What was changed."""
    physical: bool = False
    """Whether the change is one of the robot, which `verify` must notice."""

    def zip(self) -> bytes:
        """Return the bundle after one change."""
        sorts = {
            self.of_bytes: 30,
            self.of_entries: 20,
            self.of_sizes: 5,
            self.of_xml: 30,
            self.of_json: 10,
            self.of_any: 5,
        }
        (change,) = self.rng.choices(list(sorts), weights=list(sorts.values()))
        return change()

    def of_bytes(self) -> bytes:
        """Return a zip of which some bytes are others, too many or too few."""
        content = bytearray(_zip(self.files))
        for _ in range(self.rng.choice((1, 1, 3, 20))):
            at, length = self.rng.randrange(len(content)), self.rng.choice((1, 8, 100))
            match self.rng.randrange(5):
                case 0:
                    content[at : at + length] = b"\xff" * length
                case 1:
                    content[at : at + length] = self.rng.randbytes(length)
                case 2:
                    del content[at : at + length]
                case 3:
                    content[at:at] = content[at : at + length]
                case _:
                    content = content[: max(4, at)] if self.rng.random() < 0.2 else content
        self.said = "some bytes"
        return bytes(content)

    def of_entries(self) -> bytes:
        """Return a zip with an entry that is elsewhere, a link, twice, packed otherwise, far too large, or too many."""
        path = self.rng.choice(PATHS).replace("{outside}", str(self.trap.root / "outside"))
        kind = self.rng.choice(("path", "link", "twice", "method", "bomb", "many", "dropped", "swapped", "nested"))
        self.said, files, buffer = f"{kind} {path!r}", dict(self.files), io.BytesIO()
        if kind == "dropped":
            del files[self.rng.choice(list(files))]
        if kind == "swapped":
            one, other = self.rng.sample(list(files), 2)
            files[one], files[other] = files[other], files[one]
        with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            warnings.simplefilter("ignore")  # of names that are there twice
            for name, content in files.items():
                archive.writestr(name, content)
            match kind:
                case "path":
                    archive.writestr(_entry(path), b"escaped")
                case "link":
                    entry = zipfile.ZipInfo(self.rng.choice(("meshes/x.stl", "design.json")))
                    entry.external_attr = 0o120777 << 16
                    archive.writestr(entry, str(self.trap.root / "outside" / "escaped"))
                case "twice":
                    archive.writestr(self.rng.choice(list(files)), b"{}")
                case "method":
                    method = self.rng.choice((zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2))
                    archive.writestr("meshes/x.stl", bytes(1 << 20), method)
                case "bomb":
                    archive.writestr(self.rng.choice(("meshes/x.stl", "policy.npz")), bytes(64 << 20))
                case "many":
                    for number in range(2500):
                        archive.writestr(f"meshes/{number}", b"")
                case "nested":
                    archive.writestr(f"{self.rng.choice(('arm', 'robot'))}.mjz", _zip({"x.xml": bytes(32 << 20)}))
        return buffer.getvalue()

    def of_sizes(self) -> bytes:
        """Return a zip whose directory lies about sizes, flags or places."""
        content = bytearray(_zip(self.files))
        entries = [at for at in range(len(content) - 46) if content[at : at + 4] == b"PK\1\2"]
        at, self.said = self.rng.choice(entries), "a lying directory"
        where, form = self.rng.choice(
            ((20, "<I"), (24, "<I"), (8, "<H"), (10, "<H"), (42, "<I"), (28, "<H"), (16, "<I"))
        )
        struct.pack_into(form, content, at + where, self.rng.choice((0, 1, 0xFFFF, 0x7FFF)))
        return bytes(content)

    def of_xml(self) -> bytes:
        """Return a bundle of which one file of a robot has another number, or one element more, less, or twice."""
        path = self.rng.choice([path for path in self.files if path.endswith((".xml", ".urdf"))])
        root = ElementTree.fromstring(self.files[path])
        element = self.rng.choice(list(root.iter()))
        match self.rng.choice(("number", "number", "number", "inserted", "dropped", "doubled", "deep")):
            case "number":
                self._change_number(root, path)
            case "inserted":
                text = self.rng.choice(ELEMENTS).replace("{outside}", str(self.trap.root / "outside"))
                element.append(ElementTree.fromstring(text))
                self.said = f"{path}: {text[:60]}"
            case "dropped" if list(element):
                gone = self.rng.choice(list(element))
                element.remove(gone)
                self.said = f"{path}: {gone.tag} dropped"
            case "doubled":
                element.extend(list(element))
                self.said = f"{path}: {element.tag} doubled"
            case _:
                for _ in range(self.rng.choice((50, 700))):
                    element.append(deeper := ElementTree.Element(element.tag))
                    element = deeper
                self.said = f"{path}: deep"
        return _zip({**self.files, path: ElementTree.tostring(root)})

    def _change_number(self, root: ElementTree.Element, path: str) -> None:
        numbers = [(e, name) for e in root.iter() for name, value in e.attrib.items() if _is_numbers(value)]
        element, name = self.rng.choice(numbers)
        words = element.attrib[name].split()
        at = self.rng.randrange(len(words))
        before = element.attrib[name]
        old, words[at] = words[at], self.rng.choice((*NUMBERS, f"{float(words[at]) * 2 + 0.01!r}"))
        element.attrib[name] = " ".join(words)
        self.said = f"{path}: {element.tag} {name} {old} -> {words[at][:20]}"
        parts = {shown for visual in root.iter("visual") for shown in visual.iter()}  # of a URDF
        turned = [e.find("geometry/*") for e in root.iter("collision") if name == "rpy" and e.find("origin") is element]
        same = not _differ(old, words[at]) or any(_is_same(e, before, element.attrib[name]) for e in turned)
        self.physical = not same and element not in parts and not _only_shown(element, name)

    def of_json(self) -> bytes:
        """Return a bundle whose design.json says something odd."""
        design: Any = json.loads(self.files["design.json"])
        wild = (None, "", "../../x", "{", -1, 1e308, float("nan"), 10**30, [], {}, [[]] * 1000, True, "A" * 10**6)
        place: Any = self.rng.choice([design, *design["parameters"]])
        key = self.rng.choice(list(place))
        place[key] = self.rng.choice(wild)
        self.said = f"design.json: {key} {str(place[key])[:20]}"
        text = json.dumps(design).encode()
        return _zip({**self.files, "design.json": text[: self.rng.choice((len(text), len(text) // 2))]})

    def of_any(self) -> bytes:
        """Return a bundle of which some bytes of one file are others."""
        path = self.rng.choice(list(self.files))
        content = bytearray(self.files[path])
        for _ in range(10):
            content[self.rng.randrange(len(content))] = self.rng.randrange(256)
        self.said = f"{path}: some bytes"
        return _zip({**self.files, path: bytes(content)})


def _entry(name: str) -> zipfile.ZipInfo:
    """Return an entry of any name, the empty one too, which `zipfile` writes under another alone."""
    entry = zipfile.ZipInfo("x")
    entry.filename = entry.orig_filename = name or "\0"
    return entry


def _try(mutant: Mutant, server: Target, outcome: Outcome) -> None:
    content = mutant.zip()
    try:
        with server.client(120) as client:
            answer = client.post("/api/designs", content=content, headers={"Content-Type": "application/zip"})
        if answer.status_code >= 500:
            outcome.fault(f"{mutant.said}: import answers {answer.status_code}")
        _tally(outcome, f"import {answer.status_code // 100}xx")
    except httpx.HTTPError as error:
        outcome.fault(f"{mutant.said}: import has no answer: {error!r}")
    try:
        checks = _prove(mutant.trap, content, outcome, forked=mutant.number % EVERY != 0)
    except Exception as error:  # nothing but a refusal may come of it
        outcome.fault(f"{mutant.said}: verify raises {error!r}")
        return
    faults = _faults(checks)
    _tally(outcome, "verify disagrees" if faults else "verify agrees")
    for fault in faults:
        if "given up" in fault:
            outcome.fault(f"{mutant.said}: {fault}")
        if "ended by signal" in fault:
            _tally(outcome, "verify: reader ended by a signal")
    if mutant.physical and not faults:
        outcome.fault(f"{mutant.said}: verify agrees all the same")


def _prove(trap: Trap, content: bytes, outcome: Outcome, *, forked: bool = False) -> list[Check]:
    """Prove a zip in a process of its own that lays out its files in the trap; a refusal is a failed check.

    A process that is forked has loaded its libraries already, and is `studio.export.apart` all the same.
    """
    began = time.monotonic()
    with tempfile.TemporaryDirectory(dir=trap.home) as home:
        path = Path(home) / "bundle.zip"
        path.write_bytes(content)
        try:
            files = read_files(path)
            return _prove_forked(files, Path(home) / "files") if forked else prove_apart(files, episodes=0)
        except (ExportError, OSError) as error:
            return [Check("the bundle", float("inf"), 0.0, str(error))]
        finally:
            with _LOCK:
                longest = float(outcome.figures.get("longest verify, s", 0.0))
                outcome.figures["longest verify, s"] = round(max(longest, time.monotonic() - began), 1)


def _prove_forked(files: Mapping[str, bytes], folder: Path) -> list[Check]:
    folder.mkdir()
    unpack(files, folder)
    words = (str(folder), "0", str(apart.READING_SECONDS), str(MEMORY_BYTES))
    proof = Forked("studio.export.apart", *words, cwd=folder)
    status = proof.wait(apart.WALL_FACTOR * apart.READING_SECONDS)
    try:
        return [told.check for told in msgspec.json.decode(proof.said("output"), type=list[apart._Told])]
    except msgspec.DecodeError:
        why = apart._why(status, proof.said("errors").encode(), apart.READING_SECONDS)
        return [Check("the bundle", float("inf"), 0.0, why)]


def _faults(checks: list[Check]) -> list[str]:
    return [str(check) for check in checks if not check.passed and "digests" not in check.name]


_LOCK = threading.Lock()


def _tally(outcome: Outcome, name: str) -> None:
    with _LOCK:
        outcome.figures[name] = float(outcome.figures.get(name, 0.0)) + 1


def _differ(old: str, new: str) -> bool:
    """Tell whether two numbers differ by more than what is allowed for."""
    try:
        return not abs(float(old) - float(new)) <= 1e-6 * max(1.0, abs(float(old)))
    except ValueError:
        return True


def _is_same(shape: ElementTree.Element | None, before: str, after: str) -> bool:
    """Tell whether a shape of a URDF is the same under two turns: a ball always, a cylinder turned about its axis."""
    if shape is None or shape.tag not in ("sphere", "cylinder"):
        return False
    try:
        one, other = (euler_matrix(*map(float, words.split()), axes="sxyz")[:3, 2] for words in (before, after))
    except (ValueError, TypeError):
        return False
    finite = bool(np.isfinite(other).all())
    return finite and (shape.tag == "sphere" or abs(float(one @ other)) > 1 - 1e-12)


def _only_shown(element: ElementTree.Element, name: str) -> bool:
    """Tell whether an attribute is of what is only shown, of which `verify` says that it proves nothing."""
    touches = [element.get(kind) for kind in ("contype", "conaffinity")] != ["0", "0"]
    shown = element.tag in ("light", "camera", "texture", "material", "headlight", "map", "quality", "global", "color")
    idle = (element.tag, name) == ("geom", "mass")  # of a body that says its inertia
    return (
        shown or idle or name == "rgba" or (element.tag == "geom" and (not touches or element.get("class") == "visual"))
    )


def _is_numbers(value: str) -> bool:
    try:
        return bool([float(word) for word in value.split()])
    except ValueError:
        return False


def _zip(files: Mapping[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def _bundle() -> dict[str, bytes]:
    """Return the files of a reacher that nobody has changed; without digests, which whoever changes it makes anew."""
    task = make_task("reacher")
    phi = np.array([p.initial for p in task.design_space.parameters])
    robot = robot_of(task)
    parameters = [
        Value(name=p.name, value=p.initial, unit=p.unit, lo=p.lo, hi=p.hi, locked_at=None, hard_lo=p.hard_lo,
              hard_hi=p.hard_hi, initial=p.initial)
        for p in task.design_space.parameters
    ]  # fmt: skip
    design = Design(
        task="reacher", task_options={}, robot=robot.file_name, run="", design="", iteration=0, parameters=parameters
    )
    files = robot_files(task, phi, [], ("mjcf", "urdf")) | robot.program(phi).sources
    return files | {"design.json": msgspec.json.encode(design)}
