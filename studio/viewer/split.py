"""The parts of a scene: the robot, what else moves, and what never moves."""

import mujoco

from studio.viewer.figure import Figure

_FIXED = ("goal", "wall", "table")
"""Words with which the names of what never moves begin."""


def names_of(robot: mujoco.MjSpec) -> set[str]:
    """Return the names of a robot's bodies and geoms; to compile it for them would take as long as the scene does."""
    return {body.name for body in robot.bodies} - {"world"} | {geom.name for geom in robot.geoms} - {""}


def split(whole: Figure, of_robot: set[str]) -> tuple[Figure, Figure, Figure]:
    """Return the robot, whose bodies and geoms have these names; what else moves; and what never moves."""
    fixed = [i for i, name in enumerate(whole.names) if name.startswith(_FIXED)]
    robot = [i for i, name in enumerate(whole.names) if name in of_robot and i not in fixed]
    objects = [i for i in range(len(whole)) if i not in fixed and i not in robot]
    return whole.take(robot), whole.take(objects), whole.take(fixed)
