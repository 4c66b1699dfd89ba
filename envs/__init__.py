"""RoboArm-NMP's environments. `make(task)` builds one; importing registers the Gymnasium ids."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

from roboarm_nmp.envs.arm_env import RoboArmEnv, check_bool
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.tasks import TASKS, get_task

if TYPE_CHECKING:
    from roboarm_nmp.envs.perception.noise import SensorNoise

__all__ = ["TASKS", "RoboArmEnv", "get_task", "gymnasium_id", "make"]
ANY_TASK = "RoboArmNMP/Task-v0"


def make(
    task: str | Path | Scene,
    encoder: str | Path | None = None,
    num_points: int = 64,
    geometry_source: str | Path | None = None,
    link_distances: bool = False,
    append_link_distances: bool = False,
    goal_link_distances: bool = True,
    observe_every: int | None = None,
    sensor_noise: "SensorNoise | None" = None,
    **kwargs: Any,
) -> RoboArmEnv:
    """Make the environment of a task, e.g. `make("double_walls", goal_type="ee")`.

    Args:
        task: name of a task (`TASKS`), or path of a scene file (docs/customise/scene.md). Write
            `TASK@ROBOT` for another arm, where ROBOT is a robot's file (docs/customise/robot.md).
            Also a `Scene`, such as an `ObservedScene` with a point cloud
            (docs/customise/point_cloud.md).
        encoder: appends the encoded scene to `observation`: `oracle`, `point_cloud`, or the name or
            path of an encoder's network (`envs.perception.encoders`); None appends nothing.
        num_points: how many points the encoder `point_cloud` appends.
        geometry_source: where link distances come from (`envs.perception.geometry_source`):
            `ground_truth`, `point_cloud`, or the name or path of an encoder with a decoder. The
            encoder `point_cloud` then encodes points from that decoder.
        link_distances: add `link_distances` to observations, the signed distance of each link from
            the nearest obstacle and its gradient (`envs.wrappers.LinkDistancesWrapper`). Needs
            `geometry_source`.
        append_link_distances: with `link_distances`: append them to `observation`, too, before z_E.
        goal_link_distances: with `link_distances`: if the goal is a configuration, also add the
            link distances there. Use False with hindsight relabelling (docs/guide/environment.md,
            "Hindsight relabelling").
        observe_every: steps from one observation of the scene to the next. With None, static
            scenes are observed once, and others in every step
            (`envs.wrappers.ObservedSceneWrapper`).
        sensor_noise: an `envs.perception.noise.SensorNoise`; None for perfect sensors.
        kwargs: arguments of `RoboArmEnv`.

    Returns:
        A `RoboArmEnv`, possibly in wrappers, which have all of its attributes.

    Raises:
        ValueError: the task is unknown, the file of the scene or robot is malformed, an argument is
            out of range, or the encoder was not made for this robot.
    """
    if not isinstance(task, (str, Path, Scene)):
        raise ValueError(f"task must be a name or a path, got {task!r}")
    for name, value in {"encoder": encoder, "geometry_source": geometry_source}.items():
        if not isinstance(value, (str, Path, type(None))):
            raise ValueError(f"{name} must be a name or a path, got {value!r}")
    check_bool("link_distances", link_distances)
    check_bool("append_link_distances", append_link_distances)
    check_bool("goal_link_distances", goal_link_distances)
    if append_link_distances and not link_distances:
        raise ValueError("append_link_distances needs link_distances")
    if link_distances and geometry_source is None:
        raise ValueError(
            "link_distances needs a geometry_source: ground_truth, point_cloud or an encoder"
        )
    if geometry_source is not None and not link_distances and encoder != "point_cloud":
        raise ValueError("geometry_source needs link_distances or the encoder point_cloud")
    env: Any = RoboArmEnv(task if isinstance(task, Scene) else get_task(task).scene, **kwargs)
    # PyTorch and Numba take long to import, so they are imported only where they are needed.
    observes = encoder is not None or link_distances
    if observes or observe_every is not None or sensor_noise is not None:
        from roboarm_nmp.envs.wrappers import ObservedSceneWrapper

        env = ObservedSceneWrapper(env, observe_every, sensor_noise)
    if encoder is not None:
        from roboarm_nmp.envs.perception.encoders import make_encoder
        from roboarm_nmp.envs.wrappers import SceneEncodingWrapper

        decoded_by = None if geometry_source in ("ground_truth", "point_cloud") else geometry_source
        scene_encoder = make_encoder(encoder, num_points, decoded_by)
        scene_encoder.check_robot(env.robot)
        env = SceneEncodingWrapper(env, scene_encoder)
    if link_distances:
        from roboarm_nmp.envs.perception.geometry_source import find_geometry_source
        from roboarm_nmp.envs.wrappers import LinkDistancesWrapper

        env = LinkDistancesWrapper(
            env,
            find_geometry_source(geometry_source, env.robot),
            append_link_distances,
            goal_link_distances,
            find_geometry_source(geometry_source, env.robot, fine=True),
        )
    return env


def gymnasium_id(task: str) -> str:
    """The Gymnasium id of a task: "double_walls" -> "RoboArmNMP/DoubleWalls-v0".

    Tasks that are not in `TASKS`, of scene files and other arms, share the id `ANY_TASK`, whose
    argument `task` is that of `make`.
    """
    return f"RoboArmNMP/{task.title().replace('_', '')}-v0" if task in TASKS else ANY_TASK


for _name in (*TASKS, None):
    gymnasium.register(
        gymnasium_id(_name) if _name else ANY_TASK,
        entry_point="roboarm_nmp.envs:make",
        kwargs={"task": _name} if _name else {},
        # Without wrappers `reset_specific` and all other attributes are reached directly. The env
        # itself refuses a step before a reset; the checker would warn of unbounded observations.
        order_enforce=False,
        disable_env_checker=True,
    )
