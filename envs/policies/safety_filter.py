"""A last layer for any policy: it lets no link come too near to anything, and leaves dead ends.

    env = envs.make("random_boxes_hard", link_distances="points")
    act = SafetyFilter().around(act, env, np.random.default_rng(0))      # at the start of an episode
    action = act(observation)

An action is changed as little as possible (L2) such that, as far as the gradients of the links'
distances tell, each link slows down towards whatever it comes near to, none comes nearer than
`keep`, and one that is nearer than that moves away. Things are what `link_distances` tells of, and the
other links, of which it does not: where they are is known. As a link's nearest point may be another
one after the step, the layer looks once more, at where the action leads.

That alone stands still where it cannot go on; so where the arm has hardly moved for some steps, it
goes into a random direction for a while, and does not come near that dead end again.
"""

import functools
from collections import deque
from dataclasses import dataclass

import numpy as np

from roboarm_nmp.envs import panda
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.collision.kernels import project
from roboarm_nmp.envs.scenes.primitives import Scene, is_number
from roboarm_nmp.envs.subgoals import MAX_STEP

# Of what the layer does, in results: with 1 it left dead ends otherwise, and did not remember them;
# with 2 it took slow arrivals for dead ends, and braked as much near a goal as elsewhere.
VERSION = 3

# The numbers below were chosen on validation and fresh queries: docs/experiments.md.
ACTIVATION_DISTANCE = 0.15  # m, from where on a link is looked at
# Share of the way that is left that one step may take: the arm does not stop at once.
CBF_GAIN = 0.2
ARRIVING = 0.2  # L2, normalised: nearer to the goal than that, it may be more: all of it in the end
MAX_RECOVERY = 0.002  # m per step, by which a link that is too near moves away
# Near a goal that is itself nearer to something than what is kept, as much is kept as there, and
# this much (m) more per unit of normalised distance from it, as planners do.
GROWTH = 0.03
PROJECTION_SWEEPS = 12  # of projections, one link after the other
# A dead end is where so many steps have moved the arm by less than this (L2, normalised), and by
# less than this share of what was left to the goal: it arrives slowly where there is little room.
PATIENCE, PROGRESS, ARRIVAL = 10, 0.06, 0.3
DETOUR = 10  # steps into one random direction, to get out
CARRYING = 4  # joints, from the base on, that decide where the arm is; the others turn the hand
# After a detour the arm's own direction counts beside the policy's action: so many times as much as
# the longest one, fading over so many steps.
MOMENTUM, FADING = 2.0, 40
# The carrying joints stay so far from where the arm was stuck (L2, normalised), at most this share
# of the goal's distance from there. Beside links' distances a unit of that counts as so many m.
AVOIDED, SHARE, METRES = 0.5, 0.9, 0.3


@dataclass(frozen=True)
class SafetyFilter:
    """A last layer.

    Attributes:
        keep: m, the distance that links keep from everything.
        escape: whether it leaves dead ends.

    Raises:
        ValueError: `keep` is no distance below `ACTIVATION_DISTANCE`, or `escape` not a bool.
    """

    margin: float = 0.01
    escape: bool = True

    def __post_init__(self):
        if not (is_number(self.margin) and 0 <= self.margin < ACTIVATION_DISTANCE):
            raise ValueError(
                f"keep must be a distance below {ACTIVATION_DISTANCE} m, got {self.margin!r}"
            )
        if not isinstance(self.escape, bool):
            raise ValueError(f"escape must be a bool, got {self.escape!r}")

    def __call__(self, actions, link_distances, margin=None, max_step=MAX_STEP, brake=CBF_GAIN):
        """Actions (..., 7), changed as little as needed: float32.

        Args:
            actions: (..., 7), displacements of the normalised configuration.
            link_distances: (..., rows, 8), as `envs.wrappers.LinkDistancesWrapper` has it.
            keep: m, (..., rows), instead of the layer's.
            max_step: longest action (L2, normalised).
            brake: share of the way that is left to what is kept, that one step may take.
        """
        actions, link_distances = (
            np.array(actions, np.float64),
            np.asarray(link_distances, np.float64),
        )
        rows = link_distances.shape[-2]
        margin = np.broadcast_to(
            self.margin if margin is None else margin, link_distances.shape[:-1]
        )
        margin = margin.astype(np.float64).reshape(-1, rows)
        project(
            actions.reshape(-1, 7),
            link_distances.reshape(-1, rows, 8),
            margin,
            max_step,
            brake,
            ACTIVATION_DISTANCE,
            MAX_RECOVERY,
            PROJECTION_SWEEPS,
        )
        return actions.astype(np.float32)

    def around(self, act, env, rng):
        """`act`, a function from an observation to an action (7,), with this layer: another one.

        For one episode.

        Args:
            act: the function.
            env: the `RoboArmEnv` that the episode is in. See `check_env`.
            rng: a NumPy Generator, for the directions out of dead ends.
        """
        link_distances_at, max_step = env.get_wrapper_attr("link_distances_at"), env.max_step
        dead_ends, goal_distances = _DeadEnds(rng, max_step), None

        def act_safely(observation):
            nonlocal goal_distances
            state, goal = observation["observation"][: panda.NUM_JOINTS], None
            here = np.concatenate([observation["link_distances"], _self_distances(state)])
            margin, brake = np.broadcast_to(self.margin, len(here)), CBF_GAIN
            if "goal_link_distances" in observation:
                goal = observation["desired_goal"][: panda.NUM_JOINTS]
                if goal_distances is None:
                    rows = observation["goal_link_distances"], _self_distances(goal)
                    goal_distances = np.concatenate(rows)[:, 0]
                away = np.linalg.norm(state - goal)
                margin = self.margins_near_goal(goal_distances, away)
                brake = max(CBF_GAIN, 1.0 - (1.0 - CBF_GAIN) * away / ARRIVING)
            action = dead_ends.detour(state, goal) if self.escape else None
            if action is None:
                action = dead_ends.with_momentum(act(observation))
            # Dead ends come first: things have the last word.
            avoided = dead_ends.rows(state)
            here = np.concatenate([avoided, here])
            kept_here = np.concatenate([np.zeros(len(avoided)), margin])
            move = self(action, here, kept_here, max_step, brake)
            # The second look: what is near there, as if its gradient were the same all the way.
            there = np.concatenate([link_distances_at(state + move), _self_distances(state + move)])
            there[:, 0] -= there[:, 1:] @ move
            rows, kept = np.concatenate([here, there]), np.concatenate([kept_here, margin])
            dead_ends.last_action = self(action, rows, kept, max_step, brake)
            return dead_ends.last_action

        return act_safely

    def margins_near_goal(self, goal_distances, away):
        """m that each link keeps, (rows,): less near a goal that is nearer to something itself.

        Args:
            goal_distances: m, (rows,), at the goal.
            away: from the goal, L2, normalised.
        """
        return np.minimum(self.margin, goal_distances + GROWTH * away)


