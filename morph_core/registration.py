"""Names in Gymnasium's registry: morph/PenPress-v0 for `pen_press`, registered on import, without loading any task."""

from importlib.metadata import entry_points

from gymnasium.envs.registration import EnvSpec, parse_env_id, registry
from gymnasium.error import Error

BUILT_IN = ("reacher", "pen_press", "mouse_click")


def env_id(name: str) -> str:
    """Return the id under which the task `name` is registered."""
    return f"morph/{name.title().replace('_', '')}-v0"


def task_names() -> list[str]:
    """Return the names of all tasks, those of installed packages included; no task is loaded for it."""
    return sorted({*BUILT_IN, *(entry.name for entry in entry_points(group="morph.tasks"))})


class TaskSpec(EnvSpec):
    """A task's entry in the registry, whose `max_episode_steps` is the task's horizon unless another is set.

    The task is loaded when it is asked for: an import of Gymnasium must not load robots.
    """

    _limit: int | None = None
    _task: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._task = self.kwargs.get("task")  # make_vec empties kwargs in its copies

    @property
    def max_episode_steps(self) -> int | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Control steps after which an episode is cut: the horizon of the task, unless another limit is set."""
        if self._limit is None and self._task is not None:
            from morph_core.catalogue import make_task

            self._limit = make_task(self._task).horizon
        return self._limit

    @max_episode_steps.setter
    def max_episode_steps(self, limit: int | None) -> None:
        self._limit = limit


def register_tasks() -> None:
    """Register every task that is not registered yet; a name that Gymnasium does not allow is passed over."""
    for name in task_names():
        if _is_allowed(env_id(name)) and env_id(name) not in registry:
            registry[env_id(name)] = TaskSpec(
                id=env_id(name),
                entry_point="morph_core.envs:TaskEnv",
                vector_entry_point="morph_core.envs:TaskVectorEnv",
                kwargs={"task": name},
            )


def _is_allowed(name: str) -> bool:
    try:
        parse_env_id(name)
    except Error:
        return False
    return True


register_tasks()
