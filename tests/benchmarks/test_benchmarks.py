"""Benchmarks run with tiny numbers."""

import json

import pytest
from paths import ROOT
from trainers import run_here


@pytest.mark.parametrize(
    ("name", "flags", "expected"),
    [
        ("planning", "--num 3 --limits 5", {"solved_in_5_s": 1.0, "queries": 3}),
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
