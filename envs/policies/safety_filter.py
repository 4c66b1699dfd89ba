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

Such a filter stands still in local minima. Where the arm has hardly moved for some steps, a random
walk escapes (Barraquand and Latombe, 1991), and a virtual obstacle then keeps the arm from there.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from roboarm_nmp.envs.collision.checker import self_distances
from roboarm_nmp.envs.collision.kernels import project
from roboarm_nmp.envs.policies.approach_path import ApproachPaths
from roboarm_nmp.envs.scenes.primitives import is_number
from roboarm_nmp.envs.subgoals import MAX_STEP

# Of the filter's behaviour, recorded in results. 1: other escapes, no virtual obstacles. 2: slow
# arrivals counted as local minima, and the gain was the same near a goal as elsewhere.
VERSION = 3

# The numbers below were chosen on validation and fresh queries: docs/lab_notebook.md.
ACTIVATION_DISTANCE = 0.15  # m. Links with larger distances are not constrained.
CBF_GAIN = 0.2  # gamma: share of the remaining clearance that one step may use
ARRIVAL_DISTANCE = 0.2  # L2, normalised: from here to the goal, the gain grows linearly to 1
MAX_RECOVERY = 0.002  # m per step, by which a link nearer than the margin has to move away
# If a link is nearer than the margin at the goal, its margin is smaller around the goal: its
# distance there, and this much (m) more per unit of normalised distance from the goal.
MARGIN_GROWTH = 0.03
PROJECTION_SWEEPS = 12  # of cyclic projection

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
            goal in a tight place (`envs.policies.approach_path`).

    Raises:
        ValueError: `margin` is not in [0, `ACTIVATION_DISTANCE`), or another one is not a bool.
    """

    margin: float = 0.01
    escape: bool = True
    approach: bool = False

    def __post_init__(self):
        if not (is_number(self.margin) and 0 <= self.margin < ACTIVATION_DISTANCE):
            raise ValueError(f"margin must be in [0, {ACTIVATION_DISTANCE}) m, got {self.margin!r}")
        for name in ("escape", "approach"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be a bool, got {getattr(self, name)!r}")

    @classmethod
    def from_metadata(cls, metadata):
        """The `SafetyFilter` of a policy, from its file's metadata; None if it has none.

        Its options are in `safety_filter`, a dict with `margin`, `escape` and possibly `approach`.
        Raises ValueError if they are invalid.
        """
        options = metadata.get("safety_filter")
        if options is None:
            return None
        try:
            flags = bool(options["escape"]), bool(options.get("approach", False))
            return cls(float(options["margin"]), *flags)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"invalid safety_filter in its metadata: {options!r}") from error

    def to_metadata(self):
        """The options as `from_metadata` reads them."""
        return {"margin": self.margin, "escape": self.escape} | (
            {"approach": True} if self.approach else {}
        )

    def __call__(self, actions, link_distances, margins=None, max_step=MAX_STEP, cbf_gain=CBF_GAIN):
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
        """
        actions = np.array(actions, np.float64)
        link_distances = np.asarray(link_distances, np.float64)
        rows = link_distances.shape[-2]
        margins = self.margin if margins is None else margins
        margins = np.broadcast_to(margins, link_distances.shape[:-1]).astype(np.float64)
        project(
            actions.reshape(-1, actions.shape[-1]),
            link_distances.reshape(-1, rows, link_distances.shape[-1]),
            margins.reshape(-1, rows),
            max_step,
            cbf_gain,
            ACTIVATION_DISTANCE,
            MAX_RECOVERY,
            PROJECTION_SWEEPS,
        )
        return actions.astype(np.float32)

    def filter_policy(self, act, env, rng):
        """A policy through this filter, for one episode.

        Args:
            act: the policy, a function from an observation to an action (n,).
            env: the `RoboArmEnv` of the episode. See `check_env`.
            rng: a NumPy Generator, for the directions of escapes.

        Returns:
            A function like `act`.
        """
        act_safely = self._filter_actions(act, env, rng)
        return ApproachPaths(act_safely, env) if self.approach else act_safely

    def _filter_actions(self, act, env, rng):
        """`filter_policy` without approach paths."""
        link_distances_at, max_step = env.get_wrapper_attr("link_distances_at"), env.max_step
        joints = env.robot.num_joints
        local_minima, goal_distances = _LocalMinima(rng, max_step, joints), None

        def act_safely(observation):
            nonlocal goal_distances
            robot = env.robot  # an episode's scene may have another gripper opening, or objects
            state, goal = observation["observation"][:joints], None
            here = np.concatenate([observation["link_distances"], _self_distances(robot, state)])
            margins, cbf_gain = np.broadcast_to(self.margin, len(here)), CBF_GAIN
            if "goal_link_distances" in observation:
                goal = observation["desired_goal"][:joints]
                if goal_distances is None:
                    rows = observation["goal_link_distances"], _self_distances(robot, goal)
                    goal_distances = np.concatenate(rows)[:, 0]
                remaining = np.linalg.norm(state - goal)
                margins = self.margins_near_goal(goal_distances, remaining)
                cbf_gain = max(CBF_GAIN, 1.0 - (1.0 - CBF_GAIN) * remaining / ARRIVAL_DISTANCE)
            action = local_minima.escape(state, goal) if self.escape else None
            if action is None:
                action = local_minima.add_momentum(act(observation))
            # Virtual obstacles come first: the last projections of a sweep prevail.
            virtual = local_minima.virtual_obstacles(state)
            here = np.concatenate([virtual, here])
            margins_here = np.concatenate([np.zeros(len(virtual)), margins])
            move = self(action, here, margins_here, max_step, cbf_gain)
            # Distances at the end of the step, extrapolated back to its start.
            end = state + move
            there = np.concatenate([link_distances_at(end), _self_distances(robot, end)])
            there[:, 0] -= there[:, 1:] @ move
            rows = np.concatenate([here, there])
            margins = np.concatenate([margins_here, margins])
            local_minima.last_action = self(action, rows, margins, max_step, cbf_gain)
            return local_minima.last_action

        return act_safely

    def margins_near_goal(self, goal_distances, remaining):
        """Margins of the links, m, (rows,): smaller near a goal that violates the filter's margin.

        Args:
            goal_distances: m, (rows,), at the goal.
            remaining: distance from the goal, L2, normalised.
        """
        return np.minimum(self.margin, goal_distances + MARGIN_GROWTH * remaining)


