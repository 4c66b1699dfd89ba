"""One update of SAC and TD3 against independent formulas."""

import copy

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform
from trainers import load, panda_env

sac, td3 = load("sac_her_mp"), load("td3_her_mp")
N = 64


def batch(seed=0):
    rng = torch.Generator().manual_seed(seed)

    def normal(*size):
        return torch.randn(*size, generator=rng)

    return {
        "observation": 0.5 * normal(N, 10),
        "next_observation": 0.5 * normal(N, 10),
        "desired_goal": 0.3 * normal(N, 3),
        "action": 0.03 * normal(N, 7),
        "reward": -(torch.rand(N, generator=rng) < 0.8).float(),
        "terminated": (torch.rand(N, generator=rng) < 0.2).float(),
    }


def make(module, kind, **flags):
    torch.manual_seed(1)
    args = module.Args(hidden_size=16, bf16=False, batch_size=N, **flags)
    return getattr(module, kind)(args, panda_env(), torch.device("cpu"))


def take_apart(agent, *names):
    """As if it had learned: targets that are not what they follow."""
    with torch.no_grad():
        for parameter in (one for name in names for one in getattr(agent, name).parameters()):
            parameter.mul_(1.3)


def state(agent):
    """All that an update may change, copied."""
    return copy.deepcopy({**agent._modules, **agent._parameters})


def update(agent, data):
    """What is logged of an update of the critics and then of the policy, with the same noise."""
    torch.manual_seed(5)
    losses = agent.update_critics(data)
    losses |= agent.update_actor(data)
    assert all(parameter.requires_grad for parameter in agent.critics.parameters())
    torch.manual_seed(5)
    return losses


def inputs_of(actor, data):
    """The networks' inputs for observations and for next observations."""
    goal = data["desired_goal"]
    return tuple(actor.features(data[name], goal) for name in ("observation", "next_observation"))


def values(critics, features, action):
    """Of both critics, (2, N), layer by layer."""
    both = []
    for mlp in critics.mlps:
        x = torch.cat([features, action / 0.06], dim=1)
        *hidden, head = mlp
        for layer, norm in zip(hidden[::3], hidden[1::3], strict=True):  # ReLU is the third
            x = torch.relu(F.layer_norm(layer(x), (16,), norm.weight, norm.bias))
        both.append(head(x)[:, 0])
    return torch.stack(both)


def assert_adam_step(before, after, loss, rate):
    """`after` is `before` minus the first step of Adam on the gradient of `loss` at `before`."""
    gradients = torch.autograd.grad(loss, before, retain_graph=True)
    assert any(gradient.abs().max() > 1e-6 for gradient in gradients)
    for old, new, gradient in zip(before, after, gradients, strict=True):
        step = -rate * gradient / (gradient.abs() + 1e-8)
        clear = gradient.abs() > 1e-6  # of smaller ones, rounding decides the sign
        torch.testing.assert_close((new - old)[clear], step[clear], rtol=2e-2, atol=1e-6)


def assert_moved(old, new, toward, share):
    for a, b, c in zip(*(list(m.parameters()) for m in (old, new, toward)), strict=True):
        torch.testing.assert_close(b, (1 - share) * a + share * c, rtol=1e-4, atol=1e-7)


def squashed_gaussian(actor, features, noise):
    """The policy's action for given normal numbers, and its log-density, by torch.distributions."""
    mean, log_std = actor.mlp(features).chunk(2, dim=1)
    std = torch.exp(-5 + 3.5 * (torch.tanh(log_std) + 1))
    unsquashed = mean + std * noise
    density = TransformedDistribution(Normal(mean, std), TanhTransform(cache_size=1))
    action = density.transforms[0](unsquashed)
    return 0.06 * action, density.log_prob(action).sum(1)


def cloning_loss(mean, data):
    """Mean squared difference of tanh(mean) (N, 7) from the last ten actions, in units of 0.06."""
    difference = torch.tanh(mean)[-10:] - data["action"][-10:] / 0.06
    return difference.square().sum() / 10


