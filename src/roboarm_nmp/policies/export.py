"""Save your own policy as a file that `roboarm evaluate` runs without its script.

    save_policy("policy.onnx", module, "wall", goal_type="ee")

The file's format, and what its network may compute: docs/reference/file_formats.md. For a policy
of Stable-Baselines3 see docs/reference/api.md. A function needs no file: `roboarm_nmp.evaluate`.
"""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import torch

from roboarm_nmp import envs
from roboarm_nmp.networks.export import save_network
from roboarm_nmp.networks.untrusted import NetworkError
from roboarm_nmp.policies.registry import (
    ENV_ARGUMENTS,
    OUTPUTS,
    PolicyError,
    policy_metadata,
    recurrent_size,
)
from roboarm_nmp.policies.safety_filter import SafetyFilter


def save_policy(
    path: str | Path,
    module: torch.nn.Module,
    task: str | Path,
    safety_filter: SafetyFilter | None = None,
    metadata: dict[str, Any] | None = None,
    **env_arguments: Any,
) -> None:
    """Write a module as a policy file.

    Args:
        path: the file to write, e.g. `policy.onnx`; its folder must exist.
        module: `nn.Module`. Its `forward` receives the observation by name (`observation`,
            `achieved_goal`, `desired_goal` and what else the environment observes), float32
            (N, ...), and returns deterministic actions, float32 (N, n), in [-1, 1]. It may not
            branch on values or draw random numbers. With an attribute `recurrent_size`, it also
            receives `recurrent_state` (N, recurrent_size), and returns the action and the next one.
        task: name of the task it was trained on, or path of a scene file; or `TASK@ROBOT`.
        safety_filter: a `policies.safety_filter.SafetyFilter` that belongs to the policy.
        metadata: more metadata of the file, which JSON can write.
        env_arguments: the arguments of `roboarm_nmp.make` it was trained with: those of
            `policies.registry.ENV_ARGUMENTS`. Others define success, and are not stored.

    Raises:
        PolicyError: it cannot be exported, its actions have another shape or type, or an argument
            is not one of `ENV_ARGUMENTS`. An old file stays as it is.
        ValueError: `task` or `env_arguments` are not accepted by `roboarm_nmp.make`.
        OSError: the file cannot be written.
    """
    unknown = sorted(set(env_arguments) - set(ENV_ARGUMENTS))
    if unknown:
        raise PolicyError(
            f"{', '.join(unknown)}: not among the arguments that a policy stores, which are "
            f"{', '.join(ENV_ARGUMENTS)}"
        )
    env = envs.make(task, **env_arguments)
    robot = env.unwrapped.robot
    observations = [env.reset(seed=seed)[0] for seed in (0, 1)]
    env.close()
    example = {
        name: torch.stack([torch.from_numpy(observation[name]) for observation in observations])
        for name in observations[0]
    }
    arguments = {"goal_type": env.goal_type, **env_arguments}
    metadata = policy_metadata(task, arguments, robot, safety_filter) | (metadata or {})
    outputs = OUTPUTS[:1]
    if size := recurrent_size(module):
        outputs = OUTPUTS
        metadata["recurrent_size"] = size
        example["recurrent_state"] = torch.zeros(len(observations), size)
    with torch.no_grad():
        action = copy.deepcopy(module).cpu().eval()(**example)
    if size:
        action, _ = action
    shape = (len(observations), robot.num_joints)
    if not isinstance(action, torch.Tensor) or action.shape != shape:
        got = tuple(action.shape) if isinstance(action, torch.Tensor) else type(action).__name__
        raise PolicyError(f"{path}: actions for {shape[0]} observations must be {shape}, got {got}")
    try:
        save_network(path, module, example, metadata, outputs)
    except NetworkError as error:
        raise PolicyError(str(error)) from error


def save_path_policy(
    path: str | Path,
    module: torch.nn.Module,
    task: str | Path,
    safety_filter: SafetyFilter | None,
    curves: torch.Tensor,
    every: int,
    line: int,
    num_points: int,
    metadata: dict[str, Any],
) -> None:
    """Write a network that draws whole paths as a policy file (`policies.generative`).

    Args:
        path, task, safety_filter, metadata: as for `save_policy`.
        module: `nn.Module`. Its `forward` receives `generative.input_shapes` by name, and `scene`,
            observed points (N, 3 * num_points), and returns what it expects at the flow's end
            (N, c * n).
        curves: (c, k): the curves of a path's coefficients, at each of its k configurations.
        every, line: as for `generative.input_shapes`.

    Raises: as `save_policy`.
    """
    from roboarm_nmp.envs.collision.distance_field import DistanceField  # Numba is slow to import
    from roboarm_nmp.policies.generative import input_shapes

    robot = envs.get_task(task).base_scene.robot
    spheres = DistanceField(robot).num_spheres
    shapes = input_shapes(robot.num_joints, spheres, curves.shape, every, line)
    rng = np.random.default_rng(0)
    example = {
        name: torch.from_numpy(rng.random((2, *shape), np.float32))
        for name, shape in (shapes | {"scene": (3 * num_points,)}).items()
    }
    arguments = {
        "goal_type": "combined",
        "encoder": "point_cloud",
        "num_points": num_points,
        "geometry_source": "point_cloud",
        "link_distances": True,
    }
    metadata = policy_metadata(task, arguments, robot, safety_filter) | metadata
    metadata["paths"] = {"curves": curves.tolist(), "every": every, "line": line}
    try:
        save_network(path, module, example, metadata, ["path"])
    except NetworkError as error:
        raise PolicyError(str(error)) from error
