"""Where the viewer and images take queries from: tasks, problems, and recorded motions."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from roboarm_nmp import envs
from roboarm_nmp.datasets.cloud_flags import CloudFlags, observed_scene
from roboarm_nmp.datasets.demonstrations import demo_path, load_demos
from roboarm_nmp.datasets.format import ORIGINAL, SPLITS, DatasetError, OutOfDateError
from roboarm_nmp.datasets.problems import load_problems
from roboarm_nmp.datasets.queries import Query, load_queries, query_path
from roboarm_nmp.datasets.roadmap_paths import load_roadmap_paths
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.subgoals import subgoals
from roboarm_nmp.evaluation.submissions import (
    Replayer,
    queries_of,
    read_actions,
    read_description,
)
from roboarm_nmp.motions.trajectories import load_trajectory

MAX_SECONDS = 3600  # of a trajectory from a file
MAX_TRIES = 1000  # configurations, for a query among points
DEMO = "demo"
"""Instead of a policy's name: the task's demonstrations."""
RANDOM = "random"
ALL_SPLITS = (*SPLITS, ORIGINAL, RANDOM)


@dataclass(frozen=True)
class Episodes:
    """Queries to choose from, and recorded motions on them, if any.

    Attributes:
        task: name of their task, or path of a scene file.
        splits: names of the parts that they are in.
        count: function from a split to the number of queries; None where there is no end.
        get: function from a split and a number to a `Query` and the recorded normalised
            configurations (k, n), None without a recording.
        recording: what a recording is called; None where there are none.
        note: why the queries are random ones; empty otherwise.
        left_out: m, (n, 3), points of a cloud that are no obstacles.
    """

    task: str
    splits: tuple[str, ...]
    count: Callable[[str], int | None]
    get: Callable[[str, int], tuple[Query, np.ndarray | None]]
    recording: str | None = None
    note: str = ""
    left_out: np.ndarray | None = None

    def split(self, wanted: str) -> str:
        """The split of this name, or the only one that there is."""
        return self.splits[0] if len(self.splits) == 1 else wanted

    def label(self, split: str, number: int) -> str:
        """What a query is called in messages, such as `test query 3`."""
        return f"{split} query {number}" if split in ALL_SPLITS else f"{split} {number}"

    def find(self, split: str, number: int) -> tuple[Query, np.ndarray | None]:
        """As `get`. Raises ValueError: there is no such query."""
        if split not in self.splits:
            raise ValueError(
                f"there are no {split} queries of {self.task}: {', '.join(self.splits)}"
            )
        count = self.count(split)
        if number < 0 or (count is not None and number >= count):
            last = "" if count is None else f": the numbers are 0 to {count - 1}"
            raise ValueError(f"no {self.label(split, number)}{last}")
        return self.get(split, number)


def task_episodes(task: str, seed: int = 0) -> Episodes:
    """The `Episodes` of a task's queries.

    Where the task has no query file, or one that was made for another version of the scene, its
    queries are random ones of the seed.

    Args:
        task: name of a task, or path of a scene file.
        seed: of random queries.

    Raises:
        ValueError: there is no such task, or its scene or query file cannot be used.
    """
    envs.get_task(task)
    if not query_path(task).exists():
        return _random_episodes(task, seed, "no query file")
    queries = {}
    for split in (*SPLITS, ORIGINAL):
        try:
            queries[split] = load_queries(task, split)
        except OutOfDateError:
            return _random_episodes(task, seed, "its queries are out of date and left out")
        except DatasetError:
            if split != ORIGINAL:  # which most tasks do not have
                raise
    return Episodes(
        task,
        tuple(queries),
        lambda split: len(queries[split]),
        lambda split, number: (queries[split][number], None),
    )


def _random_episodes(task: str, seed: int, note: str) -> Episodes:
    env = envs.make(task)

    def get(split, number):
        rng = np.random.default_rng([seed, number])
        env.sample_scene(rng)
        try:
            start, goal = env.sample_moving_query(rng)
        except RuntimeError as error:
            raise ValueError(f"{task}: {error}") from error
        return Query(start, goal, env.scene), None

    return Episodes(task, (RANDOM,), lambda split: None, get, note=note)


def demonstration_episodes(task: str, file: Path | None = None) -> Episodes:
    """The `Episodes` of demonstrations: of a file, by default the task's.

    Raises DatasetError: there are none.
    """
    path = demo_path(task) if file is None else file
    if not path.exists():
        raise DatasetError(f"{task} has no demonstrations: no file {path}")
    demos = load_demos(path, task)

    def get(split, number):
        demo = demos[number]
        return Query(demo.start, demo.goal, demo.scene), demo.states

    return Episodes(task, ("demonstration",), lambda split: len(demos), get, "demonstration")


def entry_episodes(task: str, folder: str | Path) -> Episodes:
    """The `Episodes` of a task in the folder of an entry to the benchmark.

    Raises SubmissionError: it is none, or without this task.
    """
    queries = queries_of(read_actions(folder, task), split=read_description(folder)["split"])
    replayer = Replayer(Path(folder), task, queries)
    return Episodes(
        task,
        ("entry query",),
        lambda split: len(replayer.episodes),
        lambda split, number: (replayer.query(number), replayer.trajectory(number).states),
        "entry",
    )


def problem_episodes(path: str | Path, task: str) -> Episodes:
    """The `Episodes` of a file or folder of problems, for the arm of a task.

    Raises DatasetError: it has none.
    """
    problems = load_problems(path, envs.get_task(task).base_scene.robot)
    return Episodes(
        task,
        ("problem",),
        lambda split: len(problems),
        lambda split, number: (problems.query(number), None),
    )


def roadmap_episodes(folder: str | Path) -> Episodes:
    """The `Episodes` of a folder of roadmap paths. Raises DatasetError: it is none."""
    paths = load_roadmap_paths(folder)

    def get(split, number):
        scene = paths.scenes[int(np.searchsorted(paths.path_offsets, number, side="right")) - 1]
        points = paths.points[paths.offsets[number] : paths.offsets[number + 1]]
        path = scene.robot.denormalise(points)
        query = Query(path[0].astype(np.float32), path[-1].astype(np.float32), scene)
        return query, subgoals(path, scene.robot).astype(np.float32)

    count = len(paths.offsets) - 1
    return Episodes(paths.task, ("roadmap path",), lambda split: count, get, "roadmap path")


def cloud_episodes(
    task: str, flags: CloudFlags, seed: int = 0, trajectory: Path | None = None
) -> Episodes:
    """The `Episodes` among the points of a cloud: random queries, or a file of a trajectory.

    Args:
        task: without obstacles of its own; it names the arm.
        flags: with a cloud.
        seed: of random queries.
        trajectory: the file.

    Raises ValueError: the task has obstacles, or a file cannot be used.
    """
    from roboarm_nmp.envs.collision.checker import CollisionChecker  # Numba takes a while

    base = envs.get_task(task).scene
    if not isinstance(base, Scene) or base.obstacles:
        raise ValueError(
            f"{task} has obstacles of its own: give --cloud with no_obstacles, or with "
            "no_obstacles@FILE for another arm"
        )
    robot = base.robot
    recorded = None
    start = robot.contact_free
    if trajectory is not None:
        recorded = trajectory_episodes(task, trajectory)
        start = recorded.get("scene", 0)[0].start
    scene, left_out = observed_scene(flags, robot, np.asarray(start), find_left_out=True)
    if recorded is not None:
        query, states = recorded.get("scene", 0)
        query = query._replace(scene=scene)
        return replace(recorded, get=lambda split, number: (query, states), left_out=left_out)
    env, checker = envs.make(scene), CollisionChecker(scene)

    def get(split, number):
        rng, ends = np.random.default_rng([seed, number]), []
        for _ in range(MAX_TRIES):
            configuration = env.sample_feasible(rng)
            if checker.is_free(np.clip(robot.normalise(configuration), -1.0, 1.0)):
                ends.append(configuration)
            if len(ends) == 2:
                return Query(ends[0], ends[1], scene), None
        raise ValueError(
            f"{flags.cloud}: the arm is free of its points almost nowhere: check --frame, --units "
            "and --point-radius"
        )

    note = f"in the points of {flags.cloud}"
    return Episodes(task, (RANDOM,), lambda split: None, get, note=note, left_out=left_out)


def trajectory_episodes(task: str, path: str | Path, seed: int = 0) -> Episodes:
    """The `Episodes` of a file of a trajectory, in the task's scene; or in those of its queries.

    Raises ValueError: there is no such task, or the file is no trajectory of its arm.
    """
    scene = envs.get_task(task).scene
    trajectory = load_trajectory(path, envs.get_task(task).base_scene.robot)
    if trajectory.duration > MAX_SECONDS:
        raise DatasetError(f"{path}: it is longer than {MAX_SECONDS} s")
    start, goal = trajectory.positions[[0, -1]].astype(np.float32)
    states = trajectory.robot.normalise(trajectory.frames()).astype(np.float32)
    if isinstance(scene, Scene):
        query = Query(start, goal, scene)
        return Episodes(
            task,
            ("scene",),
            lambda split: None,
            lambda split, number: (query, states),
            "trajectory",
        )
    queries = task_episodes(task, seed)

    def get(split, number):
        return Query(start, goal, queries.get(split, number)[0].scene), states

    return replace(queries, get=get, recording="trajectory")
