"""Every task as gymnasium.Env and VectorEnv, registered as morph/<Task>-v0: other libraries can train on them."""

from morph_core.envs.single import TaskEnv
from morph_core.envs.vector import TaskVectorEnv
from morph_core.registration import env_id

__all__ = ["TaskEnv", "TaskVectorEnv", "env_id"]
