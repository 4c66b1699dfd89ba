"""Examples from roadmap paths: of motions to a goal, or whole paths, with what is observed.

    examples = RoadmapExamples("random_boxes_hard", None, encoder, find_checker, seed=1)
    examples(0)                     # of a new scene, whose roadmap is made first
    paths = load_roadmap_paths("roadmaps")
    examples = RoadmapExamples("random_boxes_hard", paths, encoder, find_checker, seed=1)
    examples(0)                     # of one of the scenes of `paths`

Examples are dicts of NumPy arrays, a row each. Of an arm with j joints and l links that may
collide:

- `observation` float32 (n, j + 3), for goal poses (n, j + 7), without the encoded scene, and
  `desired_goal` float32 (n, g);
- `link_distances` and `goal_link_distances` float32 (n, l, 1 + j), as of
  `envs.wrappers.LinkDistancesWrapper`;
- `direction` float32 (n, j): the unit vector to continue in, in normalised configurations;
- `length` float32 (n,): of the remaining path, normalised.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from roboarm_nmp.datasets.episodes import observed
from roboarm_nmp.datasets.roadmap_paths import RoadmapPaths
from roboarm_nmp.demo_generation.roadmaps import random_paths_of_scene
from roboarm_nmp.envs.collision.distance_field import DistanceField
from roboarm_nmp.envs.perception.encoders import SceneEncoder
from roboarm_nmp.envs.perception.point_clouds import observed_points
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.utils.random_streams import Stream

AHEAD = 0.1  # normalised: an example's direction is to the point of its path so far ahead
PER_PATH = 4  # examples of each chosen path, which share the link distances at its goal
MORE_SCENES = 2**20  # more than a training has

Examples = dict[str, np.ndarray]


def _scene_with_paths(task, paths, seed, number, rng):
    """Scene `number` and its paths: of `paths`, or a new one of the task if that is None."""
    if paths is not None:
        return paths.random_scene(rng)
    while True:
        scene, found = random_paths_of_scene(number, task, seed)
        if found:  # in a scene without room for the arm there may be no path
            return scene, found
        number += MORE_SCENES


@dataclass
class WholePaths:
    """Makes whole paths of one scene after the other, with what is observed of the scene.

    Attributes:
        tasks: in whose scenes roadmaps are made, in turn.
        paths, encoder, seed: as of `RoadmapExamples`. The field is of observed points.
        points: k, at equal distances along each path.
        count: paths of each scene; with fewer, some are repeated.
    """

    tasks: tuple[str, ...]
    paths: RoadmapPaths | None
    encoder: SceneEncoder
    seed: int
    points: int
    count: int = 256

    def __call__(self, number: int) -> dict[str, np.ndarray]:
        """`scene` (z,), `field`, of `DistanceField`, and `path` float32 (count, k, j)."""
        rng = np.random.default_rng([self.seed, Stream.ROADMAP_EXAMPLES, number])
        task = self.tasks[number % len(self.tasks)]
        scene, paths = _scene_with_paths(task, self.paths, self.seed, number, rng)
        chosen = rng.permutation(len(paths))
        if len(paths) < self.count:
            chosen = np.concatenate([chosen, rng.integers(len(paths), size=self.count)])
        return {
            "scene": self.encoder(scene),
            "field": DistanceField(scene.robot).of_scene(observed_points(scene), scene),
            "path": np.stack([resampled(paths[i], self.points) for i in chosen[: self.count]]),
        }


def resampled(path: np.ndarray, points: int) -> np.ndarray:
    """`points` points at equal distances along a path (n, j): float32 (points, j)."""
    steps = np.linalg.norm(np.diff(path.astype(np.float64), axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    shares = np.linspace(0.0, 1.0, points)
    return np.stack([np.interp(shares, travelled, joint) for joint in path.T], 1, dtype=np.float32)


@dataclass
class RoadmapExamples:
    """Makes the examples of one scene after the other. Equal arguments give equal examples.

    Attributes:
        task: a task, in whose scenes roadmaps are made.
        paths: `datasets.roadmap_paths.RoadmapPaths`, or None: new scenes of the task, a new roadmap
            in each.
        encoder: from a scene to its code.
        find_checker: from a scene to what computes `link_distances`, of
            `envs.perception.geometry_source.find_geometry_source`.
        seed: >= 0.
        goal_type: "config", "combined" or "pose".
        count: number of examples of each scene.
        noise: standard deviation (normalised, each joint) of configurations around the paths.
    """

    task: str
    paths: RoadmapPaths | None
    encoder: SceneEncoder
    find_checker: Callable
    seed: int
    goal_type: str = "combined"
    count: int = 4096
    noise: float = 0.03

    def __call__(self, number: int) -> tuple[np.ndarray, Examples]:
        """A scene's code, float32 (z,), and its examples. Each `number` >= 0 has its own."""
        rng = np.random.default_rng([self.seed, Stream.ROADMAP_EXAMPLES, number])
        scene, paths = _scene_with_paths(self.task, self.paths, self.seed, number, rng)
        return self.encoder(scene), self._draw(scene, paths, rng)

    def _draw(self, scene: Scene, paths: list[np.ndarray], rng: np.random.Generator) -> Examples:
        """Examples at random configurations near a scene's paths, in both directions."""
        points = np.concatenate(paths).astype(np.float64)
        ends = np.cumsum([len(path) for path in paths])
        travelled = np.concatenate([[0.0], np.linalg.norm(np.diff(points, axis=0), axis=1)])
        travelled[ends[:-1]] = 1.0  # from a path's end to the next one: any length
        travelled = np.cumsum(travelled)  # of all paths up to each point

        chosen = rng.integers(len(paths), size=-(-self.count // PER_PATH))
        chosen = np.repeat(chosen, PER_PATH)[: self.count]
        last = ends[chosen] - 1
        first = np.concatenate([[0], ends])[chosen]
        backwards = np.repeat(rng.random(-(-self.count // PER_PATH)) < 0.5, PER_PATH)[: self.count]
        rest = rng.random(self.count) * (travelled[last] - travelled[first])

        def at(rest: np.ndarray) -> np.ndarray:
            """The points on the paths from which `rest` remains."""
            where = np.where(backwards, travelled[first] + rest, travelled[last] - rest)
            i = np.searchsorted(travelled, where, side="right") - 1
            i = np.clip(i, first, last - 1)
            share = (where - travelled[i]) / (travelled[i + 1] - travelled[i])
            return points[i] + share[:, None] * (points[i + 1] - points[i])

        states = at(rest)
        states = states + self.noise * rng.standard_normal(states.shape)
        states = np.clip(states, -1.0, 1.0)
        rest = np.maximum(rest - AHEAD, 0.0)
        moves = at(rest) - states
        lengths = np.linalg.norm(moves, axis=1)

        goals, goal_of = np.unique(np.where(backwards, first, last), return_inverse=True)
        goals = points[goals]
        checker = self.find_checker(scene)
        robot = scene.robot
        goal_angles = robot.denormalise(goals)[goal_of]
        observation, _, desired_goal = observed(states, goal_angles, self.goal_type, robot)
        return {
            "observation": observation,
            "desired_goal": desired_goal,
            "link_distances": checker.link_distances(states),
            "goal_link_distances": checker.link_distances(goals)[goal_of],
            "direction": (moves / lengths[:, None]).astype(np.float32),
            "length": (lengths + rest).astype(np.float32),
        }
