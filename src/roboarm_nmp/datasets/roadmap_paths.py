"""Files of roadmap paths (`demo_generation.roadmaps`): a folder of shards of a few scenes each.

    paths = load_roadmap_paths("roadmaps/hard")   # thousands of scenes in about a second
    paths.scenes[i]                               # the Scene of number i
    paths.of_scene(i)                             # its paths: list of float32 (k, j), normalised
    paths.points, paths.offsets                   # the same, flat, for a whole folder

A shard, `shard_00012.h5`, has the arrays

- `obstacle_count` uint32 (n,) and `obstacles` float64 (k, 11): the scenes, one after another, as
  rows of `envs.scenes.primitives.to_array`; where there are convex hulls, `hull_vertices` float64
  (v, 3), their vertices, one hull after another;
- `path_count` uint32 (n,): paths in each scene; `length` uint16 (m,): points of each path;
- `points` float32 (p, j): normalised configurations, one path after another, the first point of
  each the start, the last one the goal

of a robot with j joints, and the attributes `schema`, `schema_version`, `task`, `seed`, `first`
(number of the first scene), `scene` (JSON: the scene without the obstacles that vary), `made_by`.
"""

import io
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from roboarm_nmp.datasets import shards
from roboarm_nmp.datasets.format import (
    DatasetError,
    QueryScenes,
    attribute,
    read_base_scene,
)
from roboarm_nmp.datasets.shards import (
    read_array,
    read_vertices,
    shard_paths,
    write_attributes,
)
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import hull_vertices, scene_to_json, to_array
from roboarm_nmp.envs.tasks import get_task, task_name

SCHEMA, SCHEMA_VERSION = "roboarm-nmp roadmap paths", 1
_ARRAYS = ("obstacle_count", "obstacles", "path_count", "length", "points")


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
    scenes: QueryScenes | list
    path_offsets: np.ndarray
    points: np.ndarray
    offsets: np.ndarray

    def __len__(self):
        """The number of scenes."""
        return len(self.path_offsets) - 1

    def of_scene(self, i):
        """The paths of scene i: a list of float32 (k, j)."""
        first, last = self.path_offsets[i : i + 2]
        ends = self.offsets[first : last + 1]
        return [self.points[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True)]


def shard_bytes(task, seed, first, scenes, paths, made_by):
    """The contents of a shard's file.

    Args:
        task: name of the task, path of a scene file, or `TASK@ROBOT`.
        seed: of the collection, an int.
        first: number of the first scene.
        scenes: list of n `Scene`s.
        paths: list of n lists of float32 (k, j), normalised.
        made_by: the command line that makes the shards.
    """
    flat = [path for of_scene in paths for path in of_scene]
    base = get_task(task).base_scene
    if not all(scene.is_static for scene in scenes):
        raise DatasetError("roadmap paths are of static scenes: obstacles of this task move")
    obstacles = [o for scene in scenes for o in scene.obstacles]
    if any(obstacle.may_touch for obstacle in obstacles):
        raise DatasetError("files of roadmap paths cannot have random obstacles with may_touch")
    arrays = {
        "obstacle_count": np.array([len(scene.obstacles) for scene in scenes], np.uint32),
        "obstacles": to_array(obstacles),
        "path_count": np.array([len(of_scene) for of_scene in paths], np.uint32),
        "length": np.array([len(path) for path in flat], np.uint16),
        "points": np.concatenate([np.empty((0, base.robot.num_joints), np.float32), *flat]),
    }
    if len(vertices := hull_vertices(obstacles)):
        arrays["hull_vertices"] = vertices
    attributes = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "task": task_name(task),
        "seed": int(seed),
        "first": int(first),
        "scene": scene_to_json(base),
        "made_by": made_by,
    }
    contents = io.BytesIO()
    with h5py.File(contents, "w", libver=("v110", "v110")) as file:
        write_attributes(file, attributes)
        for name, array in arrays.items():
            file.create_dataset(name, data=array, track_times=False, fletcher32=array.size > 0)
    return contents.getvalue()


def open_shard(path):
    """A context with the `h5py.File` of a shard. Raises DatasetError: as `shards.open_shard`."""
    return shards.open_shard(path, "roadmap paths", SCHEMA, SCHEMA_VERSION)


def load_roadmap_paths(folder, robot=PANDA):
    """All of a folder's `RoadmapPaths`, which must be those of `robot`.

    Of several folders (a sequence), the scenes of one come after those of another, and `task` and
    `seed` are those of the first.

    Raises:
        DatasetError: there are no shards, or one is missing, damaged, or not of the same collection
            as the others; or they were made for another robot.
    """
    if not isinstance(folder, (str, Path)):
        return _joined([load_roadmap_paths(one, robot) for one in folder])
    parts, vertices, first = {name: [] for name in _ARRAYS}, [], None
    for path in shard_paths(folder, "roadmap paths"):
        with open_shard(path) as file:
            found = {name: attribute(file, name) for name in ("task", "seed", "scene")}
            for name, part in parts.items():
                part.append(read_array(file, path, name))
            vertices.append(read_vertices(file, path))
        first = first or found
        for name, value in found.items():
            if value != first[name]:
                raise DatasetError(f"{path}: its {name} differs from that of the first shard")
    arrays = {name: np.concatenate(part) for name, part in parts.items()}
    obstacles, paths, offsets = (
        np.concatenate([[0], np.cumsum(arrays[name], dtype=np.int64)])
        for name in ("obstacle_count", "path_count", "length")
    )
    base = read_base_scene(folder, first["scene"], robot)
    indices = np.arange(len(arrays["path_count"]))
    scenes = QueryScenes(base, indices, obstacles, arrays["obstacles"], np.concatenate(vertices))
    return RoadmapPaths(first["task"], first["seed"], scenes, paths, arrays["points"], offsets)


def _joined(parts):
    """One `RoadmapPaths` of several."""
    if len(parts) == 1:
        return parts[0]
    scenes = [part.scenes[i] for part in parts for i in range(len(part))]
    path_offsets, offsets = (
        np.concatenate([[0], np.cumsum(np.concatenate([np.diff(one) for one in of_parts]))])
        for of_parts in ([part.path_offsets for part in parts], [part.offsets for part in parts])
    )
    points = np.concatenate([part.points for part in parts])
    return RoadmapPaths(parts[0].task, parts[0].seed, scenes, path_offsets, points, offsets)
