"""Show a task as an image, or an episode as an animation.

    roboarm show double_walls --output image.png
    roboarm show my_scene.yaml --output images.png --draws 9
    roboarm show wall --output episode.gif --policy runs/my_run
    roboarm show wall --output demonstration.gif --policy demo --query 7
    roboarm show random_boxes_hard@ur5.yaml --output episode.gif --policy planner
    roboarm show wall --output above.png --camera -90 -90
    roboarm show wall --policy planner --save-trajectory episode.csv
    roboarm show wall --output episode.gif --trajectory episode.csv
    roboarm show --cloud table.ply --trajectory path.csv --output path.png
    roboarm show wall --output episode.gif --entry my_entry --query 3
    roboarm show --problems problems.h5 --query 3 --output image.png

The arm is white. The green ball is the goal position of the end effector. Where the goal is a
configuration, the arm at the goal is shown in transparent green; the goal type `ee` has no such
configuration. An image shows the start; the image of a trajectory also shows transparent arms along
the motion, and the end effector's path (blue). `roboarm view` shows the same in the browser.

With a point cloud, the points that `roboarm plan` avoids are orange balls, and the points that it
leaves out are grey: points of the table, the floor and the arm, outliers, and points out of reach.
"""

import contextlib
import io
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from PIL import Image

from roboarm_nmp import envs
from roboarm_nmp.datasets.cloud_flags import CloudFlags, check_without_cloud
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.motions.trajectories import STEP_SECONDS, check_ending, save_trajectory
from roboarm_nmp.policies.registry import find_policy, make_policy
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import check_writable, write_atomically
from roboarm_nmp.utils.flags import FiniteFloat, NonNegativeInt, Pixels, PositiveInt, Seed
from roboarm_nmp.utils.progress import progress_bar
from roboarm_nmp.utils.signals import end_with_one_line, error_line
from roboarm_nmp.viewer.episodes import (
    DEMO,
    Episodes,
    cloud_episodes,
    demonstration_episodes,
    entry_episodes,
    problem_episodes,
    task_episodes,
    trajectory_episodes,
)
from roboarm_nmp.viewer.images import SIZE, render_configurations, save_motions


@dataclass(kw_only=True)
class Args(CloudFlags):
    task: tyro.conf.Positional[str | None] = None
    """The task's name, or the path of a scene file (.yaml). Not needed with --problems or
    --cloud; another arm beside a cloud is no_obstacles@FILE."""
    problems: Path | None = None
    """A file or folder of problems, as of `roboarm import`; --query is the number of a problem."""
    output: Path | None = None
    """The file to write: an image (.png) or an animation (.gif)."""
    policy: str = "go-to-goal"
    """The policy in an animation: `go-to-goal` (straight to the goal configuration), `random`,
    `via-points`, `planner` (as in clean_rl_scripts/evaluate.py), a policy network, a run's folder
    with a `policy.onnx` in it, or the name of a pretrained policy (docs/benchmark/results.md).
    `demo` replays the task's demonstrations; --query is then the number of a demonstration."""
    demos: Path | None = None
    """With `--policy demo`: this file of demonstrations instead of the task's own."""
    entry: Path | None = None
    """Replay the episode of --query in this entry to the benchmark, a folder of `roboarm benchmark
    run`, instead of a policy's."""
    goal_type: Literal["ee", "config", "combined", "pose"] | None = None
    """What the goal is; by default the policy's own, otherwise `combined`. For `ee`, the goal is a
    position: there is no ghost of the arm."""
    query: NonNegativeInt = 0
    """Number of the (first) query to show, from 0."""
    split: Literal["test", "validation", "original"] = "test"
    """Which of the task's queries. Without a query file, random queries are shown."""
    draws: PositiveInt = 1
    """Images in a .png: this many queries, from --query on, side by side. Where scenes vary, each
    query has its own."""
    size: tuple[Pixels, Pixels] = SIZE
    """Width and height of one image in pixels."""
    camera: tuple[FiniteFloat, FiniteFloat] | None = None
    """Direction of the view, YAW PITCH in degrees. Yaw 0 is from the arm's right, 90 from its
    front, 180 from its left; pitch -90 looks straight down, 0 horizontally. By default from a
    corner from which obstacles do not hide the arm."""
    trajectory: Path | None = None
    """Play this file (.csv, .npz, .json, .yaml) instead of a policy's episode: a file of
    `roboarm retime`, of --save-trajectory, or your own. A .csv needs columns `q1` to `q7` (rad; as
    many as joints), and may have `time` (s); a .npz an array `configurations` (k, n), and perhaps
    `times`; a .yaml is ROS's trajectory_msgs/JointTrajectory. The arm is moved without physics, in
    the scene of --query; the ghost is the end."""
    save_trajectory: Path | None = None
    """Write the episode to this file (.csv, .npz, .json): configurations, actions, contacts, times;
    or its configurations to a .yaml for ROS."""
    seed: Seed = 0
    """Of random queries, and of `random`, `via-points` and `planner`."""


