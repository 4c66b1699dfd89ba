"""RoboArm-NMP's environments. `make(task)` builds one; importing registers the Gymnasium ids."""

import gymnasium

from envs.arm_env import RoboArmEnv
from envs.tasks import TASKS

__all__ = ["TASKS", "RoboArmEnv", "gymnasium_id", "make"]


def make(task, **kwargs):
    """The environment of a task by name, e.g. `make("double_walls", goal_type="ee")`.

    Keyword arguments are those of `RoboArmEnv`. Raises ValueError for an unknown task.
    """
    if task not in TASKS:
        raise ValueError(f"unknown task {task!r}: one of {', '.join(TASKS)}")
    return RoboArmEnv(TASKS[task].scene, **kwargs)


def gymnasium_id(task):
    """The Gymnasium id of a task: "double_walls" -> "RoboArmNMP/DoubleWalls-v0"."""
    return f"RoboArmNMP/{task.title().replace('_', '')}-v0"


for _name in TASKS:
    gymnasium.register(
        gymnasium_id(_name),
        entry_point="envs:make",
        kwargs={"task": _name},
        disable_env_checker=True,  # it would warn each time that observations have no bounds
    )
