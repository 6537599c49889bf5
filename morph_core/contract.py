"""What every task must keep, checked in a few milliseconds: shapes, types and finite numbers of one step."""

import numpy as np

from morph_core.task import Task

_ENVIRONMENTS = 2


def check_task(task: Task) -> None:
    """Raise ValueError with the first thing in which a task breaks the contract of `morph_core.task.Task`."""
    if not task.name or not task.title or not task.name.replace("_", "").isalnum():
        raise ValueError(f"a task needs a title, and a name of letters, digits and underscores, not {task.name!r}")
    if task.horizon < 1 or not task.control_dt > 0:
        raise ValueError(f"{task.name}: horizon and control_dt must be positive")
    space, rng = task.design_space, np.random.default_rng(0)
    hw_phy = task.hw_phy(np.tile(space.initial, (_ENVIRONMENTS, 1)))
    s = task.reset(hw_phy, _ENVIRONMENTS, rng)
    _expect(task, "reset", s, (task.state_size,))
    _expect(task, "initial_action", task.initial_action, (task.action_size,), rows=())
    observation = task.observe(s)
    _expect(task, "observe", observation, (task.observation_size,), np.float32)
    step = task.step(hw_phy, s, rng.uniform(-1, 1, (_ENVIRONMENTS, task.action_size)))
    for name, size in (("s", task.state_size), ("a", task.action_size), ("z", task.z_size)):
        _expect(task, f"step().{name}", getattr(step, name), (size,))
    for name in ("reward", "terminated", "diverged", "success"):
        _expect(task, f"step().{name}", getattr(step, name), (), float if name == "reward" else np.bool_)
    for kind, table in (("reward_terms", step.reward_terms), ("milestones", step.milestones)):
        for name, values in table.items():
            _expect(task, f"step().{kind}[{name!r}]", values, ())
    if step.contact.shape[0] != _ENVIRONMENTS or step.contact.shape[-1] != 3:
        raise ValueError(f"{task.name}: step().contact must be ({_ENVIRONMENTS}, C, 3), not {step.contact.shape}")
    _expect(task, "proxy_input", task.proxy_input(s, step.a), (task.proxy_input_size,), np.float32)
    s, a = task.sample_pairs(_ENVIRONMENTS, rng)
    _expect(task, "sample_pairs()[0]", s, (task.state_size,))
    _expect(task, "sample_pairs()[1]", a, (task.action_size,))
    _check_models(task, space.initial)


def _check_models(task: Task, phi: np.ndarray) -> None:
    """Raise ValueError unless robot and scene compile and `qpos` fits the scene."""
    robot, scene = task.spec(phi).compile(), task.scene(phi).compile()
    s = task.reset(task.hw_phy(phi), 1, np.random.default_rng(0))
    qpos, simulated = task.qpos(s), (task.qvel(s), task.ctrl(s, np.zeros((1, task.action_size))))
    if qpos.shape != (1, scene.nq) or robot.nq > scene.nq:
        raise ValueError(f"{task.name}: qpos must be (1, {scene.nq}) as the scene has it, not {qpos.shape}")
    for name, values, size in zip(("qvel", "ctrl"), simulated, (scene.nv, scene.nu), strict=True):
        if values is not None:
            _expect(task, name, values, (size,), rows=(1,))


def _expect(
    task: Task, what: str, values: object, shape: tuple[int, ...], kind: type | None = None,
    rows: tuple[int, ...] = (_ENVIRONMENTS,),
) -> None:  # fmt: skip
    """Raise ValueError unless `values` is a finite array of this shape and type."""
    wanted = (*rows, *shape)
    if not isinstance(values, np.ndarray) or values.shape != wanted:
        found = values.shape if isinstance(values, np.ndarray) else type(values).__name__
        raise ValueError(f"{task.name}: {what} must be an array {wanted}, not {found}")
    if kind is not None and values.dtype != kind:
        raise ValueError(f"{task.name}: {what} must be {np.dtype(kind).name}, not {values.dtype}")
    if not np.isfinite(values).all():
        raise ValueError(f"{task.name}: {what} must be finite for the initial design")
