"""crl_mp.py: hindsight goals, the critic's losses and energies, the policy's update."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from trainers import load, panda_env

crl = load("crl_mp")
N = 12


def make_agent(**flags):
    torch.manual_seed(1)
    args = crl.Args(hidden_size=16, bf16=False, batch_size=N, **flags)
    return crl.CRL(args, panda_env(), torch.device("cpu"))


def batch():
    rng = torch.Generator().manual_seed(0)
    sizes = {"observation": (10, 0.5), "action": (7, 0.03), "goal": (3, 0.3)}
    return {name: k * torch.randn(N, size, generator=rng) for name, (size, k) in sizes.items()}


def test_goals_are_reached_later_in_the_episode_sooner_ones_with_higher_probability():
    args = crl.Args(gamma=0.5)
    buffer = crl.HerReplayBuffer(panda_env(), 100, args, np.random.default_rng(0))
    for offset in (0, 100):
        step = {"action": np.zeros(7), "collision": False}
        goals = [{"next_achieved_goal": np.full(3, offset + k)} for k in range(4)]
        states = [{"observation": np.full(10, offset + k)} for k in range(4)]
        buffer.add_episode([step | goals[k] | states[k] for k in range(4)])
    data = buffer.sample(20_000)
    now, goal = data["observation"][:, 0], data["goal"][:, 0]
    assert (now // 100 == goal // 100).all()
    counts = np.bincount(goal[now == 100].astype(int) - 100, minlength=4)
    np.testing.assert_allclose(counts / counts.sum(), np.array([8, 4, 2, 1]) / 15, atol=0.03)
    assert (goal[now == 103] == 103).all()


@pytest.mark.parametrize("energy", ["norm", "l2", "dot", "cosine"])
def test_energy_of_pairs_and_of_all_pairs_by_hand(energy):
    critic = make_agent(energy=energy).critic
    x, y = critic.representations(*batch().values())
    apart = (x[:, None] - y[None]).norm(dim=2)
    expected = {"norm": -apart, "l2": -apart.square(), "dot": x @ y.T}
    expected["cosine"] = (x @ y.T) / (x.norm(dim=1)[:, None] * y.norm(dim=1))
    torch.testing.assert_close(critic.all_pairs(*batch().values()), expected[energy])
    torch.testing.assert_close(critic(*batch().values()), expected[energy].diagonal())


@pytest.mark.parametrize("loss", ["forward", "backward", "symmetric", "binary"])
def test_losses_are_cross_entropies_and_their_updates_find_the_goals(loss):
    agent, data = make_agent(contrastive_loss=loss, logsumexp_penalty=0.0), batch()
    logits, own = agent.critic.all_pairs(*data.values()), torch.arange(N)
    forward, backward = F.cross_entropy(logits, own), F.cross_entropy(logits.T, own)
    each = F.binary_cross_entropy(torch.sigmoid(logits), torch.eye(N))
    expected = {"forward": forward, "backward": backward, "binary": each}
    expected["symmetric"] = forward + backward
    first = agent.update_critics(data)
    torch.testing.assert_close(first["critic_loss"], expected[loss])
    for _ in range(100):
        last = agent.update_critics(data)
    assert last["critic_loss"] < 0.5 * first["critic_loss"]
    assert last["accuracy"].mean() > first["accuracy"].mean()


def test_policy_moves_towards_what_the_critic_prefers():
    agent, data = make_agent(random_goals=0.0, alpha=1e-6, target_entropy=None), batch()
    for _ in range(100):
        agent.update_critics(data)

    def value():
        features = agent.actor.features(data["observation"], data["goal"])
        actions = agent.actor.mean_action(features)
        return agent.critic(data["observation"], actions, data["goal"]).mean().item()

    before, critic = value(), [p.clone() for p in agent.critic.parameters()]
    for _ in range(50):
        agent.update_actor(data)
    assert value() > before + 0.01
    assert all(torch.equal(a, b) for a, b in zip(critic, agent.critic.parameters(), strict=True))
