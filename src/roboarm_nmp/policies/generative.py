"""Policies that draw whole paths from a network, verify them, and follow the best one.

    begin = Generative(network, env, seed=0)       # `registry.make_policy` makes it
    act, verified, searched = begin(number, query)

The network turns noise into paths, step by step (`bc_script/flow.py`). A path is the straight line
from start to goal, plus curves with drawn coefficients. Each draw is repaired by gradient steps
away from observed points (`envs.collision.distance_field`), and checked in the observed cloud
(`envs.collision.checker`). The shortest path that keeps the first of `MARGINS` is shortened and
followed. Where no draw does, paths are drawn again from the best ones with new noise, then
assembled from parts of all draws, then smaller margins do. Space that no sensor sees counts as
occupied; where no path is found so, all of this is done with that space as free. Last, where that
is allowed, a path is searched for. Otherwise the arm follows the draw with the fewest contacts.
"""

import numpy as np

from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.collision.checker import RESOLUTION, CollisionChecker, Rules
from roboarm_nmp.envs.collision.distance_field import DistanceField
from roboarm_nmp.envs.perception.encoders import make_encoder
from roboarm_nmp.envs.perception.geometry_source import (
    Unknown,
    cautious_checker,
    fine_observed_checker,
)
from roboarm_nmp.envs.perception.point_clouds import (
    DENSE_RAYS,
    POINT_CLOUD,
    observed_points,
    sensor_images,
)
from roboarm_nmp.envs.scenes.primitives import ObservedScene
from roboarm_nmp.envs.subgoals import subgoals
from roboarm_nmp.networks.network_file import Network
from roboarm_nmp.networks.untrusted import NetworkError
from roboarm_nmp.policies.baselines import follow_subgoals
from roboarm_nmp.policies.policy import EpisodePolicy
from roboarm_nmp.policies.pose_goals import observed_at_start

# The numbers below were chosen on validation queries: docs/algorithms/flow.md.
ROUNDS = 8
DRAWS, DRAWS_LATER = 32, 64  # paths in the first round, and in later ones
AT_ONCE = 8  # repaired and checked; those of a round that lack the least distance come first
STEPS, STEPS_LATER, STEPS_AGAIN = 4, 8, 4  # of the flow; from half-way on
MARGINS = (0.01, 0.003, 0.0)  # m
MARGIN_GROWTH = 0.05  # m per unit of normalised distance, near a start or goal with less room
REPAIRS, REPAIR_DISTANCE, REPAIR_RATE, MOST_REPAIR = 20, 0.04, 0.3, 0.06
INACCURACY = 0.01  # m: of a field's distances
MOST_KNOTS = 1_000  # of a path in a file
MOST_CHECKED = 40  # times that motions of assembled paths are checked
CHORDS = 20  # straight motions that are tried to shorten the chosen path
SEARCH_CHECKS = 200_000  # of a search, in each margin
SLOW_STEPS = 6  # at start and goal: about as far as margins are smaller there


class Generative:
    """A policy for each episode of an environment: a function (number, `Query`) -> `EpisodePolicy`.

    Args:
        network: a policy network that draws paths: its metadata have `paths`.
        env: the `RoboArmEnv`.
        seed: of the noise, >= 0; each query has its own generator.
        search: whether a path is searched for where no draw can be verified.
        unknown: what space is that no sensor sees: `free`, `occupied`; None: occupied at first, and
            free where no path is found otherwise.
    """

    def __init__(
        self,
        network: Network,
        env: RoboArmEnv,
        seed: int = 0,
        search: bool = False,
        unknown: Unknown | None = None,
    ):
        self._robot = env.robot
        self._env = env
        self._seed = seed
        self._search = search
        self._field = DistanceField(self._robot)
        self._unknown = unknown
        self._network = network
        self._paths = PathsOfNetwork(network, self._field)

    def __call__(self, number: int, query: Query) -> EpisodePolicy:
        scene = observed_at_start(self._env, query)
        rng = np.random.default_rng([self._seed, number])
        ends = np.clip(self._robot.normalise([query.start, query.goal]), -1.0, 1.0)
        if not isinstance(scene, ObservedScene):
            sensor_images(scene, DENSE_RAYS)  # first: others need no casting then
        draw = self._paths.begin(scene, *ends.astype(np.float32))
        checkers, path, verified, searched = [], ends, False, False
        if self._unknown != "free":
            checkers.append(cautious_checker(scene, ends))
            path, verified = draw_path(draw, checkers[0], ends, rng)
        if not verified and self._unknown != "occupied":
            checkers.append(fine_observed_checker(scene, DENSE_RAYS))
            path, verified = draw_path(draw, checkers[-1], ends, rng)
        if not verified and self._search:
            searched = True
            for checker in checkers:
                found = search_path(checker, ends, rng)
                if found is not None:
                    path, verified = found, True
                    break
        act = follow_gently(self._robot.denormalise(path), self._robot)
        return EpisodePolicy(act, verified, searched)


