"""The lines by which report.html says that tools load the robot are run as they stand there, wherever they can be."""

import ctypes.util
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from conftest import make_hand_run
from test_export_proof import add_policy, optional

from morph_core.catalogue import make_task
from morph_core.history import History
from studio.export.bundle import build_bundle
from studio.export.loading import LOADINGS, POLICY_LOADINGS, PYTHON, SHELL
from studio.export.proof import unpack

TOOLS = {tool.tool: tool for tool in (*LOADINGS, *POLICY_LOADINGS)}
JOINTS = 9
"""Number of joints of a hand with four fingers."""
FOUND = {
    "MuJoCo": f"assert model.nu == {JOINTS} and model.body('object').id",
    "Drake": f"assert plant.num_positions() == {JOINTS}",
    "Pinocchio": f"assert model.nq == {JOINTS}",
    "PyBullet": "assert robot == 0 and pybullet.getNumJoints(robot) > 9",
    "yourdfpy": f"assert len(robot.actuated_joints) == {JOINTS}",
    "numpy": f"assert actions.shape == ({JOINTS},)",
    "ONNX Runtime": f"assert actions.shape == (1, {JOINTS})",
}
"""What is asked after the lines of each tool for Python."""
SDFORMAT = """#!{python}
import ctypes, sys
assert sys.argv[1:3] == ["sdf", "-p"]
library = ctypes.CDLL("{library}")
sys.exit(library.cmdPrint(sys.argv[3].encode()))
"""
"""The command `gz sdf -p`, which calls this function of sdformat."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an exported hand with a policy."""
    history = History(make_hand_run(tmp_path_factory.mktemp("runs"), "pen_press"))
    add_policy(history, make_task("pen_press"), 0)
    folder = tmp_path_factory.mktemp("our bundle")
    unpack(build_bundle(history, "best", ["mjcf", "urdf", "ros", "stl"]).files, folder)
    return folder


def text_of(tool: str) -> str:
    observed = make_task("pen_press").observation_size
    return TOOLS[tool].text("hand", "pen_press_description", observed)


def run_python(tool: str, folder: Path, *sites: Path) -> None:
    """Run the lines of a tool in the folder of a bundle, as a stranger does, and ask what they have made."""
    program = f"{text_of(tool)}\n{FOUND[tool]}\n"
    surroundings = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, sites))}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, env=surroundings, capture_output=True, text=True, timeout=200,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def run_first_line(tool: str, folder: Path, surroundings: Mapping[str, str]) -> str:
    """Run the first line of a tool for a shell in the folder of a bundle, and return what it prints."""
    command = ["bash", "-e", "-c", text_of(tool).splitlines()[0]]
    done = subprocess.run(
        command, cwd=folder, env={**surroundings}, capture_output=True, text=True, timeout=200, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def from_the_index(place: Path, *packages: str) -> Path:
    """Install packages into a folder of their own; without a way to the package index there is nothing to ask."""
    command = [sys.executable, "-m", "pip", "install", "-q", "--only-binary", ":all:", "--no-compile"]
    try:
        done = [*command, "--target", place, *packages]
        subprocess.run(done, check=True, capture_output=True, timeout=500)
    except subprocess.SubprocessError:
        pytest.skip(f"{' '.join(packages)}: not to be had from the package index")
    return place


def test_every_tool_has_two_lines_and_whatever_is_not_run_says_why() -> None:
    for tool in TOOLS.values():
        assert len(tool.lines.splitlines()) == 2, tool.tool
        assert bool(tool.untried) == (tool.language == SHELL), tool.tool
    assert {name for name, tool in TOOLS.items() if tool.language == PYTHON} == FOUND.keys()


@pytest.mark.parametrize("tool", ["MuJoCo", "yourdfpy", "numpy", "ONNX Runtime"])
def test_the_lines_run(tool: str, folder: Path) -> None:
    run_python(tool, folder)


@pytest.mark.parametrize(("tool", "package"), [("Pinocchio", "pinocchio"), ("PyBullet", "pybullet")])
def test_the_lines_of_optional_readers_run(tool: str, package: str, folder: Path) -> None:
    if not optional(package):
        pytest.skip(f"{package} is not installed")
    run_python(tool, folder)


def test_the_parser_of_ros_reads_the_description(folder: Path) -> None:
    """It is urdfdom, whose command comes with the extra `readers`, or with Debian's package liburdfdom-tools."""
    command = shutil.which("check_urdf")
    if not command:
        pytest.skip("check_urdf is not installed")
    done = subprocess.run([command, folder / "hand.urdf"], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Successfully Parsed XML" in done.stdout


@pytest.mark.slow
def test_the_line_of_ros_2_builds_the_package(folder: Path, tmp_path: Path) -> None:
    """Debian has what builds packages of ROS 2, colcon and ament-cmake, without ROS 2 itself."""
    needed = ("share/ament_cmake", "lib/python3/dist-packages/colcon_ros", "lib/python3/dist-packages/colcon_bash")
    if not all(Path("/usr", place).is_dir() for place in needed):
        pytest.skip("install Debian's packages colcon, python3-colcon-ros, python3-colcon-bash and ament-cmake")
    (tmp_path / "ros2_ws" / "src").mkdir(parents=True)
    run_first_line("ROS 2", folder, {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"})
    share = tmp_path / "ros2_ws" / "install" / "pen_press_description" / "share"
    built = {path.relative_to(share).as_posix() for path in share.rglob("*") if path.is_file()}
    source = folder / "ros" / "pen_press_description"
    shown = {path.relative_to(source).as_posix() for path in source.rglob("*") if path.parent != source}
    assert {f"pen_press_description/{path}" for path in shown if "." in path} <= built
    assert "ament_index/resource_index/packages/pen_press_description" in built


def test_the_line_of_gazebo_runs_in_sdformat(folder: Path, tmp_path: Path) -> None:
    """It is Gazebo's own converter; Debian's package libsdformat12-12 has it, without the command `gz`."""
    library = ctypes.util.find_library("sdformat12")
    if not library:
        pytest.skip("sdformat is not installed")
    command = tmp_path / "gz"
    command.write_text(SDFORMAT.format(python=sys.executable, library=library))
    command.chmod(0o755)
    run_first_line("Gazebo", folder, os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"})
    made = (folder / "hand.sdf").read_text()
    assert made.count("<link ") >= JOINTS
    assert made.count("<joint ") >= JOINTS


@pytest.mark.slow
@pytest.mark.timeout(580)
def test_the_lines_of_drake_run(folder: Path, tmp_path: Path) -> None:
    run_python("Drake", folder, from_the_index(tmp_path / "drake", "drake"))


@pytest.mark.slow
@pytest.mark.timeout(580)
def test_the_line_of_isaac_runs_in_its_converter(folder: Path, tmp_path: Path) -> None:
    place = from_the_index(tmp_path / "converter", "urdf-usd-converter")
    paths = f"{place / 'bin'}:{os.environ['PATH']}"
    run_first_line("Isaac Sim and Isaac Lab", folder, os.environ | {"PATH": paths, "PYTHONPATH": str(place)})
    assert list((folder / "usd").glob("*.usd*"))