def _check(args: Args):
    """Raises ValueError for arguments that cannot be used, before any work."""
    flags.check(args)
    recordings = (args.trajectory is not None, args.policy == DEMO, args.entry is not None)
    if sum(recordings) > 1:
        raise ValueError("--trajectory, --policy demo and --entry are recordings: give one of them")
    is_recording = any(recordings)
    if args.demos is not None and args.policy != DEMO:
        raise ValueError("--demos goes with --policy demo")
    if args.problems is not None:
        args.task = "no_obstacles" if args.task is None else args.task
        if is_recording:
            raise ValueError(
                "--problems goes with a policy, not with a trajectory, demonstrations or an entry"
            )
    if args.cloud is not None:
        args.task = "no_obstacles" if args.task is None else args.task
        if args.problems is not None or args.policy == DEMO or args.entry is not None:
            raise ValueError("--cloud goes with a trajectory or a policy: leave out the recording")
    else:
        check_without_cloud(args)
    if args.task is None:
        raise ValueError("name a task or a scene file, or give --problems FILE")
    envs.get_task(args.task)
    if args.output is None and args.save_trajectory is None:
        raise ValueError(
            "give --output FILE.png or --output FILE.gif; `roboarm view` opens the browser instead"
        )
    ending = None if args.output is None else args.output.suffix.lower()
    if args.output is not None:
        if ending not in (".png", ".gif"):
            raise ValueError(f"--output must end in .png or .gif, got {args.output}")
        check_writable(args.output)
    if args.draws > 1 and ending != ".png":
        raise ValueError("--draws goes with --output FILE.png")
    if args.trajectory is not None:
        if args.policy != Args.policy:
            raise ValueError("--trajectory plays a file, --policy runs a policy: give one of them")
        if args.draws > 1:
            raise ValueError("--draws goes with queries, not with --trajectory")
    if args.save_trajectory is not None:
        check_ending(args.save_trajectory)
        check_writable(args.save_trajectory)
        if is_recording:
            raise ValueError("--save-trajectory goes with a policy: a file need not be saved again")
        if ending == ".png":
            raise ValueError("--save-trajectory goes with --output FILE.gif, or without --output")


def _episodes(args: Args, task: str) -> Episodes:
    if args.cloud is not None:
        return cloud_episodes(task, args, args.seed, args.trajectory)
    if args.trajectory is not None:
        return trajectory_episodes(task, args.trajectory, args.seed)
    if args.problems is not None:
        return problem_episodes(args.problems, task)
    if args.entry is not None:
        return entry_episodes(task, args.entry)
    if args.policy == DEMO:
        return demonstration_episodes(task, args.demos)
    return task_episodes(task, args.seed)


def _show(args: Args):
    _check(args)
    task = str(args.task)
    policy, arguments = None, {}
    if args.policy != DEMO and args.trajectory is None and args.entry is None:
        policy, arguments = find_policy(args.policy)
    own_goal_type = arguments.get("goal_type")
    if None not in (own_goal_type, args.goal_type) and own_goal_type != args.goal_type:
        raise ValueError(
            f"{args.policy} was trained with the goal type {own_goal_type!r}, it cannot be shown "
            f"with {args.goal_type!r}"
        )
    arguments = arguments | {"goal_type": own_goal_type or args.goal_type or "combined"}
    episodes = _episodes(args, task)
    if episodes.note:
        print(f"{task}: {episodes.note}: random queries of seed {args.seed}")
    if args.output is not None and args.output.suffix.lower() == ".png":
        _draw(args, args.output, episodes, arguments["goal_type"])
    else:
        _animate(args, episodes, policy, arguments)


