"""What a stranger's bundle may hold at all, looked at before any reader of robots sees it.

MuJoCo's loader is no sandbox: it opens what a file names, and builds what a file asks for, however large.
"""

import io
import math
import re
import zipfile
from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import PurePosixPath
from xml.etree import ElementTree

from studio.export.archive import MAX_BYTES, MAX_FILES
from studio.export.check import Check
from studio.export.ros import FOLDER

_LOADS = frozenset(("include", "replicate", "composite", "flexcomp", "plugin", "extension", "attach", "model"))
"""Elements by which a file fetches other files, runs code or multiplies itself: no bundle has any."""
_NAMES = frozenset(("name", "class", "childclass", "filename", "file", "model", "content_type"))
"""Attributes that are words, and may read like a number that is none."""
_SIZES = re.compile(r"n(row|col|user_.*|stack|conmax|jmax|key|width|height)|width|height|count|resolution")
LARGEST_SIZE = 4096.0
"""Largest number that an attribute may have by which a reader sets memory aside."""
MOST_ELEMENTS = 20_000
"""Largest number of XML elements in a file; a hand of six fingers has a few hundred."""
_ARCHIVES = (".3mf", ".mjz", ".npz")
_BELONGS = (
    "design.json", "provenance.json", "README.txt", "LICENSE", "BOM.csv", "report.html", "control.json",
    "servos.json", "assembly.glb", "policy.npz", "policy.onnx", "policy.py", "run_policy.py", "scene.xml",
    "{robot}.xml", "{robot}.mjz", "{robot}.urdf",
    "parts/*.stl", "3mf/*.3mf", "plates/*.3mf", "plates/*.svg", "plates/*.csv", "step/*.step", "meshes/*",
    "meshes_scene/*", "meshes_urdf/*",
    "ros/*_description/*",
)  # fmt: skip
"""What an export consists of."""


def screen(files: Mapping[str, bytes], robot: str) -> list[Check]:
    """Return a check for each file that readers will open, and one of what does not belong into a bundle."""
    checks = [_counted("all files: each belongs to an export", list(_strangers(files, robot)))]
    for path, content in sorted(files.items()):
        if path.endswith((".xml", ".urdf")):
            checks.append(_counted(f"{path}: asks for nothing outside", list(_faults_of_xml(content, path, files))))
        elif path.endswith(_ARCHIVES):
            checks.append(_counted(f"{path}: asks for nothing outside", list(_faults_of_archive(content, path))))
    return checks


def _counted(name: str, faults: list[str]) -> Check:
    return Check(name, float(len(faults)), 0.0, "; ".join(faults[:3]))


def _strangers(files: Mapping[str, bytes], robot: str) -> Iterator[str]:
    known = [pattern.format(robot=robot) for pattern in _BELONGS]
    for path in sorted(files):
        if not any(fnmatchcase(path, pattern) for pattern in known):
            yield f"{path[:80]} is no part of an export"


def _faults_of_archive(content: bytes, path: str) -> Iterator[str]:
    """Yield what is wrong with an archive inside of the bundle: its size unpacked, its paths, and its models."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
            if len(entries) > MAX_FILES or sum(entry.file_size for entry in entries) > MAX_BYTES:
                yield f"unpacked it has more than {MAX_FILES} files or {MAX_BYTES >> 20} MiB"
                return
            inside = {entry.filename: archive.read(entry) for entry in entries if not entry.is_dir()}
    except Exception as error:
        yield f"it is no archive that can be read: {str(error) or type(error).__name__}"
        return
    for name, text in sorted(inside.items()):
        if _leads_outside(name):
            yield f"it holds a file {name[:60]!r}"
        if path.endswith(".mjz") and name.endswith((".xml", ".urdf")):
            yield from _faults_of_xml(text, name, inside)


def _faults_of_xml(content: bytes, path: str, files: Mapping[str, bytes]) -> Iterator[str]:
    """Yield why a file of a robot is not handed to a reader."""
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content or b"\x00" in content:
        yield "it defines entities, or is no UTF-8"
        return
    try:
        root = ElementTree.fromstring(content)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        yield f"no XML: {error}"
        return
    elements = list(root.iter())
    if len(elements) > MOST_ELEMENTS:
        yield f"it has {len(elements):,} elements, and at most {MOST_ELEMENTS:,} are read"
        return
    folders = [e.get(kind, "") for e in elements for kind in ("meshdir", "texturedir", "assetdir") if e.get(kind)]
    here = PurePosixPath(path).parent
    package = f"package://{here.parent.name}/" if path.startswith(f"{FOLDER}/") else ""
    drivers = list(root.iterfind("ros2_control/hardware/plugin")) if path.endswith(".urdf") else []
    for element in elements:
        if element.tag in _LOADS and element not in drivers:  # those are compared with what this version writes
            yield f"it holds <{element.tag}>"
        for name, said in element.attrib.items():
            packed = bool(package) and name == "filename" and said.startswith(package)
            value, beside = (said.removeprefix(package), here.parent) if packed else (said, here)
            yield from _faults_of_attribute(f"{element.tag} {name}", name, value)
            known = ((beside / folder / value).as_posix() in files for folder in ["", *folders])
            if name in ("file", "filename") and not _leads_outside(value) and not any(known):
                yield f'{element.tag} {name}="{value[:60]}" is not in the bundle'


def _faults_of_attribute(where: str, name: str, value: str) -> Iterator[str]:
    if name.startswith("file") or name.endswith("dir"):
        if _leads_outside(value):
            yield f'{where}="{value[:60]}" is outside of the bundle'
        return
    if name in _NAMES:
        return
    try:
        numbers = [float(word) for word in value.split()]
    except ValueError:
        return
    if not all(math.isfinite(number) for number in numbers):
        yield f'{where}="{value[:60]}" is not finite'
    elif _SIZES.fullmatch(name) and any(abs(number) > LARGEST_SIZE for number in numbers):
        yield f'{where}="{value[:60]}" is larger than {LARGEST_SIZE:g}'


def _leads_outside(path: str) -> bool:
    """Tell whether a path is anything but a plain one below where it stands."""
    return (
        path.startswith(("/", "~"))
        or any(sign in path for sign in ("\\", ":", "\x00"))
        or ".." in PurePosixPath(path).parts
    )
