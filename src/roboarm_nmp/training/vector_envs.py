"""A vector environment of processes that a trainer's signals do not end."""

import contextlib
from collections.abc import Callable, Sequence
from multiprocessing.util import Finalize

import gymnasium as gym
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.async_vector_env import _async_worker

from roboarm_nmp.utils.workers import starting_processes


def async_envs(makers: Sequence[Callable[[], gym.Env]]) -> AsyncVectorEnv:
    """Gymnasium's `AsyncVectorEnv`, with autoreset in the same step.

    Ctrl-C and SIGTERM, which terminals and `timeout` send to all processes, do not end these: the
    trainer finishes its step and writes a checkpoint. They end with the trainer, however it ends.

    Args:
        makers: functions that make an environment each.
    """
    with starting_processes():
        envs = AsyncVectorEnv(
            makers, context="spawn", worker=_work, autoreset_mode=AutoresetMode.SAME_STEP
        )
    Finalize(None, _abandon, (envs,), exitpriority=0)
    return envs


def _abandon(envs):
    """At the program's end, before `multiprocessing` waits for the processes: they end, too."""
    envs.closed = True  # Gymnasium would wait for their answers
    for pipe in envs.parent_pipes:
        if pipe is not None:  # as after an error in its process
            pipe.close()


def _work(*arguments):
    torch.set_num_threads(1)
    with contextlib.suppress(BrokenPipeError):  # the trainer has ended
        _async_worker(*arguments)
