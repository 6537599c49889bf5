"""What a bundle holds twice, or beside the robot itself: its archive, its ROS package, the drives of its URDFs."""

from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from xml.etree import ElementTree

import mujoco

from studio.export.archive import unzipped
from studio.export.check import Check
from studio.export.ros import FOLDER, package_name, package_papers, root_of
from studio.export.urdf import DRIVES, write_urdf


def check_archive(files: Mapping[str, bytes], robot: str) -> Check:
    """Check that the archive of a `robot` holds its MJCF file and the meshes beside that, byte by byte."""
    inside = unzipped(files[f"{robot}.mjz"])
    beside = {"model.xml": files.get(f"{robot}.xml"), **{path: files.get(path) for path in inside if path in files}}
    wrong = sorted(path for path in inside.keys() | beside.keys() if inside.get(path) != beside.get(path))
    return Check(f"{robot}.mjz: holds {robot}.xml and its meshes", float(len(wrong)), 0.0, _listed(wrong))


def check_package(files: Mapping[str, bytes], robot: str, task: str, size: float) -> Check:
    """Check that a ROS package of a `robot` of `size` m holds what this version writes: a launch file is a program.

    The robot itself is compared by those who read the URDF in it; what its meshes look like is not.
    """
    folder = f"{FOLDER}/{package_name(task)}"
    urdf = f"{folder}/urdf/{robot}.urdf"
    root = root_of(ElementTree.fromstring(files[urdf])) if urdf in files else ""
    papers = {f"{folder}/{path}": text for path, text in package_papers(task, robot, root, size).items()}
    found = {path: content for path, content in files.items() if path.startswith(f"{FOLDER}/")}
    others = [path for path in found if path == urdf or fnmatchcase(path, f"{folder}/meshes/*.stl")]
    wrong = sorted(path for path in (found.keys() | papers.keys()) - {*others} if found.get(path) != papers.get(path))
    return Check(f"{folder}: what this version writes beside the robot", float(len(wrong)), 0.0, _listed(wrong))


def check_drives(path: str, content: bytes, model: mujoco.MjModel) -> Check:
    """Compare the transmissions and ros2_control interfaces of a URDF, where it has any, with those of a model whose
    joints have their zeros where the file has them."""
    found = sorted(_drives(ElementTree.fromstring(content)))
    expected = sorted(_drives(ElementTree.fromstring(write_urdf(model, path, "", drives=True)[path])))
    known = {entry for block in expected for entry in block}
    strange = [" ".join(entry) for block in found for entry in block if entry not in known]
    off = bool(found) and found != expected
    return Check(f"{path}: transmissions and interfaces", float(off), 0.0, _listed(strange))


def _drives(root: ElementTree.Element) -> Iterator[list[tuple[str, ...]]]:
    """Yield what each block of a URDF says of drives: tag, attributes and text of each element, numbers without their
    last digits."""
    for block in (block for kind in DRIVES for block in root.findall(kind)):
        entries: list[tuple[str, ...]] = []
        for element in block.iter():
            said = (f"{name}={value}" for name, value in sorted(element.attrib.items()))
            entries.append((element.tag, *said, _rounded((element.text or "").strip())))
        yield entries


def _rounded(word: str) -> str:
    try:
        return f"{float(word):.9g}"
    except ValueError:
        return word


def _listed(wrong: list[str]) -> str:
    return f"differ: {', '.join(wrong[:3])}" if wrong else ""
