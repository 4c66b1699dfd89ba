"""The benchmark of the time to a good policy: the clock stands still while queries are solved."""

import json
import sys
import time

import pytest
from paths import ROOT

from roboarm_nmp.training import runs

sys.path.append(str(ROOT / "benchmarks"))
import time_to_success  # noqa: E402


@pytest.fixture
def small(monkeypatch, tmp_path):
    """Two queries, solved after every 200 steps."""
    monkeypatch.setattr(time_to_success, "QUERIES", 2)
    monkeypatch.setattr(time_to_success, "INTERVAL", 200)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["time_to_success.py"])


def test_the_clock_counts_training_only(small, monkeypatch):
    clock = time_to_success.Clock("no_obstacles", 3600.0)
    monkeypatch.setattr(
        time_to_success.protocol,
        "evaluate",
        lambda *args: time.sleep(0.5) or {"success_rate": 0.89 + 0.01 * len(clock.curve)},
    )
    clock.start()
    assert not clock.evaluate(None, 200, 0)
    assert clock.evaluate(None, 400, 0)  # 0.90
    assert [point["success"] for point in clock.curve] == [0.89, 0.9]
    assert clock.curve[-1]["seconds"] < 0.1


def test_ours_trains_until_the_limit_and_validates_on_fresh_queries(small, monkeypatch, tmp_path):
    closed, close = [], runs.Run.close
    monkeypatch.setattr(runs.Run, "close", lambda run: closed.append(run) or close(run))
    run = dict(vars(time_to_success.protocol.PolicyRun))
    args = time_to_success.Args(tmp_path, only=("ours",), seeds=(1,), limit=0.001)
    time_to_success.run_one(args, "ours", 1)
    result = json.loads(time_to_success.file_of(args, "ours", 1).read_text())
    assert result["steps"] == 200 and not result["reached"] and len(result["curve"]) == 1
    assert list(tmp_path.glob("no_obstacles__sac_her_mp__1__*"))  # the trainer itself ran
    assert vars(time_to_success.protocol.PolicyRun) == run  # and is as before
    assert len(closed) == 1  # an open progress bar would move later ones of this process


def test_rows_show_the_median_run_and_what_did_not_reach_it(tmp_path):
    args = time_to_success.Args(tmp_path)
    for name, minutes, reached in (
        ("ours", (5, 4, 9), (True, True, True)),
        ("sb3", (70, 20, 60), (False, True, False)),
    ):
        for seed, (minute, good) in enumerate(zip(minutes, reached, strict=True), start=1):
            run = {"reached": good, "seconds": 60.0 * minute, "steps": 1000 * minute}
            run |= {"updates": 500 * minute, "curve": [{"success": 0.9 if good else 0.4}]}
            time_to_success.file_of(args, name, seed).write_text(json.dumps(run))
    runs = time_to_success.runs_of(args, time_to_success.LEARNERS)
    ours = ["ours", "3 of 3", "5.0", "5,000", "2,500", "0.900"]
    sb3 = ["sb3", "1 of 3", "more than 60.0", "60,000", "30,000", "0.400"]
    assert time_to_success.rows_of(runs) == [[*ours, "1.0"], [*sb3, "more than 12.0"]]
    assert time_to_success.rows_of({"sb3": runs["sb3"]}) == [[*sb3, "–"]]  # nothing to divide by


def test_each_run_has_a_process_and_is_not_repeated(tmp_path, monkeypatch):
    commands = []

    def run(command, check, env, stdout, stderr):
        commands.append(command)
        args = time_to_success.tyro.cli(time_to_success.Args, args=command[2:])
        assert args.in_process and env["TMPDIR"]
        name, seed = args.only[0], args.seeds[0]
        point = {"seconds": 60.04 * seed, "steps": 1000, "updates": 1, "success": 0.8}
        result = {"reached": True, "seed": seed, **point, "curve": [point]}
        time_to_success.file_of(args, name, seed).write_text(json.dumps(result))

    monkeypatch.setattr(time_to_success.subprocess, "run", run)
    monkeypatch.setattr(time_to_success, "ROOT", tmp_path)
    (tmp_path / "docs" / "figures").mkdir(parents=True)
    written = {}
    monkeypatch.setattr(
        time_to_success, "write_csv", lambda name, *table: written.update({name: table})
    )
    command = ["x", "--folder", str(tmp_path), "--task", "double_walls"]
    for more in ([], ["--only", "earlier"]):
        monkeypatch.setattr(sys, "argv", [*command, *more])
        time_to_success.main()
    assert len(commands) == 6  # two learners, three seeds
    table, curves = (written[f"time_to_success_double_walls{end}.csv"] for end in ("", "_curves"))
    assert [row[0] for row in table[1]] == ["ours", "earlier"]  # all in the folder, run now or not
    assert len(curves[1]) == 6 and curves[1][1] == ["ours", 2, 1000, 120.1, 0.8]
    assert (tmp_path / "docs/figures/time_to_success_double_walls.png").stat().st_size > 5000
