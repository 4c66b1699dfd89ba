"""RoboArm-NMP's environments. `make(task)` builds one; importing registers the Gymnasium ids."""

from pathlib import Path

import gymnasium

from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.tasks import TASKS, get_task

__all__ = ["TASKS", "RoboArmEnv", "get_task", "gymnasium_id", "make"]


def make(task, encoder=None, proximity=None, append_proximity=False, **kwargs):
    """The environment of a task, e.g. `make("double_walls", goal_type="ee")`.

    Args:
        task: name of a task (`TASKS`), or path of a scene file (docs/your_own_scene.md).
        encoder: what is appended to `observation` about the scene: name or path of an encoder's
            network, `oracle` or `points` (`envs.perception.encoders`); None for nothing.
        proximity: add `proximity` to observations, how far each link is from the nearest thing
            (`envs.wrappers.ProximityWrapper`): of the true `obstacles`, of the `points` that four
            sensors saw of them, or what z_E of an encoder tells; None for nothing.
        append_proximity: with `proximity`: append it to `observation`, too, before z_E.
        kwargs: arguments of `RoboArmEnv`.

    Raises:
        ValueError: unknown task, malformed scene file, an argument out of its range, or a file
            that is no encoder.
    """
    for name, value in (("task", task), ("encoder", encoder), ("proximity", proximity)):
        if not isinstance(value, (str, Path)) and (value is not None or name == "task"):
            raise ValueError(f"{name} must be a name or a path, got {value!r}")
    if not isinstance(append_proximity, bool) or append_proximity and proximity is None:
        raise ValueError(f"append_proximity, {append_proximity!r}, is a bool and needs proximity")
    env = RoboArmEnv(get_task(task).scene, **kwargs)
    # What takes long to import is imported only where it is needed.
    if encoder is not None:
        from roboarm_nmp.envs.perception.encoders import scene_encoder
        from roboarm_nmp.envs.wrappers import SceneEncodingWrapper

        env = SceneEncodingWrapper(env, scene_encoder(encoder))
    if proximity is not None:
        from roboarm_nmp.envs.perception.point_clouds import checker_of
        from roboarm_nmp.envs.wrappers import ProximityWrapper

        env = ProximityWrapper(env, checker_of(proximity), append_proximity)
    return env


def gymnasium_id(task):
    """The Gymnasium id of a task: "double_walls" -> "RoboArmNMP/DoubleWalls-v0"."""
    return f"RoboArmNMP/{task.title().replace('_', '')}-v0"


for _name in TASKS:
    gymnasium.register(
        gymnasium_id(_name),
        entry_point="roboarm_nmp.envs:make",
        kwargs={"task": _name},
        disable_env_checker=True,  # it would warn each time that observations have no bounds
    )
