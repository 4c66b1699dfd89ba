"""Following a plan in the simulator, which turns it into a demonstration."""

import zlib
from dataclasses import dataclass

import numpy as np

from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.subgoals import subgoals

# Share of the tolerances of every goal type within which the goal counts as reached: rounding the
# stored configurations must not undo that.
INSIDE = 0.9
# After the last sub-goal, the goal is commanded for at most so many steps until it is reached. More
# steps risk a collision: at full speed the arm may swing beyond the goal.
SETTLE_STEPS = 10


@dataclass(frozen=True)
class Execution:
    """The execution of a plan.

    Attributes:
        states: float32 (m + 1, n), the normalised configuration before each step and at the end.
        collided: whether there was any contact.
        reached: whether the end is well inside the tolerances of every goal type.
        digest: CRC-32 of the bytes of `states`; the same for exactly the same executions.
    """

    states: np.ndarray
    collided: bool
    reached: bool
    digest: int


def follow(env: RoboArmEnv, path: np.ndarray, scene: Scene | None = None) -> Execution:
    """Follow a path, one sub-goal per step, from its first configuration to its last.

    Args:
        env: a `RoboArmEnv` with relative actions and a `max_step` of at least 0.03.
        path: float32 (k, n), rad.
        scene: a `Scene` to change the environment to first.

    Raises:
        ValueError: the first or last configuration is in collision or outside the limits.
    """
    observation, info = env.reset_specific(path[0], path[-1], scene)
    joints = env.robot.num_joints
    targets = subgoals(path, env.robot)[1:]
    states = [observation["observation"][:joints]]
    for step in range(len(targets) + SETTLE_STEPS):
        if step >= len(targets) and _reached(env, info):
            break
        target = targets[min(step, len(targets) - 1)]
        observation, _, _, _, info = env.step(target - states[-1])
        states.append(observation["observation"][:joints])
    states = np.stack(states)
    return Execution(
        states,
        collided=info["collision_so_far"],
        reached=_reached(env, info),
        digest=zlib.crc32(states.tobytes()),
    )


def _reached(env, info):
    return (
        info["ee_distance"] <= INSIDE * env.ee_tolerance
        and info["config_distance"] <= INSIDE * env.config_tolerance
    )