@pytest.mark.parametrize("target_entropy, bc_weight", [(-7.0, 0.0), (None, 0.0), (-7.0, 3.0)])
def test_update_of_sac(target_entropy, bc_weight, monkeypatch):
    flags = {"tau": 0.1, "target_entropy": target_entropy}
    flags |= {"bc_weight": bc_weight}
    monkeypatch.setattr(sac, "DEMO_BATCH_SIZE", 10)
    agent = make(sac, "SAC", gamma=0.9, alpha=0.3, **flags)
    take_apart(agent, "critics_target")
    old, data = state(agent), batch()
    losses = update(agent, data)
    noises = torch.randn(N, 7), torch.randn(N, 7)
    new = state(agent)
    now, later = inputs_of(old["actor"], data)

    following, density = squashed_gaussian(old["actor"], later, noises[0])
    future = values(old["critics_target"], later, following).amin(0) - 0.3 * density
    target = (data["reward"] + 0.9 * (1 - data["terminated"]) * future).detach()
    errors = (values(old["critics"], now, data["action"]) - target).square().mean(1)
    torch.testing.assert_close(losses["qf_loss"], errors, rtol=1e-3, atol=1e-5)
    before, after = (list(one["critics"].parameters()) for one in (old, new))
    assert_adam_step(before, after, errors.sum(), agent.args.learning_rate)
    assert_moved(old["critics_target"], new["critics_target"], new["critics"], 0.1)

    # The policy's step is against the critics that were just updated.
    action, density = squashed_gaussian(old["actor"], now, noises[1])
    q = values(new["critics"], now, action)
    loss = (0.3 * density - q.amin(0)).mean()
    if bc_weight:
        bc_loss = cloning_loss(old["actor"].mlp(now)[:, :7], data)
        torch.testing.assert_close(losses["bc_loss"], bc_loss, rtol=1e-3, atol=1e-5)
        loss = loss + bc_weight * bc_loss
    torch.testing.assert_close(losses["actor_loss"], loss, rtol=1e-3, atol=1e-4)
    before, after = (list(one["actor"].parameters()) for one in (old, new))
    assert_adam_step(before, after, loss, agent.args.learning_rate)

    # Entropy below its target (-mean of log pi < target) raises alpha, above it lowers it.
    moved = (new["log_alpha"] - old["log_alpha"]).item()
    expected = 0.0
    if target_entropy is not None:
        below = -density.mean().item() < target_entropy
        expected = agent.args.learning_rate if below else -agent.args.learning_rate
    assert moved == pytest.approx(expected, rel=1e-3, abs=1e-8)


@pytest.mark.parametrize("bc_weight", [0.0, 3.0])
def test_update_of_td3(bc_weight, monkeypatch):
    flags = {"tau": 0.1, "preactivation_penalty": 0.4}
    flags |= {"bc_weight": bc_weight}
    monkeypatch.setattr(td3, "DEMO_BATCH_SIZE", 10)
    agent = make(td3, "TD3", gamma=0.9, **flags)
    take_apart(agent, "actor_target", "critics_target")
    old, data = state(agent), batch()
    losses = update(agent, data)
    noise = 0.2 * torch.randn(N, 7).numpy()
    assert np.abs(noise).max() > 0.5
    noise = np.clip(noise, -0.5, 0.5)
    new = state(agent)
    now, later = inputs_of(old["actor"], data)

    following = old["actor_target"](data["next_observation"], None, data["desired_goal"])
    following = following.detach().numpy()
    following = torch.from_numpy(np.clip(following + 0.06 * noise, -0.06, 0.06))
    future = values(old["critics_target"], later, following).amin(0)
    target = (data["reward"] + 0.9 * (1 - data["terminated"]) * future).detach()
    errors = (values(old["critics"], now, data["action"]) - target).square().mean(1)
    torch.testing.assert_close(losses["qf_loss"], errors, rtol=1e-3, atol=1e-5)
    before, after = (list(one["critics"].parameters()) for one in (old, new))
    assert_adam_step(before, after, errors.sum(), agent.args.learning_rate)
    assert_moved(old["critics_target"], new["critics_target"], new["critics"], 0.1)

    preactivation = old["actor"].mlp(now)
    q = values(new["critics"], now, 0.06 * torch.tanh(preactivation))[0]
    loss = 0.4 * preactivation.square().mean() - q.mean()
    if bc_weight:
        bc_loss = cloning_loss(preactivation, data)
        torch.testing.assert_close(losses["bc_loss"], bc_loss, rtol=1e-3, atol=1e-5)
        loss = loss + bc_weight * bc_loss
    torch.testing.assert_close(losses["actor_loss"], loss, rtol=1e-3, atol=1e-4)
    before, after = (list(one["actor"].parameters()) for one in (old, new))
    assert_adam_step(before, after, loss, agent.args.learning_rate)
    assert_moved(old["actor_target"], new["actor_target"], new["actor"], 0.1)


def test_exploration_noise_of_td3_has_the_given_size():
    agent, data = make(td3, "TD3", exploration_noise=0.2), batch()
    given = {"observation": data["observation"], "achieved_goal": None}
    given["desired_goal"] = data["desired_goal"]
    with torch.no_grad():
        noise = agent.explore(given)["actions"] - agent.actor.eval()(**given)
    assert 0.18 < noise.std() / 0.06 < 0.22 and noise.mean().abs() < 0.03 * 0.06
