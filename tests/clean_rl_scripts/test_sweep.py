"""clean_rl_scripts/sweep.py, with a trainer that takes no time."""

import csv
import importlib.util
import json
import os
import subprocess
import sys
import time

import psutil
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from paths import ROOT
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

SCRIPT = ROOT / "clean_rl_scripts" / "sweep.py"
spec = importlib.util.spec_from_file_location("sweep", SCRIPT)
sweep = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sweep)

# Best at a learning rate of 0.3 with `--on`; fails beyond 0.9.
TRAINER = """
import argparse, json, os, pathlib, sys, time

parser = argparse.ArgumentParser()
parser.add_argument("--runs-dir", type=pathlib.Path)
parser.add_argument("--resume", type=pathlib.Path)
parser.add_argument("--lr", type=float)
parser.add_argument("--on", action=argparse.BooleanOptionalAction)
parser.add_argument("--other", type=int)
args = parser.parse_args()
run = args.resume or args.runs_dir / "run"
if args.resume:
    saved = json.loads((run / "checkpoint.pt").read_text())
    args.lr, args.on = saved["lr"], saved["on"]
else:
    run.mkdir()
    (run / "checkpoint.pt").write_text(json.dumps({"lr": args.lr, "on": args.on}))
    time.sleep(float(os.environ.get("SECONDS", 0)))
if args.lr > 0.9:
    sys.exit("it diverged")
value = 1 - (args.lr - 0.3) ** 2 - 0.1 * (not args.on)
result = {"validation_success_rate": value, "lr": args.lr, "resumed": args.resume is not None}
(run / "result.json").write_text(json.dumps(result))
"""


@pytest.fixture
def trainer(tmp_path):
    path = tmp_path / "trainer.py"
    path.write_text(TRAINER)
    return path


def arguments(trainer, *more):
    folder = trainer.parent / "sweep"
    flags = ["--folder", folder, *(["--workers", 1] if "--workers" not in more else [])]
    return [str(a) for a in (trainer, *flags, "--search", "lr=0.0..1.0", *more)]


def rows(trainer):
    with open(trainer.parent / "sweep" / "trials.csv", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    ("text", "name", "distribution"),
    [
        ("learning-rate=1e-6..5e-3:log", "learning-rate", FloatDistribution(1e-6, 5e-3, log=True)),
        ("--gamma=0.9..1", "gamma", FloatDistribution(0.9, 1.0)),
        ("hidden_size=64..512:log", "hidden-size", IntDistribution(64, 512, log=True)),
        ("target-entropy=-14..-7", "target-entropy", IntDistribution(-14, -7)),
        ("autotune=true,false", "autotune", CategoricalDistribution(("true", "false"))),
    ],
)
def test_search_space_is_parsed(text, name, distribution):
    assert sweep.parse_search(text) == (name, distribution)


@pytest.mark.parametrize("text", ["lr", "lr=1..2:logarithmic", "lr=2.0..1.0"])
def test_bad_search_space_is_rejected(trainer, text, capsys):
    with pytest.raises(SystemExit) as exit:
        sweep.main([str(trainer), "--search", text])
    assert text in str(exit.value)
    assert not list(trainer.parent.glob("sweep*"))


def test_search_finds_the_best_flags(trainer, capsys):
    sweep.main(arguments(trainer, "on=true,false", "--trials", "25"))
    found = rows(trainer)
    assert len(found) == 25 and {row["state"] for row in found} == {"complete", "fail"}
    for row in found:
        if row["state"] == "fail":
            assert float(row["lr"]) > 0.9 and "it diverged" in row["error"]
        else:
            value = 1 - (float(row["lr"]) - 0.3) ** 2 - 0.1 * (row["on"] == "false")
            assert float(row["validation_success_rate"]) == pytest.approx(value)
    best = max(found, key=lambda row: float(row["validation_success_rate"] or 0))
    assert best["on"] == "true" and abs(float(best["lr"]) - 0.3) < 0.15
    value = float(best["validation_success_rate"])
    assert f": {value:.3f};" in capsys.readouterr().out.splitlines()[-1]
    events = EventAccumulator(str(trainer.parent / "sweep" / best["trial"] / "hparams")).Reload()
    scalar = events.Scalars("sweep/validation_success_rate")[0]
    assert scalar.value == pytest.approx(value)
    assert "_hparams_/session_start_info" in events.Tags()["tensors"] or "_hparams_" in str(
        events.summary_metadata
    )


