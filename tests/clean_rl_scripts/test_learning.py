"""SAC and TD3 learn to reach goals: the whole loop, with hindsight and bootstrapping."""

import functools

import numpy as np
import pytest
import torch
from trainers import load, panda_env, run_script

import roboarm_nmp
from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.networks.network_file import load_network

READY = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8], np.float32)  # rad
FLAGS = "--goal-type ee --total-timesteps 2000 --learning-starts 300 --horizon 30 --gamma 0.9"
FLAGS += (
    " --updates-per-step 1 --hidden-size 64 --batch-size 128 --policy-average 0.01 --num-envs 4"
)
FLAGS += " --bf16 False --eval-every 2000 --eval-queries 1 --test-queries 1"
OF_SAC = " --alpha 0.02 --target-entropy -14"


def query(_, rng):
    """From `READY`, a goal about ten steps away in any direction."""
    goal = PANDA.normalise(READY) + rng.uniform(-0.3, 0.3, 7)
    return READY, PANDA.denormalise(goal).astype(np.float32)


# They differ in their losses: test_updates, test_crl_mp.
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("td3_her_mp", "crl_mp")]


@pytest.mark.parametrize("trainer", ["sac_her_mp", *SLOW])
def test_trainer_learns_to_reach_near_goals(trainer, tmp_path, monkeypatch):
    make = functools.partial(envs.make, ee_tolerance=0.05)  # m
    monkeypatch.setattr(roboarm_nmp, "make", make)
    monkeypatch.setattr(envs.RoboArmEnv, "sample_query", query)
    flags = FLAGS + OF_SAC * (trainer == "sac_her_mp")
    run = run_script(trainer, tmp_path, *flags.split())

    rng, scene = np.random.default_rng(7), envs.get_task("no_obstacles").base_scene
    queries = [Query(*query(None, rng), scene) for _ in range(40)]
    env = make("no_obstacles", horizon=30)

    def success_rate(policy):
        @torch.no_grad()
        def act(observation):
            inputs = {name: torch.tensor(value[None]) for name, value in observation.items()}
            return policy(**inputs)[0].numpy()

        return np.mean([rollout(env, query, act).success for query in queries])

    module = load(trainer)
    untrained = module.Actor(module.Args(hidden_size=64, bf16=False), panda_env()).eval()
    before, after = map(success_rate, (untrained, load_network(run / "policy.onnx")))
    # (Seeds 1 to 3 reach 0.8 and more; below 0.5 without bootstrapping, --gamma 0, and below 0.1
    # without hindsight.)
    assert before < 0.1 and after > 0.65
