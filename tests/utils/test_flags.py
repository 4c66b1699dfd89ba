"""utils/flags.py: parsing, groups, and ranges: a bad flag ends a trainer at once."""

import dataclasses
import json
import os
import re
import sys
from pathlib import Path

import pytest
from paths import ROOT
from trainers import PATHS, load

from roboarm_nmp.clean_rl_scripts import evaluate, sweep
from roboarm_nmp.demo_generation import collect, make_queries, roadmaps, verify
from roboarm_nmp.scene_embedding_train import collect as observations
from roboarm_nmp.training import runs
from roboarm_nmp.utils import flags

ENCODERS = ("vae", "vqvae", "pointnet2", "field")
PATHS |= {name: ROOT / "scene_embedding_train" / f"{name}.py" for name in ENCODERS}
REINFORCEMENT = ("sac_her_mp", "td3_her_mp")
POLICIES = (*REINFORCEMENT, "bc", "dagger")
OF_ALL = (
    *(("--seed", bad) for bad in ("-1", "4294967296")),
    *(("--device", bad) for bad in ("foo", "cuda:99", "")),
    ("--batch-size", "0"),
    ("--eval-every", "0"),
    ("--runs-dir", "/dev/null/runs"),
)
OF_REINFORCEMENT = (
    *(("--num-envs", bad) for bad in ("0", "-3")),
    *(("--updates-per-step", bad) for bad in ("nan", "-1", "inf")),
    *(("--gamma", bad) for bad in ("nan", "1.1")),
    ("--total-timesteps", "0"),
    ("--policy-lr", "-1"),
    ("--num-hidden-layers", "0"),
    ("--policy-frequency", "0"),
    ("--her-probability", "2"),
    ("--demo-prob", "-0.1"),
    ("--horizon", "0"),
    ("--max-step", "0"),
    ("--policy-average", "0"),
    ("--stop-at-success", "90"),
)
CASES = [
    *((script, *case) for script in (*POLICIES, *ENCODERS) for case in OF_ALL),
    *((script, *case) for script in REINFORCEMENT for case in OF_REINFORCEMENT),
    *((script, "--eval-queries", "0") for script in POLICIES),
    *((script, "--test-queries", "-1") for script in POLICIES),
    ("sac_her_mp", "--alpha", "0"),
    ("sac_her_mp", "--tau", "0"),
    ("sac_her_mp", "--target-entropy", "-inf"),
    ("td3_her_mp", "--exploration-noise", "-0.1"),
    ("bc", "--num-demos", "0"),
    ("bc", "--num-modes", "0"),
    ("dagger", "--safety-margin", "nan"),
    ("dagger", "--round-every", "-1"),
    ("dagger", "--round-queries", "0"),
    ("dagger", "--policy-average", "0"),
    ("vae", "--kl-weight", "-1"),
    ("pointnet2", "--num-centres", "32 0"),
    ("pointnet2", "--radii", "nan 0.4"),
    ("field", "--spread", "0"),
    ("field", "--latent-noise", "-1"),
]


@pytest.fixture(scope="module")
def args_of():
    """Name of a trainer -> its `Args`."""
    return {name: load(name).Args for name in (*POLICIES, *ENCODERS)}


@pytest.mark.parametrize(("script", "flag", "value"), CASES)
def test_flag_out_of_range_is_rejected_by_name(script, flag, value, args_of, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [script, flag, *(value.split() or [""])])
    with pytest.raises(SystemExit) as ended:
        runs.parse_args(args_of[script])
    assert str(ended.value.code).startswith(f"{flag} ")
    assert str(ended.value.code).count("\n") == 0
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("script", (*POLICIES, *ENCODERS))
def test_defaults_are_in_their_ranges_and_help_shows_these(
    script, args_of, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr(sys, "argv", [script, "--runs-dir", str(tmp_path)])
    assert runs.parse_args(args_of[script]).seed == 1
    monkeypatch.setattr(sys, "argv", [script, "--help"])
    with pytest.raises(SystemExit):
        runs.parse_args(args_of[script])
    shown = capsys.readouterr().out
    assert "--seed INT IN [0, 2^32)" in shown and "--batch-size INT >= 1" in shown


def test_runs_of_the_same_second_have_their_own_folders(args_of, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["bc.py", "--runs-dir", str(tmp_path / "runs")])
    args = runs.parse_args(args_of["bc"])
    monkeypatch.setattr("time.time", lambda: 1_795_000_000.0)
    folders = [runs.run_folder(args, "wall") for _ in range(3)]
    assert [folder.name.removeprefix("wall__bc__1__1795000000") for folder in folders] == [
        "",
        "_2",
        "_3",
    ]
    assert all(json.loads((folder / "args.json").read_text())["seed"] == 1 for folder in folders)


@dataclasses.dataclass
class Base:
    seed: flags.Seed = 1
    """seed of all
    random numbers"""
    output: Path | None = None
    """where to write"""


@dataclasses.dataclass
class Own(Base):
    my_rate: flags.PositiveFloat = 0.5
    """a rate of mine"""
    sizes: tuple[flags.PositiveInt, ...] = (1, 2)
    """some sizes"""
    on: bool = False
    """switch it on"""
    output: Path | None = Path("here")
    """where this one writes"""


def test_flags_are_parsed_into_their_dataclass():
    assert flags.parse(Own, []) == Own()
    given = flags.parse(
        Own, ["--seed", "3", "--my_rate", "2", "--sizes", "4", "--on", "--output", "None"]
    )
    assert given == Own(3, None, 2.0, (4,), True)
    assert flags.parse(Own, ["--no-on"], default=given) == Own(3, None, 2.0, (4,), False)


def test_help_has_groups_docstrings_and_defaults(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(sys, "argv", ["/some/where/own.py"])
    with pytest.raises(SystemExit):
        flags.parse(Own, ["--help"], default=Own(seed=7))
    text = capsys.readouterr().out
    assert text.startswith("utils/flags.py: parsing, groups, and ranges")
    assert "usage: own.py [-h]" in text
    options = " ".join(re.sub(r"[|│]", " ", text.partition("show this help")[2]).split())
    expected = [
        *("algorithm options", "--my-rate FLOAT > 0 a rate of mine (default: 0.5)"),
        *("some sizes (default: 1 2)", "--on, --no-on switch it on (default: False)"),
        *("run options", "--seed INT IN [0, 2^32) seed of all random numbers (default: 7)"),
        *("output options", "where this one writes (default: here)"),
    ]
    places = [options.find(words) for words in expected]
    assert -1 not in places and places == sorted(places), options


def test_workers_default_to_the_cores_that_may_be_used():
    assert min(len(os.sched_getaffinity(0)), 256) == flags.CORES
    for command in (make_queries, collect, verify, roadmaps, observations, evaluate, sweep):
        (field,) = (one for one in dataclasses.fields(command.Args) if one.name == "workers")
        assert field.default == flags.CORES, command


@pytest.mark.parametrize("name", ["observations", "resume"])
def test_path_with_a_name_that_is_too_long_gives_one_line(name, monkeypatch):
    pointnet2 = load("pointnet2")
    monkeypatch.setattr(sys, "argv", ["pointnet2.py", f"--{name}", "a" * 300])
    with pytest.raises(SystemExit, match=f"^--{name}: File name too long: aaa"):
        runs.parse_args(pointnet2.Args)
