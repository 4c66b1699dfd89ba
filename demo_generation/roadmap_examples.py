"""Examples of motions to a goal, from roadmap paths: what a policy observes, and its labels.

    paths = load_roadmap_paths("roadmaps")
    examples = RoadmapExamples(paths, find_geometry_source("ground_truth"), seed=1)
    batch = examples.draw(0, count=256, noise=0.03)        # from one scene, anywhere on its paths
    batch = examples.label(scene, states, goals, rng)      # from given configurations (DAgger)

Examples are dicts of NumPy arrays, a row each:

Of an arm with j joints and l links that may collide:

- `observation` float32 (n, j + 3), for goal poses (n, j + 7), without the encoded scene, and
  `desired_goal` float32 (n, g);
- `link_distances` and `goal_link_distances` float32 (n, l, 1 + j), as of
  `envs.wrappers.LinkDistancesWrapper`;
- `direction` float32 (n, j): the unit vector to continue in, in normalised configurations;
- `length` float32 (n,): of the remaining path, normalised;
- `scene` int64 (n,): its index in `paths.scenes`.
"""

from collections.abc import Callable

import numpy as np

from roboarm_nmp.datasets.episodes import observed
from roboarm_nmp.datasets.roadmap_paths import RoadmapPaths
from roboarm_nmp.demo_generation.roadmaps import Roadmap
from roboarm_nmp.envs.perception.geometry_source import ground_truth_checker
from roboarm_nmp.utils.random_streams import Stream

AHEAD = 0.1  # normalised: an example's direction is to the point of its path so far ahead
PER_PATH = 4  # examples of each chosen path, which share the link distances at its goal

Examples = dict[str, np.ndarray]


class RoadmapExamples:
    """Makes examples. Equal arguments give equal examples.

    Args:
        paths: `datasets.roadmap_paths.RoadmapPaths`.
        geometry_source: from a scene to what computes `link_distances`, of
            `envs.perception.geometry_source.find_geometry_source`.
        seed: of `draw`, >= 0.
        goal_type: "config", "combined" or "pose".
    """

    def __init__(
        self,
        paths: RoadmapPaths,
        geometry_source: Callable,
        seed: int,
        goal_type: str = "combined",
    ):
        self.paths = paths
        self.geometry_source = geometry_source
        self.seed = seed
        self.goal_type = goal_type
        self._scenes = np.flatnonzero(np.diff(paths.path_offsets))  # those that have paths
        steps = np.linalg.norm(np.diff(paths.points, axis=0), axis=1)
        steps[paths.offsets[1:-1] - 1] = 1.0  # from a path's end to the next one: any length
        # Length of all paths up to each point.
        self._travelled = np.concatenate([[0.0], np.cumsum(steps, dtype=np.float64)])

    def choose_paths(
        self, rng: np.random.Generator, number: int
    ) -> tuple[int, np.ndarray, np.ndarray]:
        """A random scene, and the first and last points of `number` of its paths: indices."""
        scene = int(rng.choice(self._scenes))
        begin, end = self.paths.path_offsets[scene : scene + 2]
        path = rng.integers(begin, end, number)
        return scene, self.paths.offsets[path], self.paths.offsets[path + 1] - 1

    def random_query(self, rng: np.random.Generator) -> tuple[int, np.ndarray]:
        """The two ends of a random path that the environment accepts as start and goal.

        Returns:
            The index of the scene, and the ends, normalised (2, j).
        """
        while True:
            scene, first, last = self.choose_paths(rng, 1)
            ends = self.paths.points[np.r_[first, last]]
            # Rounding might make the environment reject a path that is only just free.
            if ground_truth_checker(self.paths.scenes[scene]).is_free(ends, margin=0.001).all():
                return scene, ends

    def draw(self, number: int, count: int, noise: float) -> Examples:
        """Examples at random configurations near the paths of one scene.

        Args:
            number: >= 0; each number has its own examples.
            count: of examples.
            noise: standard deviation (normalised, each joint) around the paths.
        """
        rng = np.random.default_rng([self.seed, Stream.DAGGER_EXAMPLES, number])
        scene, first, last = self.choose_paths(rng, -(-count // PER_PATH))
        path = np.arange(count) // PER_PATH
        first, last = first[path], last[path]
        backwards = (rng.random(count) < 0.5)[path]
        rest = rng.random(count) * (self._travelled[last] - self._travelled[first])

        def at(rest):
            """The points on the paths from which `rest` remains."""
            travelled = np.where(
                backwards, self._travelled[first] + rest, self._travelled[last] - rest
            )
            i = np.searchsorted(self._travelled, travelled, side="right") - 1
            i = np.clip(i, first, last - 1)
            share = (travelled - self._travelled[i]) / (self._travelled[i + 1] - self._travelled[i])
            tail, head = self.paths.points[i], self.paths.points[i + 1]
            return tail + share[:, None] * (head - tail)

        states = at(rest)
        states = states + noise * rng.standard_normal((count, states.shape[1]))
        states = np.clip(states, -1.0, 1.0)
        rest = np.maximum(rest - AHEAD, 0.0)
        moves = at(rest) - states
        lengths = np.linalg.norm(moves, axis=1)
        goals = self.paths.points[np.where(backwards, first, last)]
        return self._examples(scene, states, goals, moves / lengths[:, None], lengths + rest)

    def label(
        self,
        scene: int,
        states: np.ndarray,
        goals: np.ndarray,
        rng: np.random.Generator,
        roadmap: Roadmap | None = None,
    ) -> Examples:
        """Examples at given configurations, those from which a roadmap has a path to the goal.

        Args:
            scene: index of the scene.
            states, goals: normalised (n, j).
            rng: a NumPy Generator.
            roadmap: the scene's `Roadmap`; by default a new one.
        """
        roadmap = roadmap or Roadmap(self.paths.scenes[scene], rng)
        directions, lengths = roadmap.labels(states, goals, rng)
        has_path = lengths > 0.0  # and is not at the goal
        return self._examples(
            scene, states[has_path], goals[has_path], directions[has_path], lengths[has_path]
        )

    def _examples(self, scene, states, goals, directions, lengths) -> Examples:
        robot = self.paths.scenes[scene].robot
        checker = self.geometry_source(self.paths.scenes[scene])
        ends, end_of = np.unique(goals, axis=0, return_inverse=True)
        observation, _, goal = observed(states, robot.denormalise(goals), self.goal_type, robot)
        return {
            "observation": observation,
            "desired_goal": goal,
            "link_distances": checker.link_distances(states),
            "goal_link_distances": checker.link_distances(ends)[end_of],
            "direction": directions.astype(np.float32),
            "length": lengths.astype(np.float32),
            "scene": np.full(len(states), scene),
        }
