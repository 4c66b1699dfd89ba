"""Files of roadmap paths (`demo_generation.roadmaps`): a folder of shards of a few scenes each.

    paths = load_roadmap_paths("roadmaps/hard")   # thousands of scenes in about a second
    paths.scenes[i]                               # the Scene of number i
    paths.of_scene(i)                             # its paths: list of float32 (k, j), normalised
    paths.points, paths.offsets                   # the same, flat, for a whole folder

docs/reference/file_formats.md describes the arrays.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from roboarm_nmp.datasets.format import QueryScenes, offsets_of, read_base_scene
from roboarm_nmp.datasets.shards import (
    ShardFormat,
    common_attributes,
    read_array,
    read_obstacles,
    scenes_from,
)
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.tasks import get_task

FORMAT = ShardFormat("roadmap paths", "roboarm-nmp roadmap paths")
open_shard = FORMAT.open


@dataclass(frozen=True)
class RoadmapPaths:
    """The paths of s scenes, n in all.

    Attributes:
        task: name of the scenes' task.
        seed: of the collection, int.
        scenes: `scenes[i]` is the `Scene` of number i, made on access.
        path_offsets: int64 (s + 1,): the paths of scene i begin at number `path_offsets[i]`.
        points: float32 (p, j), normalised configurations.
        offsets: int64 (n + 1,): path j is `points[offsets[j] : offsets[j + 1]]`.
    """

    task: str
    seed: int
    scenes: QueryScenes | list[Scene]
    path_offsets: np.ndarray
    points: np.ndarray
    offsets: np.ndarray

    def __len__(self) -> int:
        """The number of scenes."""
        return len(self.path_offsets) - 1

    def of_scene(self, i: int) -> list[np.ndarray]:
        """The paths of scene i: a list of float32 (k, j)."""
        first, last = self.path_offsets[i : i + 2]
        ends = self.offsets[first : last + 1]
        return [self.points[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True)]

    def random_scene(self, rng: np.random.Generator) -> tuple[Scene, list[np.ndarray]]:
        """One of the scenes that have paths, and its paths as of `of_scene`."""
        i = int(rng.choice(np.flatnonzero(np.diff(self.path_offsets))))
        return self.scenes[i], self.of_scene(i)


def shard_bytes(
    task: str | Path,
    seed: int,
    first: int,
    scenes: Sequence[Scene],
    paths: Sequence[Sequence[np.ndarray]],
    made_by: str,
) -> bytes:
    """The contents of a shard's file.

    `paths` has the paths of each scene, float32 (k, j), normalised. The rest is as of
    `shards.ShardFormat.to_bytes`.
    """
    flat = [path for of_scene in paths for path in of_scene]
    no_points = np.empty((0, get_task(task).base_scene.robot.num_joints), np.float32)
    arrays = {
        "path_count": np.array([len(of_scene) for of_scene in paths], np.uint32),
        "length": np.array([len(path) for path in flat], np.uint16),
        "points": np.concatenate([no_points, *flat]),
    }
    return FORMAT.to_bytes(task, seed, first, scenes, arrays, made_by)


def load_roadmap_paths(
    folder: str | Path | Sequence[str | Path], robot: Robot = PANDA
) -> RoadmapPaths:
    """Load all roadmap paths of a folder, which must be those of `robot`.

    From several folders (a sequence), the scenes come folder after folder, and `task` and `seed`
    are the first folder's.

    Raises:
        DatasetError: there are no shards, or one is missing, damaged, or not of the same collection
            as the others; or they were made for another robot.
    """
    if not isinstance(folder, (str, Path)):
        return _concat([load_roadmap_paths(one, robot) for one in folder])
    first = {}
    parts = []
    for path in FORMAT.paths(folder):
        with open_shard(path) as file:
            attributes = common_attributes(file, path, ("task", "seed", "scene"), first)
            paths = [read_array(file, path, name) for name in ("path_count", "length", "points")]
            parts.append([*read_obstacles(file, path), *paths])
        first = first or attributes
    counts, rows, vertices, path_counts, lengths, points = map(
        np.concatenate, zip(*parts, strict=True)
    )
    base = read_base_scene(folder, first["scene"], robot)
    return RoadmapPaths(
        task=first["task"],
        seed=first["seed"],
        scenes=scenes_from(base, counts, rows, vertices),
        path_offsets=offsets_of(path_counts),
        points=points,
        offsets=offsets_of(lengths),
    )


def _concat(parts):
    """One `RoadmapPaths` of several."""
    if len(parts) == 1:
        return parts[0]
    return RoadmapPaths(
        task=parts[0].task,
        seed=parts[0].seed,
        scenes=[part.scenes[i] for part in parts for i in range(len(part))],
        path_offsets=offsets_of(np.concatenate([np.diff(part.path_offsets) for part in parts])),
        points=np.concatenate([part.points for part in parts]),
        offsets=offsets_of(np.concatenate([np.diff(part.offsets) for part in parts])),
    )
