"""The environments of a trainer of policies, stepped together, and the episodes that they collect.

envs = TrainingEnvs(made, demo_prob=0.5)        # of `training.protocol.make_envs`
envs.begin_episodes(seed=1, step=0)
for episode in envs.step(actions):              # those that end with this step
    ...
"""

import contextlib
import functools
import multiprocessing.util
from concurrent.futures.process import BrokenProcessPool
from typing import NamedTuple

import numpy as np
import torch

from roboarm_nmp.datasets.episodes import DemoQueriesWrapper, demo_transitions, transition
from roboarm_nmp.utils.workers import begin_worker, starting_processes


class FinishedEpisode(NamedTuple):
    """What an environment collected.

    Attributes:
        number: of its environment.
        transitions: as `datasets.episodes.transition` makes them.
        episode_return: the sum of rewards.
        info: of the last step.
        demo: the transitions of a demonstration on the same query, which a failure adds; or None.
    """

    number: int
    transitions: list[dict]
    episode_return: float
    info: dict
    demo: list[dict] | None


class TrainingEnvs:
    """Environments that are stepped together. Each resets itself when its episode ends.

    What they do does not depend on the number of processes.

    Attributes:
        observations: of every environment, a list of dicts.
        demos: the `Demos` whose queries are theirs, or None.

    Args:
        envs: a list of environments.
        demo_prob: None, or the probability that a failure adds its query's demonstration. The
            environments then are `datasets.episodes.DemoQueriesWrapper`.
        processes: number of processes that share the environments; 0: they stay in this one.
    """

    def __init__(self, envs: list, demo_prob: float | None = None, processes: int = 0):
        self._num_envs = len(envs)
        self.observations: list[dict] = []
        self.demos = envs[0].demos if isinstance(envs[0], DemoQueriesWrapper) else None
        parts = np.array_split(np.arange(len(envs)), min(max(1, processes), len(envs)))
        groups = [_Group([envs[i] for i in part], int(part[0]), demo_prob) for part in parts]
        self._spans = [slice(part[0], part[-1] + 1) for part in parts]
        self._groups = [_Process(group) for group in groups] if processes else groups

    def encode_demos(self) -> None:
        """Encode the scenes of the demonstrations, if there are both encoder and demonstrations.

        It may take minutes, once; without it, scenes are encoded at their resets.
        """
        for group in self._groups:  # the first stores what the others load
            group.encode_demos()
            if isinstance(group, _Process):
                group.result()

    def begin_episodes(self, seed: int, step: int) -> list[list[dict]]:
        """Begin new episodes, whose random numbers depend on `seed` and `step` only.

        A trainer that begins new episodes at every checkpoint continues exactly without saving the
        simulator's state.

        Returns:
            The transitions of each episode that was running.
        """
        seeds = np.random.SeedSequence([seed, step]).generate_state(self._num_envs).tolist()
        return self._collect("begin_episodes", [seeds[span] for span in self._spans])

    def step(self, actions: np.ndarray) -> list[FinishedEpisode]:
        """One step with an action (n,) for each environment; the episodes that end with it."""
        return self._collect("step", [actions[span] for span in self._spans])

    def _collect(self, name, arguments):
        """Call a method of every group with its own argument, all at once; their episodes."""
        results = [
            getattr(group, name)(argument)
            for group, argument in zip(self._groups, arguments, strict=True)
        ]
        finished = []
        self.observations = []
        for group, result in zip(self._groups, results, strict=True):
            if isinstance(group, _Process):
                result = group.result()
            episodes, observations = result
            finished += episodes
            self.observations += observations
        return finished


class _Group:
    """The environments of a process. Methods return episodes, and the observations after them."""

    def __init__(self, envs, first, demo_prob):
        self._collectors = [_Collector(env, first + i, demo_prob) for i, env in enumerate(envs)]

    def encode_demos(self):
        env = self._collectors[0].env
        if isinstance(env, DemoQueriesWrapper):
            encoder = getattr(env.env, "encoder", None)
            if encoder is not None:
                encoder.encode_demos(env.demos)

    def begin_episodes(self, seeds):
        episodes = [
            collector.begin_episode(seed=seed)
            for collector, seed in zip(self._collectors, seeds, strict=True)
        ]
        return [episode for episode in episodes if episode], self._observations()

    def step(self, actions):
        episodes = [
            collector.step(action)
            for collector, action in zip(self._collectors, actions, strict=True)
        ]
        return [episode for episode in episodes if episode is not None], self._observations()

    def _observations(self):
        return [collector.observation for collector in self._collectors]


class _Process:
    """A `_Group` in a process of its own: methods return at once, and `result` waits for theirs."""

    def __init__(self, group):
        self._connection, other = multiprocessing.Pipe()
        process = multiprocessing.get_context("spawn").Process(
            target=_serve, args=(group, other), daemon=True
        )
        with starting_processes():
            process.start()
        other.close()
        # At the program's end, `multiprocessing` waits for a process, which waits for this.
        multiprocessing.util.Finalize(self, self._connection.close, exitpriority=0)

    @contextlib.contextmanager
    def _dying(self):
        try:
            yield
        except (EOFError, OSError):
            raise BrokenProcessPool("a process with environments has died") from None

    def __getattr__(self, name):
        return functools.partial(self._call, name)

    def _call(self, *call):
        with self._dying():
            self._connection.send(call)

    def result(self):
        with self._dying():
            result = self._connection.recv()
        if isinstance(result, Exception):
            raise result
        return result


def _serve(group, connection):
    """Do what a `_Process` asks for, until that or the process that it belongs to ends.

    SIGTERM, which `timeout` sends to all processes, does not end this one: the trainer finishes its
    step and writes a checkpoint.
    """
    begin_worker(is_terminable=False)
    torch.set_num_threads(1)
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            name, *arguments = connection.recv()
            try:
                result = getattr(group, name)(*arguments)
            except Exception as error:
                result = error
            connection.send(result)


class _Collector:
    """An environment and its running episode. The arguments are those of `TrainingEnvs`."""

    def __init__(self, env, number, demo_prob):
        self.env = env
        self.number = number
        self.demo_prob = demo_prob
        self.transitions = []

    def begin_episode(self, seed=None):
        """Returns the transitions of the episode that was running."""
        transitions = self.transitions
        self.transitions = []
        self.episode_return = 0.0
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
        demo = None
        may_add = self.demo_prob is not None and not info["is_success"]
        if may_add and self.env.np_random.random() < self.demo_prob:
            demo = demo_transitions(self.env.demo, self.env.env)
        episode_return = self.episode_return
        transitions = self.begin_episode()
        return FinishedEpisode(self.number, transitions, episode_return, info, demo)