class PathsOfNetwork:
    """Draws paths with a network, of one query after the other.

    Args:
        network: see `Generative`.
        field: a `DistanceField` of the robot.
    """

    def __init__(self, network: Network, field: DistanceField):
        self._network = network
        self._field = field
        self.curves, self._every, self._line, num_points = _form_of_paths(network, field)
        share = np.linspace(0.0, 1.0, self.curves.shape[1], dtype=np.float32)
        self._share = share[:, None]  # of the straight line
        self._encoder = make_encoder(POINT_CLOUD, num_points)

    def begin(self, scene, start, goal):
        """Begin a query: observe a `Scene`; start and goal are float32 (n,), normalised."""
        self.start, self.goal = start, goal
        self.points = observed_points(scene)
        self._grid = self._field.of_scene(self.points, scene)[None]
        self._straight = start * (1.0 - self._share) + goal * self._share
        states = start + (goal - start) * np.linspace(0.0, 1.0, self._line)[:, None]
        self._query = {
            "start": start,
            "goal": goal,
            "scene": self._encoder(scene),
            "line_centres": self._field.centres(states),
        }
        distances, uphill = self._field.distances(states, self._grid)
        self._query |= {"line_distances": distances, "line_uphill": uphill}
        return self

    def knots(self, x, which=slice(None)):
        """The paths (m, k, n) of coefficients (m, c, n), or some of their configurations."""
        path = np.matmul(self.curves[:, which].T, x)
        path += self._straight[which]
        return np.clip(path, -1.0, 1.0, out=path)

    def draw(self, number, steps, rng):
        """Coefficients of new paths, in so many steps of the flow: (m, c, n)."""
        noise = rng.standard_normal((number, len(self.curves), len(self.start)), np.float32)
        return self._flow(noise, 0.0, steps)

    def draw_again(self, x, rng):
        """Coefficients of paths like those of x: half noise, and again through the flow."""
        noise = rng.standard_normal(x.shape, np.float32)
        return self._flow(0.5 * noise + 0.5 * x, 0.5, STEPS_AGAIN)

    def _flow(self, x, begin, steps):
        number = len(x)
        query = {name: np.asarray(one, np.float32)[None] for name, one in self._query.items()}
        times = np.linspace(begin, 1.0, steps + 1)
        for now, then in zip(times[:-1], times[1:], strict=True):
            distances, uphill = self._along(self.knots(x, slice(self._every, -1, self._every)))
            path = self._network(
                noisy=x.reshape(number, -1),
                time=np.full((number, 1), now, np.float32),
                distances=distances,
                uphill=uphill,
                **query,
            )
            if path.shape != (number, x[0].size) or not np.isfinite(path).all():
                raise NetworkError("a path that it draws has another size, or is not finite")
            path = path.reshape(x.shape)
            x = x + (path - x) * np.float32((then - now) / (1.0 - now))
        return x

    def _along(self, paths, hinge=None):
        states = paths.reshape(-1, paths.shape[-1])
        options = {} if hinge is None else {"hinge": hinge}
        found = self._field.distances(states, self._grid, **options)
        return [one.reshape(*paths.shape[:2], -1) for one in found]

    def repaired(self, x):
        """Coefficients after gradient steps of the paths away from points."""
        number, count, joints = x.shape
        seen = slice(1, -1, 2)
        straight, at, between = (
            self._straight[seen, None],
            self.curves[:, seen].T.copy(),
            self.curves[:, ::2].T.copy(),
        )
        smooth = 1.0 / np.arange(1, count + 1, dtype=np.float32)[:, None]
        rates = 2.0 * REPAIR_RATE * smooth / (self.curves**2).sum(1)[:, None] * at.T
        # Curve by curve: then products are of two matrices, for all paths at once.
        x = x.transpose(1, 0, 2).copy()
        for _ in range(REPAIRS):
            states = (at @ x.reshape(count, -1)).reshape(-1, number, joints)
            states += straight
            states = np.clip(states, -1.0, 1.0, out=states).reshape(-1, joints)
            _, uphill = self._field.distances(states, self._grid, hinge=REPAIR_DISTANCE)
            step = rates @ uphill.reshape(len(at), -1)
            moves = np.abs(between @ step).reshape(-1, number, joints).max((0, 2))
            share = np.minimum(1.0, MOST_REPAIR / np.maximum(moves, 1e-6))
            x += step.reshape(x.shape) * share[:, None]
        return x.transpose(1, 0, 2).copy()

    def lacking(self, x):
        """What the paths of coefficients (m, c, n) lack in distance, summed: (m,)."""
        distances, _ = self._along(self.knots(x, slice(1, -1)))
        return np.maximum(REPAIR_DISTANCE / 2.0 - distances, 0.0).sum((1, 2))

    def clearances(self, knots):
        """About the distance (m) of the arm from points at the knots of paths: (m, k)."""
        return self._along(knots)[0].min(2)


