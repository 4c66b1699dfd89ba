"""roadmap_bc.py: its loss, its policy with a safety filter, its examples, resumed runs."""

import copy
import json

import numpy as np
import onnx
import pytest
import torch
from one_type import OneType
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainers import (
    PATHS,
    command,
    load,
    refusal,
    run_here,
    run_script,
    short_evaluations,
    stopped_run,
)

from roboarm_nmp import envs
from roboarm_nmp.datasets.roadmap_paths import load_roadmap_paths, shard_bytes
from roboarm_nmp.datasets.shards import shard_path
from roboarm_nmp.demo_generation.roadmap_examples import RoadmapExamples
from roboarm_nmp.demo_generation.roadmaps import Roadmap
from roboarm_nmp.envs.perception.geometry_source import ground_truth_checker
from roboarm_nmp.evaluation.evaluate import evaluate
from roboarm_nmp.networks.export import read_weights
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.policies.export import save_policy
from roboarm_nmp.policies.registry import PolicyError, find_policy, make_policy
from roboarm_nmp.policies.safety_filter import VERSION, SafetyFilter

roadmap_bc = load("roadmap_bc")
HARD = "random_boxes_hard"
CPU = torch.device("cpu")


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


@pytest.fixture(scope="module")
def setting(folder):
    """An untrained policy, its environment, and a batch of examples in two scenes."""
    source = {"geometry_source": "ground_truth", "link_distances": True}
    env = envs.make(HARD, goal_type="combined", encoder="point_cloud", **source)
    paths = load_roadmap_paths(folder)
    args = roadmap_bc.Args(token_width=16, hidden_size=32, bf16=False)
    make_examples = RoadmapExamples(HARD, paths, env.encoder, ground_truth_checker, 1, count=1536)
    pool = roadmap_bc.ExamplePool(3, env.encoder.token_size, CPU)
    for number in range(4):
        pool.add(*make_examples(number))
    batch = pool.sample(1500)
    assert len(torch.unique(batch["observation"][:, 10:], dim=0)) == 2
    torch.manual_seed(1)
    actor = roadmap_bc.Actor(args, env)
    torch.nn.init.normal_(actor.head.weight)  # (the initial one ignores the scene)
    yield actor, env, batch
    env.close()


def inputs_of(batch):
    names = ("observation", "desired_goal", "link_distances", "goal_link_distances")
    return {name: batch[name] for name in names}


# --- The policy


def test_update(setting):
    actor, _, batch = setting
    old, actor = copy.deepcopy(actor), copy.deepcopy(actor)
    optimizer = torch.optim.Adam(actor.parameters(), lr=1e-3)
    losses = list(roadmap_bc.update(actor, optimizer, 0.1, batch).values())
    with torch.no_grad():
        direction, length = (x.double().numpy() for x in old.outputs(**inputs_of(batch)))
    label = batch["direction"].double().numpy()
    cosine = (direction * label).sum(1) / np.sqrt((direction**2).sum(1) * (label**2).sum(1))
    error = np.abs(length - batch["length"].numpy())
    smooth = np.where(error < 1.0, error**2 / 2, error - 0.5)
    assert losses[0].item() == pytest.approx(1.0 - cosine.mean(), abs=1e-5)
    assert losses[1].item() == pytest.approx(smooth.mean(), rel=1e-4)
    for _ in range(30):
        last = list(roadmap_bc.update(actor, optimizer, 0.1, batch).values())
    assert last[0] < losses[0] - 0.02 and last[1] < losses[1]


def test_initial_action_is_straight_to_the_goal(setting):
    _, env, batch = setting
    inputs = inputs_of(batch)
    to_goal = inputs["desired_goal"][:, :7] - inputs["observation"][:, :7]
    near = to_goal / to_goal.norm(dim=1, keepdim=True).clamp(min=0.03) * 0.03
    action = roadmap_bc.Actor(roadmap_bc.Args(), env)(achieved_goal=None, **inputs)
    torch.testing.assert_close(action, near)


def test_order_of_tokens_and_rows_of_zeros_do_not_matter(setting):
    actor, _, batch = setting
    inputs = inputs_of(batch)
    direction, length = actor.outputs(**inputs)
    tokens = inputs["observation"][:, 10:].unflatten(1, (-1, actor.token_size))
    assert (tokens == 0.0).all(2).all(1).any()  # an empty scene
    assert direction.isfinite().all()
    more = torch.cat([tokens.flip(1), torch.zeros_like(tokens)], dim=1).flatten(1)
    inputs["observation"] = torch.cat([inputs["observation"][:, :10], more], dim=1)
    for one, other in zip(actor.outputs(**inputs), (direction, length), strict=True):
        torch.testing.assert_close(one, other)
    inputs["observation"] = torch.cat([inputs["observation"][:, :10], 0.0 * more], dim=1)
    assert (actor.outputs(**inputs)[0] - direction).abs().max() > 1e-3  # other tokens matter


