"""How each tool loads an exported robot and its policy, in two lines; the tests run these very lines."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

PYTHON, SHELL = "python", "sh"


@dataclass(frozen=True)
class Loading:
    """The lines by which one tool loads a file of a bundle, run in the bundle's folder."""

    tool: str
    needs: str
    """Format that the lines read."""
    language: str
    lines: str
    """Two lines, with {robot} and {package} in place of the names of this robot's files, and {size} in place of the
    number of entries of an observation."""
    note: str = ""
    """What is to be known beside the lines."""
    untried: str = ""
    """Why the tests don't run these lines, or not all of them; empty where they do."""

    def text(self, robot: str, package: str, size: int = 0) -> str:
        """Return the lines for the files of a `robot`, its ROS `package`, and a policy that sees `size` numbers."""
        words = {"{robot}": robot, "{package}": package, "{size}": str(size)}
        return functools.reduce(lambda text, word: text.replace(word, words[word]), words, self.lines)


LOADINGS: Sequence[Loading] = (
    Loading(
        "MuJoCo", "mjcf", PYTHON,
        'import mujoco\nmodel = mujoco.MjModel.from_xml_path("scene.xml")  # {robot}.xml: the robot alone',
        note="Without an installation: drop {robot}.mjz on live.mujoco.org.",
    ),
    Loading(
        "ROS 2", "ros", SHELL,
        "cp -r ros/{package} ~/ros2_ws/src/ && cd ~/ros2_ws && colcon build && source install/setup.bash\n"
        "ros2 launch {package} display.launch.py",
        note="It is shown in RViz, with a slider for each joint.",
        untried="The first line runs in a test, in Debian's colcon and ament; RViz 2 is in no package registry.",
    ),
    Loading(
        "Gazebo", "urdf", SHELL,
        "gz sdf -p {robot}.urdf > {robot}.sdf\n"
        'ros2 run ros_gz_sim create -file "$PWD/{robot}.urdf" -name {robot}  # into a world that is running',
        note="The first line shows what Gazebo makes of the robot.",
        untried="The first line runs in a test, in Debian's sdformat; Gazebo and ROS 2 are in no package registry.",
    ),
    Loading(
        "Isaac Sim and Isaac Lab", "urdf", SHELL,
        "urdf_usd_converter {robot}.urdf usd  # pip install urdf-usd-converter; open usd in Isaac Sim\n"
        './isaaclab.sh -p scripts/tools/convert_urdf.py "$PWD/{robot}.urdf" "$PWD/{robot}.usd" --fix-base'
        "  # Isaac Lab",
        note="Then set the servo gains and armatures of control.json on the joint drives.",
        untried="The first line runs in a test; Isaac Sim and Isaac Lab are in no package registry.",
    ),
    Loading(
        "Drake", "urdf", PYTHON,
        "from pydrake.all import MultibodyPlant, Parser\n"
        'plant = MultibodyPlant(0.001); Parser(plant).AddModels("{robot}.urdf"); plant.Finalize()',
    ),
    Loading(
        "Pinocchio", "urdf", PYTHON,
        'import pinocchio\nmodel = pinocchio.buildModelFromUrdf("{robot}.urdf")',
    ),
    Loading(
        "PyBullet", "urdf", PYTHON,
        'import pybullet; pybullet.connect(pybullet.DIRECT)\nrobot = pybullet.loadURDF("{robot}.urdf")',
    ),
    Loading(
        "yourdfpy", "urdf", PYTHON,
        'import yourdfpy\nrobot = yourdfpy.URDF.load("{robot}.urdf")',
    ),
)  # fmt: skip
"""Every tool that report.html has lines for."""

POLICY_LOADINGS: Sequence[Loading] = (
    Loading(
        "numpy", "mjcf", PYTHON,
        "from policy import act, size\nactions = act([0.0] * size)",
        note="policy.py reads policy.npz; `python policy.py` compares it with policy.onnx.",
    ),
    Loading(
        "ONNX Runtime", "onnx", PYTHON,
        'import numpy, onnxruntime; policy = onnxruntime.InferenceSession("policy.onnx")\n'
        'actions = policy.run(None, {"observation": numpy.zeros((1, {size}), "float32")})[0]',
    ),
)  # fmt: skip
"""Every way in which report.html shows the policy as a function."""