class _LocalMinima:
    """The local minima of one episode: escapes from them, and virtual obstacles around them."""

    def __init__(self, rng, max_step, num_joints):
        self.rng, self.max_step, self.num_joints = rng, max_step, num_joints
        self.num_escape_joints = max(num_joints - TURNING_JOINTS, 1)
        self.states = deque(maxlen=PATIENCE + 1)  # since the last escape
        self.steps_left, self.direction = 0, None  # of an escape
        self.momentum, self.last_action = 0.0, None
        self.obstacles = []  # configuration of the escape joints, radius

    def escape(self, state, goal):
        """The next action of an escape, (n,); None where none is needed.

        Args:
            state: configuration (n,), normalised.
            goal: the goal's configuration, or None if it is unknown: then there are no virtual
                obstacles, which might contain it.
        """
        self.states.append(state)
        moved, progress = np.linalg.norm(state - self.states[0]), PROGRESS
        if goal is not None:
            remaining = np.linalg.norm(goal - self.states[0])
            progress = min(PROGRESS, PROGRESS_SHARE * remaining)
        if self.steps_left == 0 and len(self.states) > PATIENCE and moved < progress:
            direction = self.rng.standard_normal(self.num_escape_joints)
            self.steps_left, self.direction = ESCAPE_STEPS, np.zeros(self.num_joints)
            direction *= self.max_step / np.linalg.norm(direction)
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


def check_env(env):
    """Raises ValueError if a safety filter cannot act in this environment."""
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
