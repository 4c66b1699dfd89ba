"""RoboArm-NMP's environments. `make(task)` builds one; importing registers the Gymnasium ids."""

import gymnasium

from envs.arm_env import RoboArmEnv
from envs.tasks import TASKS, get_task

__all__ = ["TASKS", "RoboArmEnv", "get_task", "gymnasium_id", "make"]


def make(task, encoder=None, **kwargs):
    """The environment of a task, e.g. `make("double_walls", goal_type="ee")`.

    Args:
        task: name of a task (`TASKS`), or path of a scene file (docs/your_own_scene.md).
        encoder: what is appended to `observation` about the scene: path of an encoder's network, or
            `oracle` (`envs.encoders`); None for nothing.
        kwargs: arguments of `RoboArmEnv`.

    Raises:
        ValueError: unknown task, malformed scene file, an argument out of its range, or a file
            that is no encoder.
    """
    env = RoboArmEnv(get_task(task).scene, **kwargs)
    if encoder is None:
        return env
    from envs.encoders import scene_encoder  # here, because it imports torch
    from envs.wrappers import SceneEncodingWrapper

    return SceneEncodingWrapper(env, scene_encoder(encoder))


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
