"""Submissions to the benchmark: a folder with the actions of each test query, and what they claim.

    write_submission("entry", method, "my planner", tasks=["double_walls"], num_queries=1000)
    row = verify_submission("entry", workers=2)    # replays every episode, recomputes every number

A submission is `submission.yaml` (who, how, and the claimed numbers) and one HDF5 file per task.
Because episodes replay bit for bit, nobody has to believe a claim: `verify_submission` executes the
actions and compares. docs/reference/file_formats.md describes the files.
"""

import functools
import hashlib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml

from roboarm_nmp import envs
from roboarm_nmp.datasets.format import (
    DatasetError,
    check_plain,
    check_schema,
    get_array,
    hdf5_bytes,
    offsets_of,
    open_hdf5,
    read_attributes,
)
from roboarm_nmp.datasets.problems import Problems
from roboarm_nmp.datasets.queries import Queries, Query, load_queries
from roboarm_nmp.envs.goals import GOAL_TYPES
from roboarm_nmp.evaluation.evaluate import (
    EvaluationError,
    Outcome,
    RecordedEpisode,
    episode_outcome,
    problem_queries,
    rates_and_means,
    record,
    trajectory_digest,
)
from roboarm_nmp.evaluation.rollout import Episode
from roboarm_nmp.motions.trajectories import Trajectory
from roboarm_nmp.policies.policy import Method, Policy
from roboarm_nmp.utils import workers
from roboarm_nmp.utils.documents import DocumentError, load_document, plain_data
from roboarm_nmp.utils.files import write_atomically
from roboarm_nmp.utils.progress import progress_bar, write_line

TRACKS = {
    "fixed goals": ("double_walls", "boxes"),
    "unseen obstacles": ("random_boxes_hard", "three_shelves", "narrow_shelves"),
    "moving obstacles": ("moving_boxes_medium", "chased_goals"),
    "MotionBenchMaker": (
        *("bookshelf_tall_panda", "bookshelf_thin_panda", "box_panda", "table_pick_panda"),
    ),
}
"""The benchmark's tasks. MotionBenchMaker's are sets of problems, which users have to fetch."""
PROBLEM_SETS = TRACKS["MotionBenchMaker"]
SCHEMA, VERSION = "roboarm-nmp benchmark actions", 1
DESCRIPTION = {
    "method": str,
    "command": str,
    "split": str,
    "versions": str,
    "authors": str,
    "link": str,
    "observes": str,
    "searches": bool,
    "privileged": bool,
    "training_data": str,
    "developed_on": list,
    "hardware": str,
    "licence": str,
    "training_seeds": int,
}
"""What a submission says about its method, and the types."""
FIXED = ("method", "command", "split", "observes", "searches", "privileged", "versions")
"""What stays the same while a submission is continued."""
OBSERVES = ("nothing", "point cloud", "latent code", "ground truth")
MAX_QUERIES = 10_000
CHUNK = 10  # queries that a worker verifies at a time
CLAIMS = (
    *("success_rate", "collision_free_success_rate", "collision_rate"),
    *("mean_steps", "path_length", "duration", "mean_jerk"),
)
"""Numbers of `roboarm_nmp.evaluate` that a submission claims for each task."""
POSE_TOLERANCES: dict[str, Any] = {"ee_tolerance": 0.01, "angle_tolerance": math.radians(15)}
"""When a goal pose is reached: as in Motion Policy Networks (Fishman et al., 2022)."""
ROUNDING = 1e-9  # relative, of means that are computed again


class SubmissionError(ValueError):
    """A submission that cannot be used, or whose claims do not hold."""


