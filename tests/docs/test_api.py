"""docs/reference/api.md: its snippets run from top to bottom, and its references exist."""

import numpy as np
import pytest
import torch
from docs_scripts import names_of
from paths import ROOT
from trainers import short_evaluations

import roboarm_nmp
from roboarm_nmp.clean_rl_scripts import evaluate
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.policies.export import save_policy
from roboarm_nmp.policies.registry import PolicyError

PAGE = (ROOT / "docs/reference/api.md").read_text()


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The folder and the names after all snippets were run, in their order."""
    folder = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch, short_evaluations():
        patch.chdir(folder)
        return folder, names_of("reference/api.md")


def test_snippets_of_the_page_run(page):
    folder, names = page
    assert sorted(path.name for path in folder.iterdir()) == [
        *("back.h5", "episode.npz", "my_scene.yaml", "path.csv", "policy.onnx", "problems.h5")
    ]
    assert names["filtered"]["safety_filter"]["margin"] == 0.01
    assert len(names["demos"][:10]) == 10


def test_stable_baselines3_policy_of_the_page_acts_as_its_model(page, capsys, short_episodes):
    folder, names = page
    arguments = ["--policy", str(folder / "policy.onnx"), "--task", "wall", "--num-queries", "2"]
    assert evaluate.main([*arguments, "--workers", "1"]) == 0
    assert "on wall: 2 test queries" in capsys.readouterr().out
    model, network = names["model"], load_network(folder / "policy.onnx")
    env = roboarm_nmp.make("wall", goal_type="ee")
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        expected = model.predict(observation, deterministic=True)[0]
        np.testing.assert_allclose(network.predict_one(observation, 7)[0], expected, atol=1e-5)
    env.close()


def test_policy_with_other_actions_or_arguments_is_rejected(tmp_path):
    class Goal(torch.nn.Module):
        def forward(self, observation, achieved_goal, desired_goal):
            return desired_goal

    with pytest.raises(PolicyError, match=r"must be \(2, 7\), got \(2, 3\)"):
        save_policy(tmp_path / "a.onnx", Goal(), "wall", goal_type="ee")
    with pytest.raises(PolicyError, match="horizon: not among the arguments that a policy stores"):
        save_policy(tmp_path / "a.onnx", Goal(), "wall", goal_type="config", horizon=10)
    assert not list(tmp_path.iterdir())
    save_policy(tmp_path / "a.onnx", Goal(), "wall", goal_type="config")
    assert load_network(tmp_path / "a.onnx").metadata["env"] == {"goal_type": "config"}
