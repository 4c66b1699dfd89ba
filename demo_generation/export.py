"""Export demonstrations to the formats of other libraries: LeRobot's and Minari's datasets.

    roboarm export --format lerobot --task double_walls --output double_walls_lerobot
    roboarm export --format minari --task double_walls --goal-type ee
    roboarm export --format minari --task no_obstacles@arm.yaml

`lerobot` writes a folder, version 3.0 of LeRobot's format, with the whole motions in rad. `minari`
writes into Minari's local storage, `~/.minari/datasets` or the folder in MINARI_DATASETS_PATH:
`minari.load_dataset("roboarm-nmp/double_walls/ee-v0")` has the demonstrations as episodes of the
task's environment, each up to the first step that reaches its goal.

Demonstration files round configurations to 0.0002 of the normalised space. That is exact enough for
training, but the errors accumulate when the actions of an episode are replayed: one episode in a
hundred ends just short of its goal. With --exact, replaying the actions of a Minari dataset repeats
the episode.

Both formats have no scenes, and Minari makes the environment again from its Gymnasium id and
arguments. So this works for fixed scenes, not for scenes that vary. Files of a scene or of another
arm are named by their absolute paths: on another machine, `recover_environment(task=...)` names
them.
"""

import contextlib
import importlib.util
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import gymnasium
import numpy as np

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import Demo, Demos, demo_path, load_demos
from roboarm_nmp.datasets.episodes import demo_episode
from roboarm_nmp.datasets.lerobot import write_lerobot
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.following import follow
from roboarm_nmp.envs.subgoals import MAX_STEP, subgoals
from roboarm_nmp.envs.tasks import has_name, split_robot
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import check_folder
from roboarm_nmp.utils.progress import progress_bar
from roboarm_nmp.utils.signals import end_with_one_line, error_line

PREFIX = ".exporting-"  # of incomplete folders; Minari ignores hidden ones
GoalType = Literal["ee", "config", "combined", "pose"]


@dataclass
class Args:
    format: Literal["lerobot", "minari"]
    """Format of the dataset. Each needs the extra of its name."""
    task: str | None = None
    """Task with a fixed scene, a name or a scene file, with another arm as TASK@FILE: export its
    demonstrations."""
    file: Path | None = None
    """Demonstration file to export instead of the task's own. Those of a scene file, or of another
    arm, need --task, too."""
    output: Path | None = None
    """LeRobot: the folder to write. The default is `<task>_lerobot` in this folder."""
    images: bool = False
    """LeRobot: add an image to each frame (about 50 frames a second)."""
    goal_type: GoalType = "ee"
    """Minari: kind of the goals."""
    dataset_id: str | None = None
    """Minari's name for the dataset. The default is `roboarm-nmp/<task>/<goal type>-v0`, or
    `roboarm-nmp/<task>-<robot>/<goal type>-v0`."""
    exact: bool = False
    """Minari: follow the plans again for exact configurations (about 50 episodes a second)."""
    overwrite: bool = False
    """Replace the dataset, if it exists."""


def unrounded(demo: Demo, env: RoboArmEnv) -> Demo:
    """The demonstration with its exact states and actions, by following its plan in `env`.

    Raises ValueError: the execution differs on this machine.
    """
    execution = follow(env, demo.plan)
    if execution.digest != demo.digest:
        raise ValueError(
            "the executions differ on this machine: repair them with `roboarm verify FILE --repair`"
        )
    states = execution.states
    points = subgoals(demo.plan, env.robot)
    actions = points[np.minimum(np.arange(1, len(states)), len(points) - 1)] - states[:-1]
    actions *= np.minimum(1.0, MAX_STEP / np.linalg.norm(actions, axis=1, keepdims=True))
    return replace(demo, states=states, actions=actions.astype(np.float32))


def episode(demo: Demo, env: RoboArmEnv) -> dict:
    """A demonstration as the environment would have recorded it, up to reaching the goal.

    Args:
        demo: an `datasets.demonstrations.Demo`.
        env: a `RoboArmEnv` with relative actions and no velocities.

    Returns:
        A dict with the fields of Minari's `EpisodeBuffer`, for T actions: `observations`, a dict of
        float32 arrays (T + 1, ...), `actions`, float32 (T, j), `rewards`, float32 (T,),
        `terminations` and `truncations`, bool (T,), `infos`, a dict with `is_success`, bool
        (T + 1,).
    """
    observation, achieved, desired, action, success = demo_episode(demo, env)
    truncations = np.zeros(len(action), bool)
    truncations[-1] = not success[-1]  # the recording ends, but not the episode
    return {
        "observations": {
            "observation": observation,
            "achieved_goal": achieved,
            "desired_goal": np.tile(desired, (len(observation), 1)),
        },
        "actions": action,
        "rewards": env.compute_reward(achieved[1:], desired, {}),
        "terminations": success[1:],
        "truncations": truncations,
        "infos": {"is_success": success},
    }