def test_search_is_reproducible_and_continues(trainer, tmp_path, capsys):
    sweep.main(arguments(trainer, "--trials", "4"))
    first = [row["lr"] for row in rows(trainer)]
    sweep.main(arguments(trainer, "--trials", "6", "--folder", tmp_path / "again"))
    (tmp_path / "sweep").rename(tmp_path / "first")
    (tmp_path / "again").rename(tmp_path / "sweep")
    more = [row["lr"] for row in rows(trainer)]
    assert more[:4] == first and len(set(more)) == 6
    sweep.main(arguments(trainer, "--trials", "8"))
    assert [row["lr"] for row in rows(trainer)][:6] == more and len(rows(trainer)) == 8
    assert len({row["lr"] for row in rows(trainer)}) == 8
    with pytest.raises(SystemExit, match="holds another search"):
        sweep.main(arguments(trainer, "--trials", "8", "--seed", "3"))
    with pytest.raises(SystemExit, match="has no flag --othr: did you mean --other?"):
        sweep.main(arguments(trainer, "--trials", "8", "--", "--othr", "1"))


def test_help_needs_no_optuna_and_a_search_says_how_to_install_it(trainer):
    code = "import runpy, sys; sys.modules['optuna'] = None; sys.argv[0] = 'sweep.py'; "
    code += f"runpy.run_path({str(SCRIPT)!r}, run_name='__main__')"
    done, search = (
        subprocess.run([sys.executable, "-c", code, *flags], capture_output=True, text=True)
        for flags in (["--help"], arguments(trainer))
    )
    assert done.returncode == 0 and "usage: sweep.py [-h]" in done.stdout, done.stderr
    assert search.returncode == 1 and not (trainer.parent / "sweep").exists()
    (line,) = [line for line in search.stderr.splitlines() if "pybullet" not in line]
    assert line.startswith("this needs the extra `sweep`: pip install")


def start(trainer, seconds):
    """A search of 4 trials, two at a time, as a process with the first two running; its command."""
    command = [sys.executable, SCRIPT, *arguments(trainer, "--trials", "4", "--workers", "2")]
    process = subprocess.Popen(
        command, start_new_session=True, env=os.environ | {"SECONDS": str(seconds)}
    )
    until = time.time() + 60
    while len(list(trainer.parent.glob("sweep/*/*/checkpoint.pt"))) < 2:
        assert time.time() < until and process.poll() is None
        time.sleep(0.05)
    return process, command


def test_interrupted_search_continues_its_running_trials(trainer):
    process, command = start(trainer, 1000)
    begun = {
        path.parent.parent.name: json.loads(path.read_text())["lr"]
        for path in trainer.parent.glob("sweep/*/*/checkpoint.pt")
    }
    trainers = psutil.Process(process.pid).children()
    assert len(trainers) == 2
    process.terminate()  # it reaches the search only, which ends its trainers
    assert process.wait(30) == 143
    assert not any(one.is_running() for one in trainers)
    subprocess.run(command, check=True)
    found = {row["trial"]: row for row in rows(trainer)}
    assert len(found) == 4 and set(begun) < set(found)
    for path in trainer.parent.glob("sweep/*/*/result.json"):
        result, trial = json.loads(path.read_text()), path.parent.parent.name
        assert result["resumed"] == (trial in begun)
        assert float(found[trial]["lr"]) == result["lr"] == begun.get(trial, result["lr"])


@pytest.mark.slow
def test_on_ray(trainer):
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    cluster = cluster_utils.Cluster(head_node_args={"num_cpus": 2}, initialize_head=True)
    try:
        more = ["--trials", "4", "--ray-address", cluster.address]
        sweep.main(arguments(trainer, "on=true,false", *more))
        assert len(found := rows(trainer)) == 4
        sweep.main(arguments(trainer, "on=true,false", *more))  # finds that it is done
        assert rows(trainer) == found
    finally:
        cluster.shutdown()
