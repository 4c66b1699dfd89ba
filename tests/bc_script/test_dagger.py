"""dagger.py: its examples by hand, its loss, its policy with a last layer, resuming exactly."""

import copy
import importlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from one_type import OneType
from paths import ROOT
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainers import PATHS, command, load, refusal, run_here, run_script

from roboarm_nmp import envs
from roboarm_nmp.demo_generation.roadmaps import Roadmap
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.datasets.roadmap_paths import load_roadmap_paths, shard_bytes
from roboarm_nmp.envs.datasets.shards import shard_path
from roboarm_nmp.envs.networks.exported_networks import load_network
from roboarm_nmp.envs.perception.encoders import PRETRAINED
from roboarm_nmp.envs.policies.registry import PolicyError, find_policy, make_policy
from roboarm_nmp.envs.policies.safety_filter import VERSION, SafetyFilter
from roboarm_nmp.envs.training import protocol

sys.path.append(str(ROOT / "clean_rl_scripts"))
evaluate = importlib.import_module("evaluate").evaluate
dagger = load("dagger")
HARD = "random_boxes_hard"


# A path along two axes: what is left of it is easily said.
CORNER = np.zeros((3, 7), np.float32)
CORNER[1:, 0], CORNER[2, 1] = 0.5, 0.5


