"""training/collection.py: the same episodes in any number of processes."""

import multiprocessing
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.episodes import DemoQueriesWrapper
from roboarm_nmp.training.collection import TrainingEnvs


def collected(processes):
    """Episodes of three environments, and what is left of them at the end."""
    made = [envs.make("wall", horizon=20 + 5 * i) for i in range(3)]
    demos = load_demos("wall", "wall")
    training = TrainingEnvs([DemoQueriesWrapper(env, demos) for env in made], 0.5, processes)
    training.encode_demos()  # there is no encoder
    assert training.begin_episodes(seed=3, step=100) == []
    rng, ended = np.random.default_rng(0), []
    for _ in range(70):
        ended += training.step(0.03 * rng.uniform(-1, 1, (3, 7)))
    return ended, training.begin_episodes(seed=3, step=310), training


def assert_same(one, other):
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        for name in a:
            np.testing.assert_array_equal(a[name], b[name])


@pytest.fixture(scope="module")
def alone():
    return collected(0)


def test_episodes_have_their_transitions_and_failures_add_demonstrations(alone):
    ended, left, training = alone
    assert [episode.number for episode in ended].count(0) == 3
    for episode in ended:
        assert len(episode.transitions) == 20 + 5 * episode.number
        assert episode.info["elapsed_steps"] == len(episode.transitions)
        assert episode.episode_return == -len(episode.transitions)
        assert not episode.info["is_success"]
    added = [episode for episode in ended if episode.demo is not None]
    assert 0 < len(added) < len(ended)
    for episode in added:
        np.testing.assert_array_equal(
            episode.demo[0]["desired_goal"], episode.transitions[0]["desired_goal"]
        )
    assert [len(transitions) for transitions in left] == [10, 20, 10]
    assert len(training.observations) == 3


def test_processes_collect_the_same_episodes(alone):
    ended, left, training = alone
    also_ended, also_left, also_training = collected(2)
    for one, other in zip(ended, also_ended, strict=True):
        assert (one.number, one.episode_return) == (other.number, other.episode_return)
        assert (one.demo is None) == (other.demo is None)
        assert_same(one.transitions, other.transitions)
    for one, other in zip(left, also_left, strict=True):
        assert_same(one, other)
    assert_same(training.observations, also_training.observations)
    for process in multiprocessing.active_children():
        process.terminate()  # as `timeout` does
    for _ in range(5):
        also_training.step(np.zeros((3, 7)))
    with pytest.raises(ValueError):  # of a process, here
        also_training.step(np.full((3, 7), np.nan))
    for process in multiprocessing.active_children():
        process.kill()
        process.join()
    for _ in range(2):
        with pytest.raises(BrokenProcessPool, match="a process with environments has died"):
            also_training.step(np.zeros((3, 7)))
