"""The choice of the robot that a task moves: by the kind of its member `robot`, never by its name."""

from morph_core.task import Task
from morph_core.tasks.arm import Arm
from morph_core.tasks.hand import Hand
from studio.robots.arm import ArmRobot
from studio.robots.hand import HandRobot
from studio.robots.plain import PlainRobot
from studio.robots.robot import Robot


def robot_of(task: Task) -> Robot:
    """Return what is known of the robot of a task; of one that is not known here, what its `spec` shows."""
    match task.robot:
        case Hand() as hand:
            return HandRobot(task, hand)
        case Arm():
            return ArmRobot(task)
        case _:
            return PlainRobot(task)