def _draw(args: Args, output: Path, episodes: Episodes, goal_type: str):
    """Write an image of queries, side by side."""
    split, last = episodes.split(args.split), args.query + args.draws - 1
    episodes.find(split, last)
    images = []
    with contextlib.closing(envs.make(episodes.task, goal_type=goal_type)) as env:
        numbers = range(args.query, last + 1)
        for number in progress_bar(numbers, "drawing", unit="image", transient=True):
            query, states = episodes.find(split, number)
            configurations = [query.start]
            if states is not None and args.trajectory is not None:
                configurations = query.scene.robot.denormalise(states)
            images += render_configurations(
                env,
                query,
                configurations,
                args.size,
                camera=args.camera,
                left_out=episodes.left_out,
                swept=args.trajectory is not None,
            )
    columns = math.ceil(math.sqrt(args.draws))
    width, height = args.size
    grid = Image.new(
        "RGB", (columns * width, math.ceil(args.draws / columns) * height), (255, 255, 255)
    )
    for i, image in enumerate(images):
        grid.paste(Image.fromarray(image), (i % columns * width, i // columns * height))
    contents = io.BytesIO()
    grid.save(contents, "PNG", optimize=True)
    write_atomically(output, contents.getbuffer())
    until = f" to {last}" if args.draws > 1 else ""
    print(f"{output}: written, {args.task}, {episodes.label(split, args.query)}{until}")


def _animate(args: Args, episodes: Episodes, policy, arguments: dict):
    """Run or replay an episode; write its animation, its trajectory, or both."""
    query, states = episodes.find(episodes.split(args.split), args.query)
    try:
        env = envs.make(episodes.task, **arguments)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{args.policy}: its environment cannot be made: {error}") from error
    with contextlib.closing(env):
        trajectory = None
        if states is None:
            act = make_policy(policy, env, args.seed)(args.query, query).act
            trajectory = rollout(env, query, act)
            states = trajectory.states
        configurations = query.scene.robot.denormalise(states)
        outcome = _outcome(args, episodes, env, query, configurations, trajectory)
        if args.output is not None:
            save_motions(
                args.output,
                env,
                query,
                [configurations],
                size=args.size,
                camera=args.camera,
                left_out=episodes.left_out,
            )
            print(f"{args.output}: written, {args.task}, {outcome}")
    if args.save_trajectory is not None and trajectory is not None:
        save_trajectory(args.save_trajectory, trajectory)
        what = "the trajectory" if args.output is not None else f"{args.task}, {outcome}"
        print(f"{args.save_trajectory}: written, {what}")


def _outcome(args, episodes, env, query, configurations, trajectory):
    """The result of an episode in words; `trajectory` is None where none was simulated."""
    steps = len(configurations) - 1
    name = episodes.label(episodes.split(args.split), args.query)
    if trajectory is not None:
        reached = "reached the goal" if trajectory.success else "did not reach the goal"
        contact = "with contact" if trajectory.collides else "collision-free"
        return f"{name}, {args.policy}: {reached} in {steps} steps, {contact}"
    if args.trajectory is None:
        return f"{name}: {steps} steps"
    world = env.unwrapped.world
    world.set_scene(query.scene)
    colliding = sum(
        world.in_collision(configuration, step * STEP_SECONDS)
        for step, configuration in enumerate(configurations)
    )
    contact = f"in collision in {colliding} of {steps + 1} configurations"
    return (
        f"{args.trajectory}: {steps * STEP_SECONDS:.1f} s, "
        f"{contact if colliding else 'collision-free'}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """The command. Returns the exit code: 0, or 2 where nothing can be shown."""
    args = flags.parse(Args, arguments, others="image")
    try:
        _show(args)
    except (OSError, ValueError) as error:
        print(error_line(error), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    end_with_one_line("nothing was written")
    sys.exit(main())
