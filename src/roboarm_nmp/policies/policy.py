"""What a policy is: a function from an observation to an action, made anew for each episode."""

import abc
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.arm_env import Observation, RoboArmEnv

Policy = Callable[[Observation], np.ndarray]
"""A policy in one episode: a function from an observation to an action (n,)."""


class EpisodePolicy(NamedTuple):
    """A policy in one episode.

    act: act(observation) -> action (n,); None: the policy gives up.
    plan_found: whether it found a motion; None if it does not look for one.
    searched: whether it searched for that motion where a network's did not do.
    """

    act: Policy | None
    plan_found: bool | None = None
    searched: bool = False


BeginEpisode = Callable[[int, Query], EpisodePolicy]
"""A policy in an environment: a function that is called with a query's number and the query, once
per episode, before the environment's reset to the query."""


class Method(abc.ABC):
    """A policy that begins each episode with the query, for example to plan.

    Each process of an evaluation has a copy, which is made by pickling.
    """

    @abc.abstractmethod
    def begin(self, env: RoboArmEnv, seed: int) -> BeginEpisode:
        """What begins the episodes in an environment."""