@dataclass(frozen=True)
class TaskActions:
    """The episodes of one task in a submission.

    Attributes:
        task: its name.
        goal_type, action_mode: of the environment in which the actions were chosen.
        queries_digest: of the queries and scenes, as of `queries_digest`.
        offsets: int64 (m + 1,): the actions of query i are `actions[offsets[i] : offsets[i + 1]]`.
        actions: float32 (T, n).
        success, collision: bool (m,).
        digests: uint32 (m,), of the motions, `RecordedEpisode.digest`.
        seconds: float32 (m,), s, of the method's own computation.
    """

    task: str
    goal_type: str
    action_mode: str
    queries_digest: str
    offsets: np.ndarray
    actions: np.ndarray
    success: np.ndarray
    collision: np.ndarray
    digests: np.ndarray
    seconds: np.ndarray

    def __len__(self) -> int:
        """The number of queries."""
        return len(self.digests)

    def of_query(self, i: int) -> np.ndarray:
        """The actions of query i: float32 (t, n)."""
        return self.actions[self.offsets[i] : self.offsets[i + 1]]


def benchmark_queries(
    task: str, problems: str | Path | None = None, split: str = "test"
) -> Queries | Problems:
    """The queries of a task; of a set of problems, those in `problems`/TASK.h5.

    Raises SubmissionError: the set is not there, or some of its problems cannot be used.
    """
    if task not in PROBLEM_SETS:
        return load_queries(task, split)
    if split != "test":
        raise SubmissionError(f"{task}: a set of problems has no {split} queries")
    if problems is None:
        raise SubmissionError(f"{task}: needs MotionBenchMaker's problems (--problems FOLDER)")
    try:
        return problem_queries(Path(problems) / f"{task}.h5")
    except (DatasetError, EvaluationError, OSError) as error:
        raise SubmissionError(f"{task}: {error}") from error


def queries_of(
    episodes: TaskActions, problems: str | Path | None = None, split: str = "test"
) -> Queries | Problems:
    """The queries of a submission's episodes. Raises SubmissionError: here, they are others."""
    available = benchmark_queries(episodes.task, problems, split)
    queries = available[: len(episodes)]
    if len(queries) < len(episodes) or episodes.queries_digest != queries_digest(queries):
        raise SubmissionError(f"{episodes.task}: made with other queries or scenes than those here")
    return queries


def _env_task(task: str) -> str:
    """The task whose environment the queries of `task` are solved in."""
    return "no_obstacles" if task in PROBLEM_SETS else task


def queries_digest(queries: Queries | Problems) -> str:
    """SHA-256 of queries and their scenes, which tells versions of a task apart."""
    digest = hashlib.sha256(queries.start.tobytes() + queries.goal.tobytes())
    for i in range(len(queries)):
        digest.update(repr(queries.scenes[i]).encode())
    return digest.hexdigest()


def versions() -> str:
    """The versions that a replay depends on."""
    names = ("roboarm-nmp", "pybullet", "numpy")
    return ", ".join(f"{name} {version(name)}" for name in names)


# --- Writing