def input_shapes(
    joints: int, spheres: int, curves: tuple[int, ...], every: int, line: int
) -> dict[str, tuple[int, ...]]:
    """The inputs of a network that draws paths, without `scene`: dict from name to shape.

    Args:
        joints, spheres: of the arm, as a `DistanceField` has them.
        curves: (c, k): how many curves a path has, at how many configurations.
        every: at which of these the network receives distances, each second or third or so.
        line: at how many configurations of the straight line it receives them.
    """
    seen = len(range(every, curves[1] - 1, every))
    return {
        "noisy": (curves[0] * joints,),
        "time": (1,),
        "distances": (seen, spheres),
        "uphill": (seen, joints),
        "start": (joints,),
        "goal": (joints,),
        "line_centres": (line, spheres, 3),
        "line_distances": (line, spheres),
        "line_uphill": (line, joints),
    }


def _form_of_paths(network, field):
    """`curves` (c, k) of whitened coefficients, `every`, `line`, and the number of points."""
    form = network.metadata["paths"]
    try:
        curves = np.array(form["curves"], np.float32)
        every, line = int(form["every"]), int(form["line"])
        shapes = input_shapes(field.num_joints, field.num_spheres, curves.shape, every, line)
        numbers = network.inputs["scene"][1] or 0
        fits = np.isfinite(curves).all() and numbers > 0 and numbers % 3 == 0
        fits = fits and curves.shape[1] <= MOST_KNOTS and len(network.outputs) == 1
        fits = fits and {name: (None, *shape) for name, shape in shapes.items()} == {
            name: shape for name, shape in network.inputs.items() if name != "scene"
        }
    except (KeyError, TypeError, ValueError, IndexError):
        fits = False
    if not fits:
        raise NetworkError(
            "its inputs or its metadata `paths` are not those of a policy that draws paths for "
            "this arm"
        )
    return curves, every, line, numbers // 3


