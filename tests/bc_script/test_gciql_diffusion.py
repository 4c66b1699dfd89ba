"""gciql.py and diffusion.py: goals and chunks by hand; what their policies learn from two ways."""

import numpy as np
import pytest
import torch
from trainers import load, panda_env

from roboarm_nmp.datasets.demonstrations import load_demos

gciql, diffusion = load("gciql"), load("diffusion")
SAME = {"observation": torch.full((64, 10), 0.1), "goal": torch.full((64, 3), 0.3)}
FIRST = torch.arange(64) % 2 == 0


def test_samples_of_demonstrations_by_hand():
    data = gciql.DemoSteps(load_demos("wall")[:20], "ee", None)
    row = {tuple(one): i for i, one in enumerate(data.achieved_goal)}
    args, rng = gciql.Args(batch_size=3000, random_goals=0.3, gamma=0.9), np.random.default_rng(0)
    batch = gciql.sample(data, panda_env(), args, rng)
    here = np.array([row[tuple(one)] for one in batch["observation"][:, 7:]])
    goals = [np.array([row[tuple(one)] for one in batch[k]]) for k in ("goal", "policy_goal")]
    np.testing.assert_array_equal(batch["next_observation"], data.observation[here + 1])
    assert (data.demo[goals[0]] != data.demo[here]).mean() == pytest.approx(0.285, abs=0.03)
    assert (goals[1] > here).all() and (goals[1] <= data.last[here]).all()
    reached = np.linalg.norm(data.achieved_goal[here + 1] - batch["goal"], axis=1) < 0.02
    np.testing.assert_array_equal(batch["reward"], reached - 1.0)
    batch = diffusion.sample(data, diffusion.Args(batch_size=300, chunk_size=5), rng)
    for observation, goal, chunk in zip(*batch.values(), strict=True):
        now = row[tuple(observation[7:])]
        moves = min(row.get(tuple(goal), data.last[now]) - now, 5)  # then the arm rests
        np.testing.assert_array_equal(chunk[:moves], data.action[now : now + moves])
        assert moves > 0 and not chunk[moves:].any()


@pytest.mark.parametrize("loss", ["awr", "ddpg_bc"])
def test_gciql_prefers_the_action_that_reaches_the_goal(loss):
    torch.manual_seed(0)
    flags = {"policy_loss": loss, "temperature": 0.1, "gamma": 0.9, "learning_rate": 3e-3}
    args = gciql.Args(goal_type="ee", hidden_size=32, bf16=False, **flags)
    agent = gciql.GCIQL(args, panda_env(), torch.device("cpu"))
    data = SAME | {"next_observation": SAME["observation"], "policy_goal": SAME["goal"]}
    data |= {"terminated": FIRST.float(), "reward": FIRST.float() - 1.0}
    for _ in range(250):
        agent.update(data | {"action": torch.eye(7)[1 - FIRST.long()]})
    good, bad, *_ = agent.actor.mean_action(agent.actor.features(*SAME.values()))[0]
    assert good > bad + 0.3


def test_diffusion_draws_one_of_two_ways_not_their_mean_and_executes_a_part_of_each_chunk():
    torch.manual_seed(0)
    flags = {"chunk_size": 4, "executed_actions": 3, "hidden_size": 64, "denoising_steps": 10}
    actor = diffusion.Actor(diffusion.Args(goal_type="ee", bf16=False, **flags), panda_env())
    optimizer = torch.optim.Adam(actor.parameters(), lr=3e-3)
    chunk = 0.01 * torch.where(FIRST, 1.0, -1.0)[:, None, None] * torch.arange(1.0, 5.0)[:, None]
    for _ in range(300):
        diffusion.update(actor, optimizer, SAME | {"chunk": chunk.expand(64, 4, 7)})
    state, executed = torch.zeros(64, actor.recurrent_size), []
    for _ in range(6):
        action, state = actor(SAME["observation"], None, SAME["goal"], state)
        executed.append(action[0].mean().item())
    expected = np.array([0.01, 0.02, 0.03] * 2) * np.sign(executed[0])
    np.testing.assert_allclose(executed, expected, atol=0.004)