def test_saved_policy_has_its_safety_filter_and_acts_alone_as_in_a_batch(setting, tmp_path):
    actor, env, _ = setting
    safety_filter = SafetyFilter(0.02, escape=False)
    arguments = {"goal_type": "combined", "encoder": env.encoder.name}
    arguments |= {"geometry_source": "ground_truth", "link_distances": True}
    save_policy(tmp_path / "policy.onnx", actor, HARD, safety_filter, **arguments)
    path, found = find_policy(tmp_path / "policy.onnx")
    assert found == arguments
    observations = [env.reset(seed=seed)[0] for seed in range(8)]
    network = load_network(path)
    stacked = {name: np.stack([one[name] for one in observations]) for name in observations[0]}
    together = network(**{name: torch.tensor(rows) for name, rows in stacked.items()}).numpy()
    changed = 0
    for row, observation in enumerate(observations):
        act, *_ = make_policy(path, env, safety_filter=False)(0, None)
        np.testing.assert_allclose(act(observation), together[row], atol=1e-6)
        env.reset(seed=row)  # the filter checks where an action leads from here
        safe, *_ = make_policy(path, env)(0, None)
        filtered = safety_filter.filter_policy(act, env, None)(observation)
        np.testing.assert_array_equal(safe(observation), filtered)
        changed += np.abs(filtered - together[row]).max() > 1e-4
    assert changed
    model = onnx.load(path)
    [entry] = [entry for entry in model.metadata_props if entry.key == "safety_filter"]
    entry.value = '{"margin": "far"}'
    onnx.save(model, tmp_path / "bad.onnx")
    with pytest.raises(PolicyError, match="bad.onnx: invalid safety_filter"):
        find_policy(tmp_path / "bad.onnx")


def test_pool_has_the_examples_of_the_last_scenes():
    pool = roadmap_bc.ExamplePool(2, 1, CPU)
    for number in range(1, 4):
        rows = np.full(50, number, np.float32)
        pool.add(np.full(3, number, np.float32), {"observation": rows[:, None], "length": rows})
        batch = pool.sample(100)
        expected = {float(last) for last in (number - 1, number) if last}
        assert set(batch["length"].tolist()) == expected
        assert (batch["observation"] == batch["length"][:, None]).all()  # with its scene's code


# --- Runs


@pytest.fixture
def rather_short_episodes():
    """Evaluations are over sooner, but late enough to reach goals."""
    with short_evaluations(250):
        yield


def test_stopped_and_resumed_run_is_bit_identical_and_evaluated_as_validated(
    tmp_path, folder, rather_short_episodes
):
    flags = ["--paths", str(folder), "--encoder", "point_cloud", "--num-points", "8"]
    flags += ["--safety-margin", "0.012"]
    whole = run_script("roadmap_bc", tmp_path / "whole", *flags)
    events = EventAccumulator(str(whole)).Reload()
    for tag in ("success_rate", "collision_free_success_rate", "success_rate_without_filter"):
        assert [event.step for event in events.Scalars(f"eval/{tag}")] == [20, 40]

    parts = tmp_path / "parts"
    stopped = stopped_run(parts, *command("roadmap_bc", parts, *flags)[1:])
    run_here(PATHS["roadmap_bc"], "--resume", stopped)
    one, other = (torch.load(run / "checkpoint.pt", weights_only=True) for run in (whole, stopped))
    for name in ("actor", "actor_average"):
        assert one[name].keys() == other[name].keys() and one[name]
        assert all(torch.equal(one[name][key], other[name][key]) for key in one[name])

    # The evaluation by name has the safety filter and the observations of the validation.
    best = json.loads((whole / "result.json").read_text())["validation_success_rate"]
    result = evaluate(whole, HARD, split="validation", num_queries=2)
    assert result["success_rate"] == best
    assert result["safety_filter"] == {"margin": 0.012, "escape": True, "version": VERSION}
    assert result["env"]["geometry_source"] == result["env"]["encoder"] == "point_cloud"
    assert result["env"]["num_points"] == 8
    bare = evaluate(whole, HARD, split="validation", num_queries=2, safety_filter=False)
    assert bare["safety_filter"] is None and bare["mean_steps"] != result["mean_steps"]
    assert bare["collision_rate"] >= result["collision_rate"]