def write_submission(
    folder: str | Path,
    policy: str | Path | Policy | Method,
    description: dict[str, Any],
    tasks: Iterable[str],
    num_queries: int = 1000,
    progress: bool = False,
    problems: str | Path | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Run a method on the first queries of tasks, and write its submission.

    Tasks that are in the folder already are kept, so an interrupted run continues.

    Args:
        folder: is made if there is none.
        policy, options: as of `roboarm_nmp.evaluate`.
        description: values of `DESCRIPTION` without `versions`; `split` is `test` or, to choose
            something, `validation`.
        tasks: names of tasks.
        num_queries: of each task, at most; a set of problems may have fewer.
        progress: show a progress bar.
        problems: folder with a file SET.h5 for each set of problems among the tasks.

    Returns:
        The contents of `submission.yaml`.

    Raises:
        EvaluationError: as of `evaluate`.
        SubmissionError: the folder holds a submission of another method, or of the same one that
            was run otherwise.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    document = {**description, "versions": versions(), "tasks": {}}
    if (folder / "submission.yaml").exists():
        document = _continued(folder, document)
    if options.get("goal_type") == "pose":
        options["env"] = POSE_TOLERANCES
    for task in tasks:
        queries = benchmark_queries(task, problems, document["split"])[:num_queries]
        path = folder / f"{task}.h5"
        if task in document["tasks"] and path.exists():
            kept = document["tasks"][task].get("num_queries")
            if kept != len(queries):
                raise SubmissionError(
                    f"{path} has {kept} queries, not {len(queries)}: delete it, or use another "
                    "--output"
                )
            write_line(f"{task}: kept from an earlier run; to run it again, delete {path}")
            continue
        write_line(f"{task}: {len(queries):,} queries")
        env_task = _env_task(task)
        result, episodes = record(policy, env_task, queries=queries, progress=progress, **options)
        contents = _task_bytes(task, result, queries_digest(queries), episodes)
        write_atomically(path, contents)
        failed = [i for i, episode in enumerate(episodes) if not episode.success]
        if failed:
            others = " …" if len(failed) > 20 else ""
            write_line(f"{task}: not reached: {', '.join(map(str, failed[:20]))}{others}")
        seconds = np.mean([episode.seconds for episode in episodes])
        document["tasks"][task] = {
            "num_queries": len(queries),
            "sha256": hashlib.sha256(contents).hexdigest(),
            **{name: result[name] for name in CLAIMS},
            "seconds_per_query": float(f"{seconds:.3g}"),
        }
        text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
        write_atomically(folder / "submission.yaml", text.encode())
    return document


def _continued(folder: Path, document: dict[str, Any]) -> dict[str, Any]:
    """The contents of a submission that is continued. Raises SubmissionError: it is another."""
    before = read_description(folder)
    for name in DESCRIPTION:
        if before[name] != document[name]:
            change = f"{name} is {before[name]!r}, not {document[name]!r}"
            if name in FIXED:
                raise SubmissionError(
                    f"{folder} was begun otherwise, use another --output: {change}"
                )
            write_line(f"{folder}/submission.yaml: {change}; it stays, edit it there")
    return before


def _task_bytes(
    task: str, result: dict[str, Any], digest: str, episodes: list[RecordedEpisode]
) -> bytes:
    """The contents of a task's file."""
    attributes: dict[str, str | int] = {
        "schema": SCHEMA,
        "schema_version": VERSION,
        "task": task,
        "goal_type": result["goal_type"],
        "action_mode": result["env"].get("action_mode", "relative"),
        "queries_digest": digest,
    }
    packed = {"compression": "gzip", "compression_opts": 9, "shuffle": True}
    arrays = {
        "length": np.array([len(episode.actions) for episode in episodes], np.uint16),
        "actions": np.concatenate([episode.actions for episode in episodes]),
        "success": np.array([episode.success for episode in episodes], np.uint8),
        "collision": np.array([episode.collision for episode in episodes], np.uint8),
        "digests": np.array([episode.digest for episode in episodes], np.uint32),
        "seconds": np.array([episode.seconds for episode in episodes], np.float32),
    }
    return hdf5_bytes(attributes, [(name, array, packed) for name, array in arrays.items()])


# --- Reading


def read_description(folder: str | Path) -> dict[str, Any]:
    """The contents of a folder's `submission.yaml`.

    Raises SubmissionError: it is missing, damaged, or an entry is missing or of another type.
    """
    path = Path(folder) / "submission.yaml"
    try:
        document = plain_data(load_document(path, allow_tags=False))
    except (DocumentError, OSError) as error:
        raise SubmissionError(str(error)) from error
    if not isinstance(document, dict):
        raise SubmissionError(f"{path}: must be a mapping")
    for name, kind in DESCRIPTION.items():
        if type(document.get(name)) is not kind:
            raise SubmissionError(f"{path}: {name} must be a {kind.__name__}")
    if document["observes"] not in OBSERVES:
        raise SubmissionError(f"{path}: observes must be one of {', '.join(OBSERVES)}")
    tasks = document.get("tasks")
    if not isinstance(tasks, dict) or not tasks:
        raise SubmissionError(f"{path}: tasks must be a mapping from tasks to results")
    for task, claims in tasks.items():
        if task not in (*envs.TASKS, *PROBLEM_SETS):
            raise SubmissionError(f"{path}: no such task: {task}")
        numbers = [claims.get(name) for name in CLAIMS] if isinstance(claims, dict) else [""]
        if not all(number is None or type(number) in (int, float) for number in numbers):
            raise SubmissionError(f"{path}: {task}: must have the numbers {', '.join(CLAIMS)}")
    return document


def read_actions(folder: str | Path, task: str) -> TaskActions:
    """The episodes of a task.

    Raises SubmissionError: the file is missing, damaged, or holds what cannot be executed.
    """
    path = Path(folder) / f"{task}.h5"
    try:
        with open_hdf5(path) as file:
            check_schema(path, file, "a benchmark submission", SCHEMA, VERSION)
            check_plain(path, file)
            names = ("task", "goal_type", "action_mode", "queries_digest")
            attributes = read_attributes(path, file, dict.fromkeys(names, str))
            length, *others = (
                _array(path, file, name, dtype)
                for name, dtype in (
                    ("length", np.uint16),
                    ("success", np.uint8),
                    ("collision", np.uint8),
                    ("digests", np.uint32),
                    ("seconds", np.float32),
                )
            )
            joints = envs.get_task(_env_task(task)).base_scene.robot.num_joints
            offsets = offsets_of(length)
            actions = _array(path, file, "actions", np.float32, (int(offsets[-1]), joints))
    except DatasetError as error:
        raise SubmissionError(str(error)) from error
    if attributes["task"] != task or attributes["goal_type"] not in GOAL_TYPES:
        raise SubmissionError(f"{path}: of the task {attributes['task']!r}, or damaged")
    if any(len(array) != len(length) for array in others) or not len(length):
        raise SubmissionError(f"{path}: its arrays have different lengths")
    if not np.isfinite(actions).all():
        raise SubmissionError(f"{path}: some actions are not finite")
    success, collision, digests, seconds = others
    return TaskActions(
        **attributes,
        offsets=offsets,
        actions=actions,
        success=success.astype(bool),
        collision=collision.astype(bool),
        digests=digests,
        seconds=seconds,
    )


def _array(path, file: h5py.File, name, dtype, shape=None) -> np.ndarray:
    dataset = get_array(path, file, name)
    fits = dataset.shape == shape if shape else dataset.ndim == 1 and len(dataset) <= MAX_QUERIES
    if dataset.dtype != dtype or not fits:
        raise DatasetError(f"{path}: {name} has shape {dataset.shape} and type {dataset.dtype}")
    return dataset[:]


# --- Verifying


def verify_submission(
    folder: str | Path,
    num_workers: int = 1,
    progress: bool = False,
    problems: str | Path | None = None,
) -> dict[str, Any]:
    """Replay every episode of a submission, and compare with what it claims.

    Args:
        folder: of the submission.
        num_workers: processes.
        progress: show a progress bar per task.
        problems: as of `write_submission`.

    Returns:
        The row for the table: the contents of `submission.yaml`, its numbers computed again, with
        their intervals.

    Raises:
        SubmissionError: a file cannot be used; the queries are of another version of the task; an
            episode ends differently than claimed, and then the message names the first such query;
            or a claimed number is another.
    """
    document = read_description(folder)
    if document["split"] != "test":
        raise SubmissionError(
            f"{folder}: of {document['split']} queries; entries are of test queries"
        )
    for task, claims in document["tasks"].items():
        path = Path(folder) / f"{task}.h5"
        episodes = read_actions(folder, task)
        if claims.get("sha256") != hashlib.sha256(path.read_bytes()).hexdigest():
            write_line(f"{path}: changed since submission.yaml was written")
        queries = queries_of(episodes, problems)
        try:
            outcomes = _replay_all(path, episodes, queries, num_workers, progress)
        except SubmissionError as error:
            if document["versions"] == versions():
                raise
            hint = f"made with {document['versions']}; here is {versions()}"
            raise SubmissionError(f"{error} ({hint})") from error
        numbers = rates_and_means(outcomes)
        for name in CLAIMS:
            claim = claims.get(name)
            if not _agree(claim, numbers[name]):
                reason = f"{name} is {numbers[name]}, not {claim} as claimed"
                raise SubmissionError(f"{folder}: {task}: {reason}")
        intervals = {name: numbers[name] for name in numbers if name.endswith("_interval")}
        document["tasks"][task] = {
            "num_queries": len(episodes),
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
            "queries_digest": episodes.queries_digest,
            "goal_type": episodes.goal_type,
            **{name: numbers[name] for name in CLAIMS},
            **intervals,
            "seconds_per_query": float(f"{episodes.seconds.mean():.3g}"),
        }
    return document


def _agree(claimed: float | None, number: float | None) -> bool:
    if claimed is None or number is None:
        return claimed is number
    return bool(np.isclose(claimed, number, rtol=ROUNDING, atol=0.0))


def _replay_all(path, episodes, queries, num_workers, progress) -> list[Outcome]:
    """The outcomes of all queries, in their order."""
    count = len(episodes)
    chunks = [range(first, min(first + CHUNK, count)) for first in range(0, count, CHUNK)]
    make = functools.partial(Replayer, path.parent, episodes.task, queries)
    if num_workers == 1:
        results = map(make(), chunks)
    else:
        results = workers.run(make, (), chunks, min(num_workers, len(chunks)), write_line)
    outcomes, different = {}, []
    with progress_bar(total=count, unit="query", disable=not progress) as bar:
        for indices, chunk in results:
            for index, (outcome, mistake) in zip(indices, chunk, strict=True):
                outcomes[index] = outcome
                if mistake is not None:
                    different.append((index, mistake))
            bar.update(len(indices))
    if different:
        index, mistake = min(different)
        others = f", and {len(different) - 1} others differ, too" if len(different) > 1 else ""
        raise SubmissionError(f"{path}: query {index}: {mistake}{others}")
    return [outcomes[index] for index in range(count)]


class Replayer:
    """Replays the episodes of a task in the folder of a submission."""

    def __init__(self, folder: Path, task: str, queries: Queries | Problems):
        self.episodes = read_actions(folder, task)
        self.queries = queries
        tolerances = POSE_TOLERANCES if self.episodes.goal_type == "pose" else {}
        self.env = envs.make(
            _env_task(task),
            goal_type=self.episodes.goal_type,
            action_mode=self.episodes.action_mode,
            **tolerances,
        )

    def __call__(self, indices: range) -> tuple[range, list[tuple[Outcome, str | None]]]:
        """`indices`, and of each query its outcome and what differs from the claim."""
        return indices, [self._replay(index) for index in indices]

    def query(self, index: int) -> Query:
        """The query of an episode."""
        queries = self.queries
        return Query(queries.start[index], queries.goal[index], queries.scenes[index])

    def trajectory(self, index: int) -> Trajectory:
        """What the actions of an episode lead to, until it ends."""
        episode = Episode(self.env, self.query(index))
        for action in self.episodes.of_query(index):
            if episode.ended:
                break
            episode.step(action)
        return episode.trajectory()

    def _replay(self, index: int) -> tuple[Outcome, str | None]:
        episodes, mistake = self.episodes, None
        trajectory = self.trajectory(index)
        steps, count = len(trajectory.actions), len(episodes.of_query(index))
        if steps < count:
            mistake = f"it ends after {steps} of {count} actions"
        outcome = episode_outcome(trajectory)
        for name, claims in (("success", episodes.success), ("collision", episodes.collision)):
            if outcome[name] != claims[index]:
                mistake = f"{name} is {outcome[name]}, not {bool(claims[index])} as claimed"
        if mistake is None and trajectory_digest(trajectory) != episodes.digests[index]:
            mistake = "its motion is another one than was recorded"
        return outcome, mistake
