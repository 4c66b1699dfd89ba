"""Benchmarks run with tiny numbers."""

import json
import sys
from types import SimpleNamespace

import pytest
import time_to_success
from paths import ROOT
from trainers import TINIER, run_here


@pytest.mark.parametrize(
    ("name", "flags", "expected"),
    [
        ("planning", "--num 3", {"split": "test", "queries": 3}),
        ("demo_throughput", "--num 2 --tasks wall", {}),
        ("env_throughput", "--blocks 2 --scenes 2", {"blocks": 2}),
    ],
)
def test_benchmark_runs_and_ends_with_json(name, flags, expected, capsys):
    if name == "env_throughput":
        pytest.importorskip("panda_gym", reason="needs the extra `bench`")
    run_here(ROOT / "benchmarks" / f"{name}.py", *flags.split())
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert expected.items() <= result.items()


def test_time_to_success_ends_training_at_the_limit_with_its_own_queries(tmp_path, monkeypatch):
    def run_path(script, run_name):
        run_here(script, *sys.argv[1:])

    monkeypatch.setattr(time_to_success, "QUERIES", 2)
    monkeypatch.setattr(time_to_success, "runpy", SimpleNamespace(run_path=run_path))
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    clock = time_to_success.Clock("no_obstacles", limit=0.0)
    time_to_success.train_ours("no_obstacles", 1, clock, TINIER.split())
    [point] = clock.curve
    assert point["steps"] == 300 and point["updates"] == 20
    assert clock.paused > 0.0
    assert not list(tmp_path.glob("*/policy.onnx"))  # the first evaluation ended the training
