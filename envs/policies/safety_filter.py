"""A last layer for any policy: it lets no link come too near to anything, and leaves dead ends.

    env = envs.make("random_boxes_hard", proximity="points")
    act = LastLayer().around(act, env, np.random.default_rng(0))      # at the start of an episode
    action = act(observation)

An action is changed as little as possible (L2) such that, as far as the gradients of the links'
distances tell, each link slows down towards whatever it comes near to, none comes nearer than
`keep`, and one that is nearer than that moves away. Things are what `proximity` tells of, and the
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
NEAR = 0.15  # m, from where on a link is looked at
# Share of the way that is left that one step may take: the arm does not stop at once.
BRAKE = 0.2
ARRIVING = 0.2  # L2, normalised: nearer to the goal than that, it may be more: all of it in the end
PUSH = 0.002  # m per step, by which a link that is too near moves away
# Near a goal that is itself nearer to something than what is kept, as much is kept as there, and
# this much (m) more per unit of normalised distance from it, as planners do.
GROWTH = 0.03
SWEEPS = 12  # of projections, one link after the other
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
class LastLayer:
    """A last layer.

    Attributes:
        keep: m, the distance that links keep from everything.
        way_out: whether it leaves dead ends.

    Raises:
        ValueError: `keep` is no distance below `NEAR`, or `way_out` not a bool.
    """

    keep: float = 0.01
    way_out: bool = True

    def __post_init__(self):
        if not (is_number(self.keep) and 0 <= self.keep < NEAR):
            raise ValueError(f"keep must be a distance below {NEAR} m, got {self.keep!r}")
        if not isinstance(self.way_out, bool):
            raise ValueError(f"way_out must be a bool, got {self.way_out!r}")

    def __call__(self, actions, proximity, keep=None, max_step=MAX_STEP, brake=BRAKE):
        """Actions (..., 7), changed as little as needed: float32.

        Args:
            actions: (..., 7), displacements of the normalised configuration.
            proximity: (..., rows, 8), as `envs.wrappers.ProximityWrapper` has it.
            keep: m, (..., rows), instead of the layer's.
            max_step: longest action (L2, normalised).
            brake: share of the way that is left to what is kept, that one step may take.
        """
        actions, proximity = np.array(actions, np.float64), np.asarray(proximity, np.float64)
        rows = proximity.shape[-2]
        keep = np.broadcast_to(self.keep if keep is None else keep, proximity.shape[:-1])
        keep = keep.astype(np.float64).reshape(-1, rows)
        project(
            actions.reshape(-1, 7),
            proximity.reshape(-1, rows, 8),
            keep,
            max_step,
            brake,
            NEAR,
            PUSH,
            SWEEPS,
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
        proximity_at, max_step = env.get_wrapper_attr("proximity_at"), env.max_step
        dead_ends, goal_distances = _DeadEnds(rng, max_step), None

        def act_safely(observation):
            nonlocal goal_distances
            state, goal = observation["observation"][: panda.NUM_JOINTS], None
            here = np.concatenate([observation["proximity"], _own_proximity(state)])
            keep, brake = np.broadcast_to(self.keep, len(here)), BRAKE
            if "goal_proximity" in observation:
                goal = observation["desired_goal"][: panda.NUM_JOINTS]
                if goal_distances is None:
                    rows = observation["goal_proximity"], _own_proximity(goal)
                    goal_distances = np.concatenate(rows)[:, 0]
                away = np.linalg.norm(state - goal)
                keep = self.kept(goal_distances, away)
                brake = max(BRAKE, 1.0 - (1.0 - BRAKE) * away / ARRIVING)
            action = dead_ends.detour(state, goal) if self.way_out else None
            if action is None:
                action = dead_ends.with_momentum(act(observation))
            # Dead ends come first: things have the last word.
            avoided = dead_ends.rows(state)
            here = np.concatenate([avoided, here])
            kept_here = np.concatenate([np.zeros(len(avoided)), keep])
            move = self(action, here, kept_here, max_step, brake)
            # The second look: what is near there, as if its gradient were the same all the way.
            there = np.concatenate([proximity_at(state + move), _own_proximity(state + move)])
            there[:, 0] -= there[:, 1:] @ move
            rows, kept = np.concatenate([here, there]), np.concatenate([kept_here, keep])
            dead_ends.last_action = self(action, rows, kept, max_step, brake)
            return dead_ends.last_action

        return act_safely

    def kept(self, goal_distances, away):
        """m that each link keeps, (rows,): less near a goal that is nearer to something itself.

        Args:
            goal_distances: m, (rows,), at the goal.
            away: from the goal, L2, normalised.
        """
        return np.minimum(self.keep, goal_distances + GROWTH * away)


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
        """(dead ends, 8), as `envs.wrappers.ProximityWrapper` has links; none in a detour."""
        rows = np.zeros((len(self.avoided) if self.left == 0 else 0, 8))
        for row, (centre, radius) in zip(rows, self.avoided, strict=False):
            away = state[:CARRYING] - centre
            distance = np.linalg.norm(away)
            row[0] = METRES * (distance - radius)
            row[1 : 1 + CARRYING] = METRES * away / max(distance, 1e-6)
        return rows


def check_env(env):
    """Raises ValueError: a last layer cannot act in this environment."""
    if "proximity" not in env.observation_space.spaces:
        raise ValueError("a last layer needs proximity in observations: envs.make(proximity=...)")
    if env.action_mode != "relative":
        raise ValueError(f"a last layer changes displacements: action_mode {env.action_mode!r}")


def layer_of(metadata):
    """The `LastLayer` that is part of a policy, from its file's metadata; None: it has none.

    Its options are in `last_layer`, a dict with `keep` and `way_out`. Raises ValueError: they make
    no sense.
    """
    options = metadata.get("last_layer")
    if options is None:
        return None
    try:
        return LastLayer(float(options["keep"]), bool(options["way_out"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"its last layer makes no sense: {options!r}") from error


@functools.cache
def _arm_alone():
    return CollisionChecker(Scene(table=None, floor=None))


def _own_proximity(state):
    """How far each link is from the other ones, as `proximity` has it."""
    return _arm_alone().proximity(state, self_collisions=True, within=NEAR)
