"""training/final_test.py: a trainer's queries, the test of its best policy, and its result."""

import functools
import json
import sys

import pytest
import torch
from trainers import load

from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.policies.export import save_policy
from roboarm_nmp.training.final_test import finish, load_task
from roboarm_nmp.training.runs import Run

Args = functools.partial(load("bc").Args, goal_type="config", eval_queries=5, test_queries=3)


class Toward(torch.nn.Module):
    """Straight to the goal configuration, in small steps: it needs more than 50."""

    def forward(self, observation, achieved_goal, desired_goal, **_):
        apart = desired_goal - observation[:, :7]
        return 0.01 * torch.nn.functional.normalize(apart, dim=1)


def result_of(tmp_path, capsys, monkeypatch, num_queries=3, **env_arguments):
    """`result.json` and the printed lines for such a policy."""
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)  # a run sets it
    run = Run(Args(runs_dir=tmp_path), "a", {})
    run.start(10, "step")
    run.advance(10)
    run._began -= 1000.0  # as if training had taken so long
    arguments = {"goal_type": "config", **env_arguments}
    save_policy(run.folder / "policy.onnx", Toward(), "no_obstacles", **arguments)
    finish(run, load_queries("no_obstacles", "test")[:num_queries], 0.5, 7)
    return json.loads((run.folder / "result.json").read_text()), capsys.readouterr().out


def test_result_has_the_test_of_the_best_policy(tmp_path, capsys, monkeypatch):
    result, line = result_of(tmp_path, capsys, monkeypatch)
    assert result["success_rate"] > 0.5 and result["mean_steps"] > 50
    assert (result["policy_step"], result["steps"], result["num_queries"]) == (7, 10, 3)
    assert 1000 <= result["seconds"] < 1100
    assert result["validation_success_rate"] == 0.5 and result["robot"] == "panda"
    assert result["args"]["goal_type"] == result["goal_type"] == "config"
    assert "3 test queries: success" in line and result["privileged"] is False
    result, line = result_of(tmp_path, capsys, monkeypatch, max_step=0.02, encoder="oracle")
    assert result["deviations"] == {"max_step": 0.02}
    assert result["privileged"] and "test queries, privileged: success" in line


def test_run_without_test_queries_has_no_figures_of_a_test(tmp_path, capsys, monkeypatch):
    result, line = result_of(tmp_path, capsys, monkeypatch, num_queries=0)
    assert not {"num_queries", "success_rate", "collision_rate"} & result.keys()
    assert result["validation_success_rate"] == 0.5
    assert "no test, --test-queries 0; validation success 0.500 at 7" in line


def test_as_many_queries_are_used_as_there_are(capsys):
    validation, test = load_task(Args(test_queries=10**6))
    assert (len(validation), len(test)) == (5, len(load_queries("no_obstacles", "test")))
    assert "--test-queries 1000000: there are" in capsys.readouterr().err


@pytest.mark.parametrize(
    "task, message", [("narrow_shelves", "for testing only"), ("walls", "--task: unknown task")]
)
def test_task_that_nothing_can_be_trained_on_is_rejected(task, message):
    with pytest.raises(SystemExit, match=message):
        load_task(Args(task=task))
