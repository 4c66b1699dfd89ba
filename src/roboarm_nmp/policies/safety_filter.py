"""A safety filter for any policy: a minimum clearance of every link, and escapes from local minima.

    env = roboarm_nmp.make(
        "random_boxes_hard", geometry_source="point_cloud", link_distances=True
    )
    act = SafetyFilter(margin=0.01).filter_policy(act, env, rng)  # at the start of an episode
    action = act(observation)

An action a displaces the normalised configuration q. For each link with the signed distance d(q),
the filter enforces a discrete-time control barrier function (Agrawal and Sreenath, 2017),

    d(q + a) - d_min >= (1 - gamma) (d(q) - d_min),

linearised by the gradient of d: one half-space of actions per link. d_min is the margin, and gamma
`CBF_GAIN`. A link nearer than the margin has to move away, by at most `MAX_RECOVERY` per step.

Cyclic projection onto the half-spaces finds an action that satisfies them, where there is one. The
change is close to the smallest one (L2), and exact for a single half-space; for two, it is at most
15 % longer (docs/lab_notebook.md, "Projection").

The nearest point of a link may change during the step. So the distances at q + a are computed, too,
and add a second half-space per link. Distances come from the observation's geometry source, table
and floor; those between links need no observation.

Where obstacles move, a distance also changes while the arm stands still, by r(q) per step, and the
constraint is

    d(q + a) + r(q) - d_min >= (1 - gamma) (d(q) - d_min):

an arm in the way of an obstacle retreats. r is estimated without tracking anything, from two
observations of the scene: the difference of the distances that the arm, as it stands now, has in
both, per step between them. So it is a velocity along the direction of the nearest point of each
link; what comes from behind a nearer obstacle is not noticed. Only approaching obstacles count. An
obstacle that appears counts as one that approaches at `MAX_APPROACH`. In a scene where nothing has
moved, r is zero, and actions are the same, bit for bit.

Such a filter stands still in local minima. Where the arm has hardly moved for some steps, a random
walk escapes (Barraquand and Latombe, 1991), and a virtual obstacle then keeps the arm from there.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.collision.checker import CollisionChecker, self_distances
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.scenes.primitives import is_number
from roboarm_nmp.envs.subgoals import MAX_STEP
from roboarm_nmp.planning.approach_path import ApproachPaths
from roboarm_nmp.planning.projection_kernels import project
from roboarm_nmp.policies.policy import Policy

# Of the filter's behaviour, recorded in results. 1: other escapes, no virtual obstacles. 2: slow
# arrivals counted as local minima, and the gain was the same near a goal as elsewhere. 3: approach
# paths of goals did not go back.
VERSION = 4

LOOKAHEAD, MAX_LOOKAHEAD = 0.0, 1.0  # s, by default and at most
# The numbers below were chosen on validation and fresh queries: docs/lab_notebook.md.
ACTIVATION_DISTANCE = 0.15  # m. Links with larger distances are not constrained.
CBF_GAIN = 0.2  # gamma: share of the remaining clearance that one step may use
ARRIVAL_DISTANCE = 0.2  # L2, normalised: from here to the goal, the gain grows linearly to 1
MAX_RECOVERY = 0.002  # m per step, by which a link nearer than the margin has to move away
# If a link is nearer than the margin at the goal, its margin is smaller around the goal: its
# distance there, and this much (m) more per unit of normalised distance from the goal.
MARGIN_GROWTH = 0.03
PROJECTION_SWEEPS = 12  # of cyclic projection
# Of moving obstacles. A rate is that between observations RATE_STEPS apart, or more, where scenes
# are observed less often: the points of a cloud are a few millimetres off from step to step.
RATE_STEPS = 3
MAX_APPROACH = 0.05  # m per step, 1.5 m/s
# m. A goal with smaller link distances is occupied: around it, margins do not shrink.
OCCUPIED = -0.012

# A local minimum is a configuration where PATIENCE steps moved the arm by less than PROGRESS (L2,
# normalised). Close to the goal, they also have to be less than this share of the remaining
# distance: where there is little room, the arm arrives slowly.
PATIENCE, PROGRESS, PROGRESS_SHARE = 10, 0.06, 0.3
ESCAPE_STEPS = 10  # into one random direction
TURNING_JOINTS = 3  # the last ones, which turn the hand: escapes move the others
# After an escape, the last action's direction is added to the policy's action: at first MOMENTUM
# times as long as the longest action, fading over MOMENTUM_STEPS.
MOMENTUM, MOMENTUM_STEPS = 2.0, 40
# A virtual obstacle is a ball of the escape joints around a local minimum. Its radius (L2,
# normalised) is at most this share of the distance to the goal. The projection takes distances in m
# and those to virtual obstacles in normalised units, scaled by VIRTUAL_SCALE (m per unit).
VIRTUAL_RADIUS, VIRTUAL_RADIUS_SHARE, VIRTUAL_SCALE = 0.5, 0.9, 0.3


@dataclass(frozen=True)
class SafetyFilter:
    """A filter of actions.

    Attributes:
        margin: m, minimum distance of every link from the scene and from other links.
        escape: whether to escape from local minima.
        approach: whether to follow approach paths, which need no margin, out of a start and into a
            goal in a tight place, a box or a compartment (`planning.approach_path`).
        lookahead: s, from 0 to `MAX_LOOKAHEAD`: distances count as they will be after this time if
            obstacles continue to approach as they do now; None: as if no obstacle moved.

    Raises:
        ValueError: `margin` is not in [0, `ACTIVATION_DISTANCE`), `lookahead` is out of its range,
            or another one is not a bool.
    """

    margin: float = 0.01
    escape: bool = True
    approach: bool = False
    lookahead: float | None = LOOKAHEAD

    def __post_init__(self) -> None:
        lookahead = 0.0 if self.lookahead is None else self.lookahead
        if not (is_number(lookahead) and 0 <= lookahead <= MAX_LOOKAHEAD):
            raise ValueError(
                f"lookahead must be None or in [0, {MAX_LOOKAHEAD}] s, got {self.lookahead!r}"
            )
        if not (is_number(self.margin) and 0 <= self.margin < ACTIVATION_DISTANCE):
            raise ValueError(f"margin must be in [0, {ACTIVATION_DISTANCE}) m, got {self.margin!r}")
        for name in ("escape", "approach"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be a bool, got {getattr(self, name)!r}")

    @classmethod
    def from_metadata(cls, metadata: dict[str, Any]) -> "SafetyFilter | None":
        """The `SafetyFilter` of a policy, from its file's metadata; None if it has none.

        Its options are in `safety_filter`, a dict with `margin`, `escape` and possibly `approach`
        and `lookahead`.
        Raises ValueError if they are invalid.
        """
        options = metadata.get("safety_filter")
        if options is None:
            return None
        try:
            lookahead = options.get("lookahead", LOOKAHEAD)
            return cls(
                margin=float(options["margin"]),
                escape=bool(options["escape"]),
                approach=bool(options.get("approach", False)),
                lookahead=None if lookahead is None else float(lookahead),
            )
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"invalid safety_filter in its metadata: {options!r}") from error

    def to_metadata(self) -> dict[str, Any]:
        """The options as `from_metadata` reads them."""
        options = {"margin": self.margin, "escape": self.escape}
        if self.approach:
            options["approach"] = True
        if self.lookahead != LOOKAHEAD:
            options["lookahead"] = self.lookahead
        return options

    def __call__(
        self,
        actions: np.ndarray,
        link_distances: np.ndarray,
        margins: np.ndarray | None = None,
        max_step: float = MAX_STEP,
        cbf_gain: float = CBF_GAIN,
        rates: np.ndarray | None = None,
    ) -> np.ndarray:
        """Actions (..., n), float32, that satisfy the constraints of all rows, to first order.

        They are close to the given actions, but not always the closest. Where the constraints
        conflict, or the sweeps do not suffice, some are violated.

        Args:
            actions: (..., n), displacements of the normalised configuration.
            link_distances: (..., rows, 1 + n), as from `envs.wrappers.LinkDistancesWrapper`: m, and
                gradients in m per unit of normalised configuration.
            margins: m, (..., rows), instead of the filter's `margin`.
            max_step: longest action (L2, normalised).
            cbf_gain: gamma.
            rates: m per step, (..., rows): how distances change by themselves; None for zeros.
        """
        actions = np.array(actions, np.float64)
        link_distances = np.asarray(link_distances, np.float64)
        rows = link_distances.shape[-2]
        if margins is None:
            margins = np.array(self.margin)
        margins = np.broadcast_to(margins, link_distances.shape[:-1]).astype(np.float64)
        rates = np.zeros(margins.shape) if rates is None else np.array(rates, np.float64)
        project(
            actions.reshape(-1, actions.shape[-1]),
            link_distances.reshape(-1, rows, link_distances.shape[-1]),
            margins.reshape(-1, rows),
            rates.reshape(-1, rows),
            max_step,
            cbf_gain,
            ACTIVATION_DISTANCE,
            MAX_RECOVERY,
            PROJECTION_SWEEPS,
        )
        return actions.astype(np.float32)

    def filter_policy(self, act: Policy, env: RoboArmEnv, rng: np.random.Generator) -> Policy:
        """A policy through this filter, for one episode.

        Args:
            act: the policy, a function from an observation to an action (n,).
            env: the `RoboArmEnv` of the episode. See `check_env`.
            rng: a NumPy Generator, for the directions of escapes.
        """
        act_safely = _FilteredPolicy(self, act, env, rng)
        return ApproachPaths(act_safely, env) if self.approach else act_safely

    def margins_near_goal(self, goal_distances: np.ndarray, remaining: float) -> np.ndarray:
        """Margins of the links, m, (rows,): smaller near a goal that violates the filter's margin.

        Args:
            goal_distances: m, (rows,), at the goal.
            remaining: distance from the goal, L2, normalised.
        """
        return np.minimum(self.margin, goal_distances + MARGIN_GROWTH * remaining)


class _FilteredPolicy:
    """A policy through a `SafetyFilter`, without approach paths. See `filter_policy`."""

    def __init__(self, safety_filter, act, env, rng):
        self._filter = safety_filter
        self._act = act
        self._env = env
        self._link_distances_at = env.get_wrapper_attr("link_distances_at")
        self._max_step = env.max_step
        self._joints = env.robot.num_joints
        self._local_minima = _LocalMinima(rng, env.max_step, self._joints)
        self._goal_distances = None
        self._approach_rates = None
        if safety_filter.lookahead is not None:
            self._approach_rates = ApproachRates(env.get_wrapper_attr("current_checker"))

    def __call__(self, observation):
        local_minima = self._local_minima
        robot = self._env.robot  # an episode's scene may have another gripper opening, or objects
        state = observation["observation"][: self._joints]
        here = np.concatenate([observation["link_distances"], _self_distances(robot, state)])
        if self._approach_rates is not None:
            self._approach_rates.observe()
        rates_here = self._predict(state, here)
        margins = np.broadcast_to(self._filter.margin, len(here))
        cbf_gain = CBF_GAIN
        goal = None
        if "goal_link_distances" in observation:
            goal = observation["desired_goal"][: self._joints]
            self._update_goal_distances(observation["goal_link_distances"], robot, goal)
            remaining = np.linalg.norm(state - goal)
            margins = self._filter.margins_near_goal(self._goal_distances, remaining)
            cbf_gain = max(CBF_GAIN, 1.0 - (1.0 - CBF_GAIN) * remaining / ARRIVAL_DISTANCE)
        action = local_minima.escape(state, goal) if self._filter.escape else None
        if action is None:
            action = local_minima.add_momentum(self._act(observation))
        # Virtual obstacles come first: the last projections of a sweep prevail.
        virtual = local_minima.virtual_obstacles(state)
        here = np.concatenate([virtual, here])
        margins_here = np.concatenate([np.zeros(len(virtual)), margins])
        rates_here = np.concatenate([np.zeros(len(virtual)), rates_here])
        move = self._filter(action, here, margins_here, self._max_step, cbf_gain, rates_here)
        # Distances at the end of the step, extrapolated back to its start.
        end = state + move
        there = np.concatenate([self._link_distances_at(end), _self_distances(robot, end)])
        rates = np.concatenate([rates_here, self._predict(end, there)])
        there[:, 0] -= there[:, 1:] @ move
        rows = np.concatenate([here, there])
        margins = np.concatenate([margins_here, margins])
        safe_action = self._filter(action, rows, margins, self._max_step, cbf_gain, rates)
        local_minima.last_action = safe_action
        return safe_action

    def _predict(self, state, rows):
        """Rates of rows of link distances; the rows are changed to those after `lookahead`."""
        rates = np.zeros(len(rows))
        if self._approach_rates is not None and self._approach_rates.any_motion:
            scene = rows[: self._env.robot.link_distances_shape[0]]
            rates[: len(scene)] = self._approach_rates(state, scene[:, 0])
            rows[:, 0] += self._filter.lookahead / STEP_SECONDS * rates
        return rates

    def _update_goal_distances(self, link_distances, robot, goal):
        """Distances at the goal, (rows,): once, or in each step if obstacles move."""
        moves = self._approach_rates is not None and self._approach_rates.any_motion
        if self._goal_distances is None or moves:
            distances = np.concatenate([link_distances, _self_distances(robot, goal)])[:, 0]
            if moves and distances.min() < OCCUPIED:
                distances = np.full(len(distances), np.inf)
            self._goal_distances = distances


class ApproachRates:
    """How fast obstacles approach links, from successive observations of one episode.

    Call `observe` in each step.

    Args:
        current_checker: a function without arguments that returns the `CollisionChecker` of the
            last observation, the same object as long as there is no new one.
    """

    def __init__(self, current_checker: Callable[[], CollisionChecker]):
        self._current_checker = current_checker
        self._observed = deque()  # pairs of a step and a checker
        self._step = 0

    def observe(self) -> None:
        """Take the present observation into account."""
        checker = self._current_checker()
        observed = self._observed
        self._step += 1
        if not observed or checker is not observed[-1][1]:
            observed.append((self._step, checker))
            while len(observed) > 2 and self._step - observed[1][0] >= RATE_STEPS:
                observed.popleft()
        # Everything stands still when there is nothing new for longer than usual.
        elif self._step - observed[-1][0] > max(RATE_STEPS, observed[-1][0] - observed[0][0]):
            while len(observed) > 1:
                observed.popleft()

    @property
    def any_motion(self) -> bool:
        """Whether the last observations differ."""
        return len(self._observed) > 1

    def __call__(self, state: np.ndarray, distances: np.ndarray) -> np.ndarray:
        """Changes of link distances, m per step, (..., l), from -`MAX_APPROACH` to 0.

        Args:
            state: normalised configuration (n,), or several, (..., n).
            distances: m, (..., l), there, from the obstacles of the last observation.
        """
        (then, before), (now, _) = self._observed[0], self._observed[-1]
        change = distances - before.link_distances(state)[..., 0]
        return np.clip(change / (now - then), -MAX_APPROACH, 0.0)


class _LocalMinima:
    """The local minima of one episode: escapes from them, and virtual obstacles around them."""

    def __init__(self, rng, max_step, num_joints):
        self.rng = rng
        self.max_step = max_step
        self.num_joints = num_joints
        self.num_escape_joints = max(num_joints - TURNING_JOINTS, 1)
        self.states = deque(maxlen=PATIENCE + 1)  # since the last escape
        self.steps_left = 0  # of an escape
        self.direction = np.zeros(num_joints)  # of an escape
        self.momentum = 0.0
        self.last_action = np.zeros(num_joints, np.float32)
        self.obstacles = []  # configuration of the escape joints, radius

    def escape(self, state, goal):
        """The next action of an escape, (n,); None where none is needed.

        Args:
            state: configuration (n,), normalised.
            goal: the goal's configuration, or None if it is unknown: then there are no virtual
                obstacles, which might contain it.
        """
        self.states.append(state)
        moved = np.linalg.norm(state - self.states[0])
        progress = PROGRESS
        if goal is not None:
            remaining = np.linalg.norm(goal - self.states[0])
            progress = min(PROGRESS, PROGRESS_SHARE * remaining)
        if self.steps_left == 0 and len(self.states) > PATIENCE and moved < progress:
            self.steps_left = ESCAPE_STEPS
            direction = self.rng.standard_normal(self.num_escape_joints)
            direction *= self.max_step / np.linalg.norm(direction)
            self.direction = np.zeros(self.num_joints)
            self.direction[: self.num_escape_joints] = direction
            if goal is not None:
                remaining = np.linalg.norm((goal - state)[: self.num_escape_joints])
                radius = min(VIRTUAL_RADIUS, VIRTUAL_RADIUS_SHARE * remaining)
                self.obstacles.append((state[: self.num_escape_joints], radius))
        if self.steps_left == 0:
            return None
        self.steps_left -= 1
        if self.steps_left == 0:
            self.states.clear()
            self.momentum = MOMENTUM
        return self.direction

    def add_momentum(self, action):
        """The policy's action (n,) and what is left of the momentum of the last escape."""
        if self.momentum <= 0.0:
            return action
        self.momentum -= MOMENTUM / MOMENTUM_STEPS
        length = max(np.linalg.norm(self.last_action), 1e-6)
        return action + self.momentum * self.max_step / length * self.last_action

    def virtual_obstacles(self, state):
        """Their distances and gradients, (m, 1 + n), as those of links; none during an escape."""
        rows = np.zeros((len(self.obstacles) if self.steps_left == 0 else 0, 1 + self.num_joints))
        for row, (centre, radius) in zip(rows, self.obstacles, strict=False):
            offset = state[: self.num_escape_joints] - centre
            distance = np.linalg.norm(offset)
            row[0] = VIRTUAL_SCALE * (distance - radius)
            row[1 : 1 + self.num_escape_joints] = VIRTUAL_SCALE * offset / max(distance, 1e-6)
        return rows


def check_env(env: RoboArmEnv) -> None:
    """Raise ValueError if a safety filter cannot act in this environment."""
    if "link_distances" not in env.observation_space.spaces:
        raise ValueError(
            "a safety filter needs link_distances in observations: "
            "roboarm_nmp.make(..., link_distances=True)"
        )
    if env.action_mode != "relative":
        raise ValueError(
            f"a safety filter needs action_mode 'relative', not {env.action_mode!r}: it changes "
            "displacements"
        )


def _self_distances(robot, state):
    """Link distances from the other links, (l, 1 + n)."""
    return self_distances(robot, state, ACTIVATION_DISTANCE)