def _recoverable(demos: Demos, task: str | None) -> tuple[str, dict]:
    """The id and arguments with which Minari makes the environment of every episode again.

    Raises ValueError: it could not.
    """
    if demos.scenes.index is not None:
        raise ValueError(
            f"the scenes of {demos.task} vary, and a Minari episode does not store its scene: only "
            f"demonstrations in a fixed scene can be exported"
        )
    if demos.task in envs.TASKS:
        return envs.gymnasium_id(demos.task), {}
    if task is None:
        raise ValueError(
            f"the demonstrations' task {demos.task!r} is not in envs.TASKS: name its scene file, "
            f"or the robot's file, with --task"
        )
    parts = [part for part in split_robot(task) if part is not None]
    task = "@".join(part if has_name(part) else str(Path(part).resolve()) for part in parts)
    return envs.gymnasium_id(task), {"task": task}


@contextlib.contextmanager
def _removed_afterwards(folder: Path):
    try:
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def export(
    demos: Demos,
    goal_type: GoalType = "ee",
    dataset_id: str | None = None,
    exact: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    task: str | None = None,
) -> tuple[str, int]:
    """Write `Demos` into Minari's local storage; returns the dataset's id and number of steps.

    Args:
        dataset_id: a name with a version, `namespace/name-v0`; None for the default.
        exact: follow the plans again, see above.
        overwrite: replace a dataset of this name. The old one stays until the new one is complete.
        task: path of the scene file, or `TASK@ROBOT`, that the demonstrations are for, unless their
            task is in `envs.TASKS`.

    Raises:
        ImportError: Minari is not installed.
        ValueError: the scenes vary, or `task` is missing; Minari does not allow the name, or there
            is a dataset of this name; or, with `exact`, the executions differ on this machine.
        OSError: the dataset cannot be written.
    """
    gymnasium_id, arguments = _recoverable(demos, task)
    if importlib.util.find_spec("minari") is None:
        raise ImportError('this needs the extra `minari`: pip install -e ".[minari]"')
    import minari
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.dataset.minari_storage import MinariStorage
    from minari.namespace import create_namespace, list_local_namespaces
    from minari.storage.datasets_root_dir import get_dataset_path

    dataset_id = dataset_id or f"roboarm-nmp/{demos.task.replace('@', '-')}/{goal_type}-v0"
    try:
        namespace, _, _ = parse_dataset_id(dataset_id)
    except (TypeError, ValueError) as error:  # a TypeError if there is no version
        message = f"bad dataset id {dataset_id!r}: it must be like namespace/name-v0"
        raise ValueError(message) from error
    path = get_dataset_path(dataset_id)
    if path.exists() and not overwrite:
        raise ValueError(f"the dataset {dataset_id} exists ({path}); --overwrite replaces it")
    planner = demos.parameters.get("options", {}).get("planner")
    origin = "Recorded motions" if planner is None else f"Plans of {planner}"
    env = gymnasium.make(gymnasium_id, goal_type=goal_type, **arguments)
    arm_env = env.unwrapped
    assert isinstance(arm_env, RoboArmEnv)

    def recorded(demo):
        return episode(unrounded(demo, arm_env) if exact else demo, arm_env)

    bar = progress_bar(range(len(demos)), dataset_id, unit="episode", disable=not progress)
    # Beside the datasets, so that a rename puts the complete one in its place.
    folder = get_dataset_path().resolve() / f"{PREFIX}{dataset_id.replace('/', '-')}"
    shutil.rmtree(folder, ignore_errors=True)  # of a killed export
    with contextlib.closing(env), _removed_afterwards(folder):
        new = folder / "new"
        new.mkdir(parents=True)
        storage = MinariStorage.new(
            new / "data", env.observation_space, env.action_space, env.spec, data_format="hdf5"
        )
        storage.update_metadata(
            {
                "dataset_id": dataset_id,
                "minari_version": minari.__version__,
                "algorithm_name": f"{origin}, followed by a position controller",
                "description": f"Verified demonstrations for the task {demos.task} "
                f"of RoboArm-NMP, goal type {goal_type}. Made by: {demos.made_by}",
            }
        )
        storage.update_episodes(EpisodeBuffer(**recorded(demos[i])) for i in bar)
        if namespace is not None and namespace not in list_local_namespaces():
            create_namespace(namespace)
        steps = storage.total_steps
        if path.exists():
            path.rename(folder / "old")
        new.rename(path)
    return dataset_id, steps


def main(args: Args):
    """The command."""
    try:
        if args.file is not None:
            demos = load_demos(args.file, args.task)
        elif args.task is not None:
            demos = load_demos(demo_path(args.task), args.task)
        else:
            raise ValueError("give --task, or the --file of a named task of the Panda")
        if args.format == "lerobot":
            name, steps = _export_lerobot(args, demos)
        else:
            name, steps = export(
                demos, args.goal_type, args.dataset_id, args.exact, args.overwrite, task=args.task
            )
    except (ImportError, OSError, ValueError) as error:  # a DatasetError is a ValueError
        sys.exit(error_line(error))
    print(f"{name}: {len(demos)} episodes, {steps} steps")


def _export_lerobot(args, demos):
    """(folder, number of frames)"""
    folder = args.output or Path(f"{demos.task.replace('@', '-')}_lerobot")
    check_folder(folder.parent)
    with contextlib.ExitStack() as stack:
        env = None
        if args.images:
            env = envs.make(args.task or demos.task, render_mode="rgb_array")
            stack.enter_context(contextlib.closing(env))
        return folder, write_lerobot(folder, demos, env, args.overwrite)


if __name__ == "__main__":
    end_with_one_line("no dataset was written")
    main(flags.parse(Args, others="dataset"))
