"""A URDF and its meshes as a ROS 2 description package: `colcon build` takes it as it is, a launch file shows it."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.etree import ElementTree

from studio.export.errors import ExportError

FOLDER = "ros"
_TEMPLATES = Path(__file__).parent / "shipped" / "ros"
_SCHEME = "package://"


def package_name(task: str) -> str:
    """Return the name of a task's package: what ROS allows, whatever the task is called."""
    word = re.sub(r"_+", "_", re.sub(r"[^a-z0-9]", "_", task.lower())).strip("_")
    return f"{word if word[:1].isalpha() else f'robot_{word}'.strip('_')}_description"


def ros_package(task: str, robot: str, urdf: bytes, files: Mapping[str, bytes], size: float) -> dict[str, bytes]:
    """Return the package of a `robot` that is `size` m large; its meshes are among `files`."""
    name = package_name(task)
    root = ElementTree.fromstring(urdf)
    meshes: dict[str, bytes] = {}
    for mesh in root.iter("mesh"):
        path = f"meshes/{mesh.attrib['filename'].replace('/', '_')}"
        meshes[path] = files[mesh.attrib["filename"]]
        mesh.set("filename", f"{_SCHEME}{name}/{path}")
    package = {
        # Without a declaration of its encoding, which Gazebo's spawner refuses in a text.
        f"urdf/{robot}.urdf": ElementTree.tostring(root, encoding="unicode").encode("ascii", "xmlcharrefreplace"),
        **meshes,
        **package_papers(task, robot, root_of(root), size),
    }
    return {f"{FOLDER}/{name}/{path}": content for path, content in package.items()}


def package_papers(task: str, robot: str, root: str, size: float) -> dict[str, bytes]:
    """Return what the package of a `robot` with the link `root` holds beside the robot itself, by path inside of it."""
    papers = {"meshes/.keep": b""}  # CMake installs the folder, whether there are meshes or not
    words = {
        "PACKAGE": package_name(task), "ROBOT": robot, "TASK": task, "ROOT": root, "DISTANCE": f"{2.5 * size:.3g}",
    }  # fmt: skip
    for template, path in (
        ("package.xml", "package.xml"), ("CMakeLists.txt", "CMakeLists.txt"),
        ("display.launch.py.txt", "launch/display.launch.py"), ("display.rviz", "rviz/display.rviz"),
    ):  # fmt: skip
        text = (_TEMPLATES / template).read_text(encoding="utf-8")
        for word, value in words.items():
            text = text.replace(f"@{word}@", value)
        papers[path] = text.encode()
    return papers


def in_packages(files: Iterable[str], robot: str) -> list[str]:
    """Return the paths of a robot's URDFs in ROS packages."""
    return [path for path in files if path.startswith(f"{FOLDER}/") and path.endswith(f"/urdf/{robot}.urdf")]


def plain_urdf(path: str, content: bytes) -> bytes:
    """Return the URDF of a package with its meshes by paths from the bundle; ExportError for an address elsewhere."""
    folder = Path(path).parents[1]
    root = ElementTree.fromstring(content)
    for mesh in root.iter("mesh"):
        file, address = mesh.get("filename", ""), f"{_SCHEME}{folder.name}/"
        if not file.startswith(address):
            raise ExportError(f"the mesh {file[:60]} is not one of the package: its address must begin with {address}")
        mesh.set("filename", (folder / file.removeprefix(address)).as_posix())
    return ElementTree.tostring(root)


def root_of(urdf: ElementTree.Element) -> str:
    """Return the link that no joint carries."""
    carried = {child.get("link") for child in urdf.iterfind("joint/child")}
    return next(link.get("name", "") for link in urdf.iter("link") if link.get("name") not in carried)