def test_run_begins_with_the_weights_of_another_policy(tmp_path, folder, short_episodes):
    flags = ["--paths", str(folder), str(folder), "--encoder", "oracle"]
    flags += ["--eval-every", "40", "--eval-queries", "1", "--test-queries", "0"]
    first = run_script("roadmap_bc", tmp_path / "first", *flags)
    flags += ["--initial-policy", str(first), "--learning-rate", "1e-9", "--total-updates", "1"]
    second = run_script("roadmap_bc", tmp_path / "second", *flags)
    one, other = (read_weights(run / "policy.onnx") for run in (first, second))
    assert len(one) > 10 and np.abs(one["head.weight"]).max() > 0.001  # it begins with zeros
    for name, weights in one.items():
        np.testing.assert_allclose(other[name], weights, atol=1e-6, rtol=0.0)


def test_roadmaps_are_made_in_new_scenes_until_success(tmp_path, short_episodes):
    flags = ["--paths", "--encoder", "oracle", "--task", "random_boxes_easy", "--workers", "1"]
    flags += ["--stop-at-success", "0.0", "--eval-queries", "1", "--test-queries", "0"]
    run = run_script("roadmap_bc", tmp_path, *flags)
    assert json.loads((run / "result.json").read_text())["steps"] == 20  # the first evaluation


@pytest.mark.parametrize(
    "policy, message",
    [(f"roadmap-bc-combined-point_cloud-{HARD}-s1", "{}: the sizes"), ("nobody", "no such")],
)
def test_initial_policy_that_does_not_fit_is_rejected(tmp_path, folder, policy, message, capsys):
    flags = ["--paths", str(folder), "--initial-policy", policy]
    assert "--initial-policy: " + message.format(policy) in refusal(
        "roadmap_bc", capsys, tmp_path, *flags
    )


def test_goal_poses_are_imitated_saved_and_evaluated(tmp_path, folder, short_episodes):
    flags = ["--paths", str(folder), "--goal-type", "pose", "--eval-queries", "1"]
    run = run_script("roadmap_bc", tmp_path, *flags, "--encoder", "vqvae")  # a single token
    assert json.loads((run / "result.json").read_text())["goal_type"] == "pose"
    path, arguments = find_policy(run)
    env = envs.make(HARD, **arguments)
    observation, _ = env.reset(seed=0)
    act, *_ = make_policy(path, env)(0, None)
    assert 0.0 < np.linalg.norm(act(observation)) <= 0.03 + 1e-6
    env.close()


def test_run_on_another_device(tmp_path, folder, another_device, short_episodes):
    """Updates, an evaluation and a resume, on another device."""
    few = ["--total-updates", "4", "--eval-every", "4", "--eval-queries", "1"]
    flags = ["--paths", str(folder), "--encoder", "oracle", *few]
    run = run_script("roadmap_bc", tmp_path, *flags, "--device", another_device)
    assert load_network(run / "policy.onnx").metadata["step"] == 4
    assert json.loads((run / "result.json").read_text())["steps"] == 4
    args = json.loads((run / "args.json").read_text())
    assert args["bf16"] is True
    (run / "args.json").write_text(json.dumps(args | {"total_updates": 6}))
    run_here(PATHS["roadmap_bc"], "--resume", run)
    assert json.loads((run / "result.json").read_text())["steps"] == 6
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    assert state["counts"]["step"] == 6
    assert {tensor.device.type for tensor in state["actor"].values()} == {another_device}


def test_no_kernel_receives_two_dtypes(tmp_path, folder, short_episodes):
    few = "--encoder oracle --bf16 True --total-updates 4 --eval-every 4 --eval-queries 1"
    with OneType():
        run_script("roadmap_bc", tmp_path, "--paths", str(folder), *few.split())


@pytest.mark.parametrize(
    "flags, message",
    [
        (["--paths", "nowhere"], "--paths: nowhere"),
        (["--task", "narrow_shelves"], "narrow_shelves is for testing only"),
        (["--encoder", "lidar"], "--encoder: no such encoder: lidar"),
        (["--pool-scenes", "1"], "--first-scenes must be at most --pool-scenes"),
    ],
)
def test_bad_flags_are_rejected(tmp_path, flags, message, capsys):
    assert message in refusal("roadmap_bc", capsys, tmp_path, *flags)