class _DeadEnds:
    """Those of one episode: how to leave them, and where not to come again."""

    def __init__(self, rng, max_step):
        self.rng, self.max_step = rng, max_step
        self.before, self.left, self.direction = deque(maxlen=PATIENCE + 1), 0, None
        self.momentum, self.last_action = 0.0, None
        self.avoided = []  # configurations of the carrying joints, and how far they stay from there

    def detour(self, state, goal):
        """The next action of a way out (7,), or None: there is none to leave.

        Args:
            state: configuration (7,), normalised.
            goal: the goal's configuration, or None: nobody knows where not to go.
        """
        self.before.append(state)
        moved, least = np.linalg.norm(state - self.before[0]), PROGRESS
        if goal is not None:
            least = min(PROGRESS, ARRIVAL * np.linalg.norm(goal - self.before[0]))
        if self.left == 0 and len(self.before) > PATIENCE and moved < least:
            direction = self.rng.standard_normal(CARRYING)
            self.left, self.direction = DETOUR, np.zeros(panda.NUM_JOINTS)
            self.direction[:CARRYING] = direction * (self.max_step / np.linalg.norm(direction))
            if goal is not None:
                away = np.linalg.norm((goal - state)[:CARRYING])
                self.avoided.append((state[:CARRYING], min(AVOIDED, SHARE * away)))
        if self.left == 0:
            return None
        self.left -= 1
        if self.left == 0:
            self.before.clear()
            self.momentum = MOMENTUM
        return self.direction

    def with_momentum(self, action):
        """The policy's action (7,) with what is left of the momentum of the last detour."""
        if self.momentum <= 0.0:
            return action
        self.momentum -= MOMENTUM / FADING
        length = max(np.linalg.norm(self.last_action), 1e-6)
        return action + self.momentum * self.max_step / length * self.last_action

    def rows(self, state):
        """(dead ends, 8), as `envs.wrappers.LinkDistancesWrapper` has links; none in a detour."""
        rows = np.zeros((len(self.avoided) if self.left == 0 else 0, 8))
        for row, (centre, radius) in zip(rows, self.avoided, strict=False):
            away = state[:CARRYING] - centre
            distance = np.linalg.norm(away)
            row[0] = METRES * (distance - radius)
            row[1 : 1 + CARRYING] = METRES * away / max(distance, 1e-6)
        return rows


def check_env(env):
    """Raises ValueError: a last layer cannot act in this environment."""
    if "link_distances" not in env.observation_space.spaces:
        raise ValueError(
            "a last layer needs link_distances in observations: envs.make(link_distances=...)"
        )
    if env.action_mode != "relative":
        raise ValueError(f"a last layer changes displacements: action_mode {env.action_mode!r}")


def safety_filter_of(metadata):
    """The `SafetyFilter` that is part of a policy, from its file's metadata; None: it has none.

    Its options are in `safety_filter`, a dict with `keep` and `escape`. Raises ValueError: they make
    no sense.
    """
    options = metadata.get("safety_filter")
    if options is None:
        return None
    try:
        return SafetyFilter(float(options["margin"]), bool(options["escape"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"its last layer makes no sense: {options!r}") from error


@functools.cache
def _arm_alone():
    return CollisionChecker(Scene(table=None, floor=None))


def _self_distances(state):
    """How far each link is from the other ones, as `link_distances` has it."""
    return _arm_alone().link_distances(state, self_collisions=True, within=ACTIVATION_DISTANCE)
