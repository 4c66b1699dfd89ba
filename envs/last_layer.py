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
goes into a random direction for a while.
"""

import functools
from collections import deque
from dataclasses import dataclass

import numpy as np

from envs import panda
from envs.collision import CollisionChecker, compiled
from envs.scenes import Scene, is_number
from envs.subgoals import MAX_STEP
from envs.wrappers import link_proximity

# The numbers below were chosen on validation queries of `random_boxes_hard`: docs/last_layer.md.
NEAR = 0.15  # m, from where on a link is looked at
# Share of the way that is left that one step may take: the arm does not stop at once.
BRAKE = 0.2
PUSH = 0.002  # m per step, by which a link that is too near moves away
# Near a goal that is itself nearer to something than what is kept, as much is kept as there, and
# this much (m) more per unit of normalised distance from it, as planners do.
GROWTH = 0.03
SWEEPS = 12  # of projections, one link after the other
# A dead end is where so many steps have moved the arm by less than this (L2, normalised).
PATIENCE, PROGRESS = 10, 0.06
DETOUR = 25  # steps into one random direction, to get out


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

    def __call__(self, actions, proximity, keep=None, max_step=MAX_STEP):
        """Actions (..., 7), changed as little as needed: float32.

        Args:
            actions: (..., 7), displacements of the normalised configuration.
            proximity: (..., rows, 8), as `envs.wrappers.ProximityWrapper` has it.
            keep: m, (..., rows), instead of the layer's.
            max_step: longest action (L2, normalised).
        """
        actions, proximity = np.array(actions, np.float64), np.asarray(proximity, np.float64)
        rows = proximity.shape[-2]
        keep = np.broadcast_to(self.keep if keep is None else keep, proximity.shape[:-1])
        keep = keep.astype(np.float64).reshape(-1, rows)
        _project(actions.reshape(-1, 7), proximity.reshape(-1, rows, 8), keep, max_step)
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
        before, left, direction = deque(maxlen=PATIENCE + 1), 0, None
        goal_distances = None

        def act_safely(observation):
            nonlocal left, direction, goal_distances
            state = observation["observation"][: panda.NUM_JOINTS]
            before.append(state)
            moved = np.linalg.norm(state - before[0])
            if left == 0 and self.way_out and len(before) > PATIENCE and moved < PROGRESS:
                left, direction = DETOUR, rng.standard_normal(panda.NUM_JOINTS)
                direction *= max_step / np.linalg.norm(direction)
            if left == 0:
                action = act(observation)
            else:
                left -= 1
                action = direction
                if left == 0:
                    before.clear()
            keep = self.keep
            if "goal_proximity" in observation:
                goal = observation["desired_goal"][: panda.NUM_JOINTS]
                if goal_distances is None:
                    rows = observation["goal_proximity"], _own_proximity(goal)
                    goal_distances = np.concatenate(rows)[:, 0]
                keep = self.kept(goal_distances, np.linalg.norm(state - goal))
            here = np.concatenate([observation["proximity"], _own_proximity(state)])
            keep = np.broadcast_to(keep, len(here))
            move = self(action, here, keep, max_step)
            # The second look: what is near there, as if its gradient were the same all the way.
            there = np.concatenate([proximity_at(state + move), _own_proximity(state + move)])
            there[:, 0] -= there[:, 1:] @ move
            return self(action, np.concatenate([here, there]), np.tile(keep, 2), max_step)

        return act_safely

    def kept(self, goal_distances, away):
        """m that each link keeps, (rows,): less near a goal that is nearer to something itself.

        Args:
            goal_distances: m, (rows,), at the goal.
            away: from the goal, L2, normalised.
        """
        return np.minimum(self.keep, goal_distances + GROWTH * away)


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
    return link_proximity(_arm_alone(), state, self_collisions=True, within=NEAR)


@compiled
def _project(actions, proximity, keep, max_step):
    """Change actions (n, 7) in place."""
    for i in range(actions.shape[0]):
        action = actions[i]
        _shorten(action, max_step)
        for _ in range(SWEEPS):
            for link in range(proximity.shape[1]):
                row = proximity[i, link]
                if row[0] >= NEAR:
                    continue
                squared = along = 0.0
                for j in range(7):
                    squared += row[1 + j] * row[1 + j]
                    along += row[1 + j] * action[j]
                short = min(BRAKE * (keep[i, link] - row[0]), PUSH) - along
                if short > 0.0 and squared > 1e-12:
                    for j in range(7):
                        action[j] += row[1 + j] * short / squared
        _shorten(action, max_step)


@compiled
def _shorten(action, max_step):
    squared = 0.0
    for j in range(7):
        squared += action[j] * action[j]
    if squared > max_step * max_step:
        for j in range(7):
            action[j] *= max_step / np.sqrt(squared)
