"""The environments of a trainer of policies, stepped together, and the episodes that they collect.

envs = TrainingEnvs(made, demo_prob=0.5)        # of `envs.training.protocol.make_envs`
envs.begin_episodes(seed=1, step=0)
for episode in envs.step(actions):              # those that end with this step
    ...
"""

from typing import NamedTuple

import numpy as np

from roboarm_nmp.envs.datasets.episodes import (
    DemoQueriesWrapper,
    demo_transitions,
    transition,
)


class FinishedEpisode(NamedTuple):
    """What an environment collected.

    `number` is that of its environment; `transitions` a list, as of
    `envs.datasets.episodes.transition`; `episode_return` the sum of rewards; `info` that of the
    last step; `demo` the transitions of a demonstration on the same query that a failure adds, or
    None.
    """

    number: int
    transitions: list
    episode_return: float
    info: dict
    demo: list | None


class TrainingEnvs:
    """Environments that are stepped together. Each resets itself when its episode ends.

    Attributes:
        observations: of every environment, a list of dicts.

    Args:
        envs: a list of environments.
        demo_prob: None, or the probability that a failure adds its query's demonstration. The
            environments then are `envs.datasets.episodes.DemoQueriesWrapper`.
    """

    def __init__(self, envs, demo_prob=None):
        self._collectors = [_Collector(env, number, demo_prob) for number, env in enumerate(envs)]

    def encode_demos(self):
        """Encode the scenes of the demonstrations, if there are both encoder and demonstrations.

        It may take minutes, once; without it, scenes are encoded at their resets.
        """
        env = self._collectors[0].env
        if isinstance(env, DemoQueriesWrapper) and hasattr(env.env, "encoder"):
            env.env.encoder.encode_demos(env.demos)

    @property
    def observations(self):
        return [collector.observation for collector in self._collectors]

    def begin_episodes(self, seed, step):
        """Begin new episodes, whose random numbers depend on `seed` and `step` only.

        A trainer that begins new episodes at every checkpoint continues exactly without saving the
        simulator's state.

        Returns:
            The transitions of each episode that was running, a list of lists.
        """
        seeds = np.random.SeedSequence([seed, step]).generate_state(len(self._collectors)).tolist()
        begun = zip(self._collectors, seeds, strict=True)
        running = [collector.begin_episode(seed=one) for collector, one in begun]
        return [transitions for transitions in running if transitions]

    def step(self, actions):
        """One step with an action (n,) for each environment; the `FinishedEpisode`s, a list."""
        steps = zip(self._collectors, actions, strict=True)
        ended = [collector.step(action) for collector, action in steps]
        return [episode for episode in ended if episode is not None]


class _Collector:
    """An environment and its running episode. The arguments are those of `TrainingEnvs`."""

    def __init__(self, env, number, demo_prob):
        self.env, self.number, self.demo_prob = env, number, demo_prob
        self.transitions = []

    def begin_episode(self, seed=None):
        """Returns the transitions of the episode that was running."""
        transitions, self.transitions, self.episode_return = self.transitions, [], 0.0
        self.observation, _ = self.env.reset(seed=seed)
        return transitions

    def step(self, action):
        """Returns a `FinishedEpisode`, or None."""
        before = self.observation
        self.observation, reward, terminated, truncated, info = self.env.step(action)
        self.transitions.append(transition(before, action, self.observation, info["collision"]))
        self.episode_return += reward
        if not (terminated or truncated):
            return None
        demo, episode_return = None, self.episode_return
        may_add = self.demo_prob is not None and not info["is_success"]
        if may_add and self.env.np_random.random() < self.demo_prob:
            demo = demo_transitions(self.env.demo, self.env.env)
        transitions = self.begin_episode()
        return FinishedEpisode(self.number, transitions, episode_return, info, demo)