def write_paths(folder, scenes, paths):
    folder.mkdir(exist_ok=True)
    shard_path(folder, 0).write_bytes(shard_bytes(HARD, 0, 0, scenes, paths, "a test"))
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Paths in three scenes; nothing is in the first, and the second has no paths."""
    rng, task = np.random.default_rng(0), envs.get_task(HARD)
    scenes = [task.base_scene, *(task.scene.sample(rng) for _ in range(2))]
    paths = [Roadmap(scene, rng, num_nodes=150).random_paths(6, rng) for scene in scenes]
    return write_paths(tmp_path_factory.mktemp("paths"), scenes, [paths[0], [], paths[2]])


@pytest.fixture(scope="module", params=["oracle", "points", "vqvae"])
def some(request, folder, tmp_path_factory):
    """An untrained policy, its environment, and a batch of examples in two scenes."""
    encoder = request.param
    if encoder == "vqvae":  # a copy: z_E of the scenes is kept beside it
        encoder = str(tmp_path_factory.mktemp("encoder") / "vqvae.pt")
        Path(encoder).write_bytes((PRETRAINED / "vqvae.pt").read_bytes())
    env = envs.make(HARD, goal_type="combined", encoder=encoder, link_distances="obstacles")
    paths = load_roadmap_paths(folder)
    args = dagger.Args(encoder=encoder, token_size=16, hidden_size=32, bf16=False)
    examples = dagger.Examples(paths, args, "cpu")
    batch = dagger.concat([examples.draw(number) for number in range(6)])
    assert set(batch["scene"].tolist()) == {0, 2}
    torch.manual_seed(1)
    actor = dagger.Actor(args)
    torch.nn.init.normal_(actor.head.weight)  # (it begins as go-to-goal, whatever is there)
    latents = torch.as_tensor(env.encoder.encode_demos(paths))
    yield actor, env, dagger.with_scene(batch, latents, actor.row_size)
    env.close()


def inputs_of(batch):
    names = ("observation", "desired_goal", "link_distances", "goal_link_distances")
    return {name: batch[name] for name in names}


# --- Examples


def test_examples_say_how_paths_go_on_to_either_end(tmp_path):
    scene = envs.get_task(HARD).scene.sample(np.random.default_rng(3))
    paths = load_roadmap_paths(write_paths(tmp_path, [scene], [[CORNER, CORNER + 0.25]]))
    examples = dagger.Examples(paths, dagger.Args(noise=0.0, examples_per_update=96), "cpu")
    drawn = {name: tensor.numpy() for name, tensor in examples.draw(5).items()}
    states, goals = drawn["observation"][:, :7], drawn["desired_goal"][:, :7]
    offset = states[:, 6:]  # of the second path
    assert set(offset.ravel().round(5)) == {0.0, 0.25}
    travelled = (states - offset).sum(1)  # from the path's first point
    forwards = goals[:, 1] - offset[:, 0] > 0.25
    assert 20 < forwards.sum() < 76
    np.testing.assert_allclose(goals - offset, np.where(forwards[:, None], CORNER[2], 0), atol=1e-6)

    def at(travelled):
        points = np.zeros((len(travelled), 7))
        points[:, 0], points[:, 1] = np.minimum(travelled, 0.5), np.maximum(travelled - 0.5, 0.0)
        return points

    np.testing.assert_allclose(states - offset, at(travelled), atol=1e-6)
    assert travelled.min() < 0.15 and travelled.max() > 0.85 and np.ptp(travelled[forwards]) > 0.7
    after = np.clip(np.where(forwards, travelled + 0.1, travelled - 0.1), 0.0, 1.0)
    moves = at(after) - at(travelled)
    lengths = np.linalg.norm(moves, axis=1)
    np.testing.assert_allclose(drawn["direction"] * lengths[:, None], moves, atol=1e-5)
    left = np.where(forwards, 1.0 - after, after)
    np.testing.assert_allclose(drawn["length"], lengths + left, atol=1e-5)

    checker = CollisionChecker(scene)
    for name, where in (("link_distances", states), ("goal_link_distances", goals)):
        nearest = checker.signed_distances(where, self_collisions=False)
        near = np.minimum(nearest.distance, 0.3)
        np.testing.assert_allclose(drawn[name][..., 0], near, atol=1e-5)
        gradient = np.where(near[..., None] < 0.3, nearest.gradient, 0.0)
        # (Rounded to float32, another point of the same face may be the nearest.)
        assert (np.abs(drawn[name][..., 1:] - gradient) < 1e-4).mean() > 0.99


def test_noise_and_what_leads_back_to_the_path(tmp_path):
    scene = envs.get_task(HARD).base_scene
    paths = load_roadmap_paths(write_paths(tmp_path, [scene], [[CORNER]]))
    examples = dagger.Examples(paths, dagger.Args(examples_per_update=4000), "cpu")
    one, again, other = (examples.draw(number) for number in (1, 1, 2))
    assert all(torch.equal(one[name], again[name]) for name in one)
    assert not torch.equal(one["observation"], other["observation"])
    off = one["observation"][:, 2:7].numpy()  # in these joints the path is zero
    assert off.std() == pytest.approx(0.03, rel=0.05)
    back = one["direction"][:, 2:].numpy()
    assert (back * off <= 1e-6).all() and np.linalg.norm(back, axis=1).mean() > 0.2


# --- The policy


def test_an_update(some):
    actor, _, batch = some
    old, actor = copy.deepcopy(actor), copy.deepcopy(actor)
    optimizer = torch.optim.Adam(actor.parameters(), lr=1e-3)
    losses = dagger.update(actor, optimizer, batch, 0.1)
    with torch.no_grad():
        direction, length = (x.double().numpy() for x in old.outputs(**inputs_of(batch)))
    label = batch["direction"].double().numpy()
    cosine = (direction * label).sum(1) / np.sqrt((direction**2).sum(1) * (label**2).sum(1))
    error = np.abs(length - batch["length"].numpy())
    smooth = np.where(error < 1.0, error**2 / 2, error - 0.5)
    assert losses[0].item() == pytest.approx(1.0 - cosine.mean(), abs=1e-5)
    assert losses[1].item() == pytest.approx(smooth.mean(), rel=1e-4)
    for _ in range(30):
        last = dagger.update(actor, optimizer, batch, 0.1)
    assert last[0] < losses[0] - 0.02 and last[1] < losses[1]


def test_the_action_before_it_has_learned_is_straight_to_the_goal(some):
    _, env, batch = some
    args = dagger.Args(encoder=env.encoder.name)
    inputs = inputs_of(batch)
    to_goal = inputs["desired_goal"][:, :7] - inputs["observation"][:, :7]
    near = to_goal / to_goal.norm(dim=1, keepdim=True).clamp(min=0.03) * 0.03
    action = dagger.Actor(args)(achieved_goal=None, **inputs)
    torch.testing.assert_close(action, near)


def test_tokens_have_no_order_and_what_is_not_there_does_not_count(some):
    actor, env, batch = some
    if env.encoder.row_size == env.encoder.size:
        pytest.skip("z_E is a single token")
    inputs = inputs_of(batch)
    direction, length = actor.outputs(**inputs)
    tokens = inputs["observation"][:, 10:].unflatten(1, (-1, actor.row_size))
    assert (tokens == 0.0).all(2).all(1).any()  # an empty scene
    assert direction.isfinite().all()
    more = torch.cat([tokens.flip(1), torch.zeros_like(tokens)], dim=1).flatten(1)
    inputs["observation"] = torch.cat([inputs["observation"][:, :10], more], dim=1)
    for one, other in zip(actor.outputs(**inputs), (direction, length), strict=True):
        torch.testing.assert_close(one, other)
    inputs["observation"] = torch.cat([inputs["observation"][:, :10], 0.0 * more], dim=1)
    assert (actor.outputs(**inputs)[0] - direction).abs().max() > 1e-3  # but otherwise they do


def test_bfloat16_in_training_only(some):
    actor, _, batch = copy.deepcopy(some[0]), *some[1:]
    exact = actor.outputs(**inputs_of(batch))[0]
    for module in actor.modules():
        module.bf16 = True
    rough = actor.outputs(**inputs_of(batch))[0]
    assert 1e-4 < (rough - exact).abs().max() < 0.05 * exact.abs().max()
    torch.testing.assert_close(actor.eval().outputs(**inputs_of(batch))[0], exact)


def test_saved_with_its_layer_it_acts_alone_as_in_a_batch(some, tmp_path):
    actor, env, _ = some
    layer = SafetyFilter(0.02, escape=False)
    arguments = {
        "goal_type": "combined",
        "encoder": env.encoder.name,
        "link_distances": "obstacles",
    }
    flags = dagger.Args()
    protocol.save_policy(tmp_path, actor, [env], "cpu", flags, arguments, 7, layer)
    path, found = find_policy(tmp_path)
    assert found == arguments
    observations = [env.reset(seed=seed)[0] for seed in range(8)]
    network = load_network(path)
    together = network(**protocol.stack(observations, "cpu")).numpy()
    changed = 0
    for row, observation in enumerate(observations):
        act, _ = make_policy(path, env, safety_filter=False)(0, None)
        np.testing.assert_allclose(act(observation), together[row], atol=1e-6)
        env.reset(seed=row)  # the layer looks where the action leads
        safe, _ = make_policy(path, env)(0, None)
        kept = layer.filter_policy(act, env, None)(observation)
        np.testing.assert_array_equal(safe(observation), kept)
        changed += np.abs(kept - together[row]).max() > 1e-4
    assert changed
    content = torch.load(path, weights_only=True)
    content["metadata"]["safety_filter"] = {"keep": "far"}
    torch.save(content, tmp_path / "bad.pt")
    with pytest.raises(PolicyError, match="bad.pt: invalid safety_filter"):
        find_policy(tmp_path / "bad.pt")


# --- Runs


def finish(run):
    done = subprocess.run(
        [sys.executable, PATHS["dagger"], "--resume", run], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_a_run_killed_and_resumed_its_policy_by_name(tmp_path, folder):
    flags = ["--paths", str(folder), "--encoder", "points:8", "--safety-margin", "0.012"]
    whole = run_script("dagger", tmp_path / "whole", *flags)
    events = EventAccumulator(str(whole))
    events.Reload()
    for tag in ("success_rate", "collision_free_success_rate", "success_rate_without_filter"):
        assert [event.step for event in events.Scalars(f"eval/{tag}")] == [20, 40]
    assert [event.step for event in events.Scalars("charts/round_success")] == [15, 30]

    process = subprocess.Popen(
        command("dagger", tmp_path / "killed", *flags),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.time() + 300
    while not list((tmp_path / "killed").glob("*/checkpoint.pt")) and time.time() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    (killed,) = (tmp_path / "killed").iterdir()
    assert not (killed / "result.json").exists()
    finish(killed)
    one, other = (torch.load(run / "checkpoint.pt", weights_only=True) for run in (whole, killed))
    for name in ("actor", "actor_average", "visited"):
        assert one[name].keys() == other[name].keys() and one[name]
        assert all(torch.equal(one[name][key], other[name][key]) for key in one[name])

    # By name, what was validated: with its layer, and what it saw.
    best = one["progress"]
    result = evaluate(whole, HARD, split="validation", num_queries=2)
    assert result["success_rate"] == best["best_success"]
    assert result["safety_filter"] == {"keep": 0.012, "escape": True, "version": VERSION}
    assert result["env"]["link_distances"] == "points" and result["env"]["encoder"] == "points:8"
    bare = evaluate(whole, HARD, split="validation", num_queries=2, safety_filter=False)
    assert bare["safety_filter"] is None and bare["mean_steps"] != result["mean_steps"]
    assert bare["collision_rate"] >= result["collision_rate"]


def test_nothing_of_a_run_needs_the_cpu(tmp_path, folder, another_device, short_episodes):
    """Updates, a round, an evaluation and a resume, on another device."""
    few = ["--total-updates", "4", "--eval-every", "4", "--round-every", "2", "--eval-queries", "1"]
    flags = ["--paths", str(folder), "--encoder", "oracle", *few]
    run = run_script("dagger", tmp_path, *flags, "--device", another_device)
    assert load_network(run / "policy.pt").metadata["step"] == 4
    assert json.loads((run / "result.json").read_text())["steps"] == 4
    args = json.loads((run / "args.json").read_text())
    assert args["bf16"] is True
    (run / "args.json").write_text(json.dumps(args | {"total_updates": 6}))
    run_here(PATHS["dagger"], "--resume", run)
    assert json.loads((run / "result.json").read_text())["steps"] == 6
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    assert state["progress"]["updates"] == 6
    for name in ("actor", "visited"):  # a round came after the resume, too
        assert {tensor.device.type for tensor in state[name].values()} == {another_device}


def test_no_kernel_gets_two_types(tmp_path, folder, short_episodes):
    few = ["--total-updates", "4", "--eval-every", "4", "--round-every", "2", "--eval-queries", "1"]
    with OneType():
        run_script("dagger", tmp_path, "--paths", str(folder), "--bf16", "True", *few)


@pytest.mark.parametrize(
    "flags, message",
    [
        (["--paths", "nowhere"], "--paths: nowhere"),
        (["--task", "narrow_shelves"], "narrow_shelves is for testing only"),
        (["--encoder", "lidar"], "--encoder: no such encoder: lidar"),
        (["--batch-size", "0"], "--batch-size must be at least 1"),
        (["--pool-size", "5"], "--pool-size must be at least --examples-per-update"),
    ],
)
def test_bad_flags(tmp_path, flags, message, capsys):
    assert message in refusal("dagger", capsys, tmp_path, *flags)
