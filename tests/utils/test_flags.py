"""utils/flags.py: parsing, groups, and ranges: a bad flag ends a trainer at once."""

import dataclasses
import re
import sys
from pathlib import Path

import pytest
from paths import ROOT
from trainers import PATHS, load

from roboarm_nmp.training.arguments import parse_args
from roboarm_nmp.utils import flags

ENCODERS = ("vae", "vqvae", "pointnet2", "field")
PATHS |= {name: ROOT / "scene_embedding_train" / f"{name}.py" for name in ENCODERS}
POLICIES = ("sac_her_mp", "td3_her_mp", "bc", "roadmap_bc")
CASES = [
    ("bc", "--seed", "-1"),
    ("bc", "--device", "cuda:99"),
    ("roadmap_bc", "--runs-dir", "/dev/null/runs"),
    ("td3_her_mp", "--gamma", "1.1"),
    ("pointnet2", "--num-centres", "32 0"),
]


@pytest.fixture(scope="module")
def args_of():
    """Name of a trainer -> its `Args`."""
    return {name: load(name).Args for name in (*POLICIES, *ENCODERS)}


@pytest.mark.parametrize(("script", "flag", "value"), CASES)
def test_flag_out_of_range_is_rejected_by_name(script, flag, value, args_of, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [script, flag, *value.split()])
    with pytest.raises(SystemExit) as ended:
        parse_args(args_of[script])
    assert str(ended.value.code).startswith(f"{script}: {flag}")
    assert str(ended.value.code).count("\n") == 0
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("script", (*POLICIES, *ENCODERS))
def test_defaults_are_in_their_ranges_and_help_shows_these(
    script, args_of, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr(sys, "argv", [script, "--runs-dir", str(tmp_path)])
    assert parse_args(args_of[script]).seed == 1
    monkeypatch.setattr(sys, "argv", [script, "--help"])
    with pytest.raises(SystemExit):
        parse_args(args_of[script])
    shown = capsys.readouterr().out
    assert "--seed INT IN [0, 2^32)" in shown and "--batch-size INT >= 1" in shown


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
    parsed = flags.parse(
        Own, ["--seed", "3", "--my_rate", "2", "--sizes", "4", "--on", "--output", "None"]
    )
    assert parsed == Own(3, None, 2.0, (4,), True)
    assert flags.parse(Own, ["--no-on"], default=parsed) == Own(3, None, 2.0, (4,), False)


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