def draw_path(
    paths: PathsOfNetwork, checker: CollisionChecker, ends: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, bool]:
    """A path from start to goal, normalised (k, n), and whether it is verified.

    Args:
        paths: which has begun with the query.
        checker: of what is observed.
        ends: start and goal (2, n), normalised.
        rng: a NumPy Generator.
    """
    start, goal = ends
    near = margins_near(checker, ends)
    if checker.is_motion_free(start, goal, MARGINS[0], endpoint_margins=near[0]):
        return ends, True
    drawn = np.empty((0, *paths.curves.shape[:1], len(ends[0])), np.float32)
    for number in range(ROUNDS):
        fresh, steps = DRAWS, STEPS
        new = []
        if number:
            best = drawn[np.argsort(paths.lacking(drawn), kind="stable")[: DRAWS // 4]]
            new.append(paths.draw_again(np.repeat(best, 2, axis=0), rng))
            fresh, steps = DRAWS_LATER, STEPS_LATER
        new = np.concatenate([*new, paths.draw(fresh, steps, rng)])
        new = new[np.argsort(paths.lacking(new), kind="stable")]
        for some in np.array_split(new, len(new) // AT_ONCE):
            some = paths.repaired(some)
            drawn = np.concatenate([drawn, some])
            found = _shortest_free(paths, checker, paths.knots(some), MARGINS[0], near[0], rng)
            if found is not None:
                return found, True
    knots = paths.knots(drawn)
    for margin, ends_near in zip(MARGINS, near, strict=True):
        found = _assembled(paths, checker, knots[-2 * DRAWS :], margin, ends_near)
        if found is not None:
            found = finished_path(checker, found, margin, ends_near, rng)
        if found is not None:
            return found, True
    knots = knots[np.argsort(paths.lacking(drawn), kind="stable")[:DRAWS]]
    free = checker.is_motion_free(knots[:, :-1], knots[:, 1:], endpoint_margins=near[-1])
    return knots[free.sum(1).argmax()], False


def search_path(
    checker: CollisionChecker, ends: np.ndarray, rng: np.random.Generator
) -> np.ndarray | None:
    """As `draw_path`, a path that is searched for, and verified; None if there is none."""
    start, goal = ends
    for margin, near in zip(MARGINS, margins_near(checker, ends), strict=True):
        path, _ = checker.find_path(
            start, goal, rng, margin, endpoint_margins=near, max_checks=SEARCH_CHECKS
        )
        if path is not None:
            return path
    return None


def margins_near(checker, ends):
    """For each of `MARGINS`, the smaller margins near start and goal, where there is less room."""
    room = checker.signed_distances(ends, within=2.0 * MARGINS[0]).distance.min(-1) - 1e-5
    return [(ends, np.minimum(room, margin), MARGIN_GROWTH) for margin in MARGINS]


def follow_gently(path, robot):
    """As `follow_path`, but with half as long steps near start and goal, which may be tight."""
    targets = subgoals(path, robot)
    last = len(targets) - 1
    slow = np.unique([*range(min(SLOW_STEPS, last)), *range(max(last - SLOW_STEPS, 0), last)])
    middles = (targets[slow] + targets[slow + 1]) / 2
    return follow_subgoals(np.insert(targets, slow + 1, middles, axis=0), robot)


def _lengths(knots):
    return np.linalg.norm(np.diff(knots, axis=1), axis=2).sum(1)


def _shortest_free(paths, checker, knots, margin, near, rng):
    """The shortest of paths (m, k, n) that keeps a margin, shortened; None if none does."""
    knots = knots[np.argsort(_lengths(knots), kind="stable")]
    clearances = paths.clearances(knots)
    possible = clearances[:, 1:-1].min(1) >= -INACCURACY
    knots, clearances = knots[possible], clearances[possible]
    # The motions with the least distance first.
    orders = np.argsort(np.minimum(clearances[:, :-1], clearances[:, 1:]), kind="stable")
    while len(knots):
        free = checker.first_free_path(knots, orders, margin, endpoint_margins=near)
        if free == len(knots):
            break
        path = finished_path(checker, knots[free], margin, near, rng)
        if path is not None:
            return path
        knots, orders = knots[free + 1 :], orders[free + 1 :]
    return None


def _assembled(paths, checker, knots, margin, near):
    """The shortest free path that goes from knot to knot of any of the paths; None without one.

    Motions are checked only when the shortest path would take them (Bohlin and Kavraki, 2000).
    """
    count, size = knots.shape[:2]
    free = paths.clearances(knots) > -INACCURACY
    free[:, [0, -1]] = True
    costs = np.linalg.norm(knots[None, :, 1:] - knots[:, None, :-1], axis=-1)  # (from, to, step)
    costs = np.where(free[:, None, :-1] & free[None, :, 1:], costs, np.inf)
    known = np.zeros(costs.shape, bool)
    steps = np.arange(size - 1)
    for _ in range(MOST_CHECKED):
        total = np.zeros(count)
        before = np.empty((size - 1, count), np.int64)
        for step in steps:
            through = total[:, None] + costs[:, :, step]
            before[step], total = through.argmin(0), through.min(0)
        at = np.empty(size, np.int64)
        at[-1] = total.argmin()
        if not np.isfinite(total[at[-1]]):
            return None
        for step in steps[::-1]:
            at[step] = before[step, at[step + 1]]
        new = ~known[at[:-1], at[1:], steps]
        if not new.any():
            return knots[at, np.arange(size)]
        one, other, step = at[:-1][new], at[1:][new], steps[new]
        free = checker.is_motion_free(
            knots[one, step], knots[other, step + 1], margin, endpoint_margins=near
        )
        known[one, other, step] = True
        costs[one[~free], other[~free], step[~free]] = np.inf
    return None


def finished_path(checker, path, margin, near, rng):
    """A path (k, n) shortened; None where it touches something between its configurations."""
    states, room, growth = near
    rules = Rules(
        np.zeros(1, np.int64),
        np.array([[margin, 0.0, growth, RESOLUTION]]),
        np.concatenate([states, room[:, None]], axis=1)[None],
    )
    path, seed = np.ascontiguousarray(path, np.float64), int(rng.integers(2**63))
    return checker.search(path[0], path[-1:], rules, seed, chords=CHORDS, found=path)[0]
