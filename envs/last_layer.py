"""A last layer for any policy: it lets no link come too near to anything, and leaves dead ends.

    env = envs.make("random_boxes_hard", proximity="points")
    act = LastLayer().around(act, np.random.default_rng(0))      # at the start of an episode
    action = act(observation)

An action is changed as little as possible (L2) such that, as far as the gradients of the links'
distances tell, each link slows down towards whatever it comes near to, none comes nearer than
`keep`, and one that is nearer than that moves away. That alone stands still where it cannot go on;
so where the arm has hardly moved for some steps, it goes into a random direction for a while.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from envs import panda
from envs.collision import compiled
from envs.subgoals import MAX_STEP

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
        keep: m, the distance that links keep from everything that `proximity` tells of.
        way_out: whether it leaves dead ends.
        max_step: longest action (L2, normalised), as of the environment.
    """

    keep: float = 0.01
    way_out: bool = True
    max_step: float = MAX_STEP

    def __call__(self, actions, proximity, keep=None):
        """Actions (..., 7), changed as little as needed: float32.

        Args:
            actions: (..., 7), displacements of the normalised configuration.
            proximity: (..., links, 8), as `envs.wrappers.ProximityWrapper` has it.
            keep: m, (..., links), instead of the layer's: see `kept`.
        """
        actions, rows = np.array(actions, np.float64), np.asarray(proximity, np.float64)
        links = rows.shape[-2]
        keep = np.broadcast_to(self.keep if keep is None else keep, rows.shape[:-1])
        keep = keep.astype(np.float64).reshape(-1, links)
        _project(actions.reshape(-1, 7), rows.reshape(-1, links, 8), keep, self.max_step)
        return actions.astype(np.float32)

    def around(self, act, rng):
        """`act`, a function from an observation to an action (7,), with this layer: another one.

        For one episode. `rng`, a NumPy Generator, gives the directions out of dead ends.
        """
        before, left, direction = deque(maxlen=PATIENCE + 1), 0, None

        def act_safely(observation):
            nonlocal left, direction
            state = observation["observation"][: panda.NUM_JOINTS]
            before.append(state)
            moved = np.linalg.norm(state - before[0])
            if left == 0 and self.way_out and len(before) > PATIENCE and moved < PROGRESS:
                left, direction = DETOUR, rng.standard_normal(panda.NUM_JOINTS)
                direction *= self.max_step / np.linalg.norm(direction)
            if left == 0:
                action = act(observation)
            else:
                left -= 1
                action = direction
                if left == 0:
                    before.clear()
            return self(action, observation["proximity"], self.kept(observation))

        return act_safely

    def kept(self, observation):
        """The distance that each link keeps, m: (10,). Less near a goal that is nearer itself."""
        if "goal_proximity" not in observation:
            return np.full(len(observation["proximity"]), self.keep)
        state, goal = observation["observation"], observation["desired_goal"]
        away = np.linalg.norm(state[: panda.NUM_JOINTS] - goal[: panda.NUM_JOINTS])
        return np.minimum(self.keep, observation["goal_proximity"][:, 0] + GROWTH * away)


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
