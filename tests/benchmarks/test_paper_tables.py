"""The results page: from the paper's cells and a folder of results, and from a run."""

import contextlib
import functools
import json
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import paper_tables
import psutil
import pytest
from paths import ROOT
from PIL import Image
from trainers import succeeds_here

from roboarm_nmp import envs
from roboarm_nmp.networks.exported_networks import load_network

CELLS = {cell.name: cell for cell in paper_tables.read_cells()}


def result(name, seed, success, **more):
    made_up = {
        "cell": name,
        "seed": seed,
        "success_rate": success,
        "success_rate_interval": [success - 0.01, success + 0.01],
        "collision_free_success_rate": success / 2,
        "num_queries": 10_000,
        "steps": 300_000,
        "policy_step": 275_000,
        "training_seconds": 600,
        "date": "2026-01-02",
        "commit": "abc1234",
        "curve": [[100_000, success / 2], [300_000, success]],
        "args": {},
    }
    return made_up | more


def args_of(name):
    """What a run of the cell's own recipe has in its JSON."""
    given = [flag for flag in CELLS[name].flags() if flag != "--no-jacobian"]
    args = {f[2:].replace("-", "_"): v for f, v in zip(given[::2], given[1::2], strict=True)}
    return args | {"jacobian": False}


def baseline(success):
    return {
        "success_rate": success,
        "collision_free_success_rate": success / 2,
        "num_queries": 1000,
    }


BASELINES = {"wall": {"go-to-goal": baseline(0.7), "RRT-Connect, 5 s": baseline(1.0)}}


@pytest.fixture
def results(tmp_path):
    made_up = [
        result("sac-ee-wall-p1", 1, 0.95, args=args_of("sac-ee-wall-p1")),
        result("sac-ee-double_walls-p1", 1, 0.83),
        *(result("bc-combined-no_obstacles", seed, 0.98 + seed / 1000) for seed in (1, 2, 3)),
        result("sac-combined-no_obstacles-p0-no_hindsight", 1, 0.002),
    ]
    for number, one in enumerate(made_up):
        (tmp_path / f"{number}.json").write_text(json.dumps(one))
    return paper_tables.load_results([tmp_path, tmp_path / "missing"])


def test_the_papers_cells():
    papers = [cell for cell in CELLS.values() if cell.mean is not None]
    assert len(papers) == 3 * 9 * 5 + 4 + 3 + 9 * 6  # goals, hindsight, encoders with BC and SAC
    others = {cell.name for cell in CELLS.values() if cell.mean is None}
    assert all("oracle" in name or re.match("bc-.*-on-|td3-", name) for name in others)
    assert {cell.task for cell in CELLS.values()} <= set(envs.TASKS)
    for name, mean, std in [  # as in the table, and the ends of each of the paper's
        ("bc-ee-no_obstacles", 0.073, 0.036),
        ("bc-config-double_walls", 0.500, 0.009),
        ("td3-ee-double_walls-p1", 0.848, 0.027),
        ("td3-config-boxes-p1", 0.822, 0.014),
        ("sac-combined-no_obstacles-p0", 0.990, 0.002),
        ("sac-combined-no_obstacles-p0-no_hindsight", 0.001, 0.0),
        ("bc-combined-vqvae-random_boxes_hard", 0.150, 0.045),
        ("sac-combined-pointnet2-random_boxes_hard-p1-on-narrow_shelves", 0.441, 0.019),
    ]:
        assert (CELLS[name].mean, CELLS[name].std) == (mean, std)


def test_a_cell_is_a_command():
    flags = CELLS["sac-combined-no_obstacles-p0-no_hindsight"].flags()
    assert flags[:4] == ["--task", "no_obstacles", "--goal-type", "combined"]
    assert flags[-4:] == ["--demo-prob", "0", "--her-probability", "0"]
    assert "--demo-prob" not in CELLS["bc-ee-wall"].flags()
    flags = CELLS["sac-combined-vae-random_boxes_hard-p1-on-three_shelves"].flags()
    assert flags[:2] == ["--task", "random_boxes_hard"]
    assert flags[-4:] == ["--encoder", "vae", "--num-hidden-layers", "4"]


def test_runs_from_before_goal_minus_configuration_are_others():
    recipe = {"gamma": 0.98, "target_entropy": -14.0, "num_hidden_layers": 3, "demo_prob": 1.0}
    for goal_type, fits in (("ee", True), ("config", False), ("combined", False)):
        cell = CELLS[f"sac-{goal_type}-wall-p1"]
        args = recipe | {"task": "wall", "goal_type": goal_type}
        assert cell.is_recipe_of(args) is fits
        assert cell.is_recipe_of(args | {"relative_configuration": True})
        assert cell.is_recipe_of(args | {"plain_networks": False})
        assert cell.is_recipe_of(args | {"relative_configuration": False}) is fits


def test_tables_list_what_was_run_and_name_what_was_not(results):
    tables = paper_tables.tables(list(CELLS.values()), results, BASELINES)
    assert tables["paper-ee"].splitlines()[2:6] == [
        "| `wall` | SAC-MP (p = 1) | none | no | 0.950 | [0.946,\u00a00.954] | 0.475 | 10,000 | 1 "
        "| 300,000 | 0.971 |",
        "| `wall` | *go-to-goal* | none | no | 0.700 | [0.671,\u00a00.728] | 0.350 | 1,000 | – | – "
        "| 0.765 |",
        "| `wall` | *RRT-Connect* | ground truth (privileged) | yes | 1.000 | [0.996,\u00a01.000] "
        "| 0.500 | 1,000 | – | – | – |",
        "| `double_walls` | SAC-MP (p = 1) | none | no | 0.830 | [0.823,\u00a00.837] | 0.415 "
        "| 10,000 | 1 | 300,000 | 0.916 |",
    ]
    assert tables["paper-ee"].splitlines()[7].startswith("Not run: BC, SAC (p = 0), SAC-MP")
    last = tables["paper-ee"].rpartition("; ")[2]
    assert last == "SAC-MP (p = 1) on `no_obstacles`, `double_walls_wide_gap`, `boxes`."
    # Three seeds: the interval is that of 30,000 queries.
    three = "0.982 | [0.980,\u00a00.983] | 0.491 | 30,000 | 3 (0.981 to 0.983) | 300,000 | 0.986 |"
    assert f"| `no_obstacles` | BC | none | no | {three}" in tables["paper-combined"]
    hindsight = tables["paper-hindsight"].splitlines()
    assert hindsight[2].startswith("| SAC (p = 0) | no | 0.002 |") and len(hindsight) == 5
    assert "SAC (p = 0) with hindsight" in hindsight[4]
    assert tables["paper-below"].splitlines()[2:] == [
        "| `sac-ee-double_walls-p1` | 0.830 | 0.916 |"
    ]
    runs = tables["paper-runs"].splitlines()[2:]
    assert len(runs) == 6
    assert runs[-2].startswith("| `bc-combined-no_obstacles-s3` | 0.983 |")
    end = "300,000 | 275,000 | 10 | 2026-01-02 | abc1234 | no | earlier |"
    assert runs[-2].endswith(end)
    for text in tables.values():
        rows = [line for line in text.splitlines() if line.startswith("|")]
        assert len({line.count("|") for line in rows}) == 1


def test_all_tables_weigh_seeds_by_their_queries(results):
    name = "sac-ee-double_walls-p1"
    results[name] += [result(name, 2, 0.7, num_queries=100, kept=False)]
    tables = paper_tables.tables(list(CELLS.values()), results, BASELINES)
    assert "| none | no | 0.829 | [" in tables["paper-ee"]  # (8,300 + 70) / 10,100
    assert f"| `{name}` | 0.829 | 0.916 |" in tables["paper-below"]


def test_runs_with_other_flags_do_not_count_beside_the_cells_own(results):
    name = "sac-ee-double_walls-p1"  # so far with other flags, and far below the paper
    results[name] += [result(name, 2, 0.9, args=args_of(name), kept=False)]
    tables = paper_tables.tables(list(CELLS.values()), results, BASELINES)
    assert "| `double_walls` | SAC-MP (p = 1) | none | no | 0.900 |" in tables["paper-ee"]
    assert len(tables["paper-below"].splitlines()) == 2
    runs = [line for line in tables["paper-runs"].splitlines() if f"`{name}-s" in line]
    assert ["0.830" in runs[0], runs[0].endswith("| earlier |")] == [True, True]
    assert ["0.900" in runs[1], runs[1].endswith("| recipe |")] == [True, True]


def test_runs_with_inputs_that_the_recipe_switches_off_are_not_its_own():
    name = "td3-ee-wall-p1"
    args = args_of(name)
    assert CELLS[name].is_recipe_of(args)
    assert not CELLS[name].is_recipe_of(args | {"jacobian": True})
    del args["jacobian"]  # a run from before there was the flag
    assert CELLS[name].is_recipe_of(args)


def test_own_algorithm_stands_in_the_tables(results, tmp_path):
    header, *rows = paper_tables.CELLS.read_text().splitlines()
    (tmp_path / "cells.csv").write_text("\n".join([header, *rows, "mine,ee,wall,wall,1,yes,,,"]))
    cells = paper_tables.read_cells(tmp_path / "cells.csv")
    results["mine-ee-wall-p1"] = [result("mine-ee-wall-p1", 1, 0.5, kept=True)]
    tables = paper_tables.tables(cells, results, {})
    row = "| `wall` | MINE-MP (p = 1) | none | no | 0.500 | [0.490,\u00a00.510] | 0.250 "
    assert f"{row}| 10,000 | 1 | 300,000 | – |" in tables["paper-ee"]
    assert "mine" not in tables["paper-below"]
    paper_tables.draw_success(cells, results, {}, tmp_path / "success.png")


def test_list_counts_seeds(results, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(paper_tables, "POLICIES", tmp_path)
    monkeypatch.setattr(paper_tables, "end_with_one_line", lambda advice: None)
    monkeypatch.setattr(sys, "argv", ["paper_tables.py", "--list"])
    paper_tables.main()
    *lines, last = capsys.readouterr().out.splitlines()
    assert last == f"{len(CELLS)} cells: 4 were run, 1 of them with three seeds or more"
    lines = {line.split()[0]: line for line in lines}
    assert lines["bc-combined-no_obstacles"].endswith("paper 0.986   ours 0.982, seeds: 3")
    assert lines["td3-ee-wall-p1"].endswith("paper 0.959   not run")


def test_figures_are_drawn(results, tmp_path):
    unseen = {"wall": {"dagger, point_cloud": {"success_rate": 0.99}}}
    story = functools.partial(paper_tables.draw_story, baselines=BASELINES, unseen=unseen)
    curves = functools.partial(paper_tables.draw_curves, baselines=BASELINES)
    success = functools.partial(paper_tables.draw_success, baselines=BASELINES)
    for draw in (curves, success, story):
        draw(list(CELLS.values()), results, path=tmp_path / "figure.png")
        with Image.open(tmp_path / "figure.png") as image:
            assert len(image.convert("RGB").getcolors(1_000_000)) > 10


def test_figure_of_tasks_shows_means_over_seeds(results, monkeypatch):
    figures = []
    monkeypatch.setattr(paper_tables, "_save", lambda figure, path: figures.append(figure))
    paper_tables.draw_story(list(CELLS.values()), results, BASELINES, {}, None)
    drawn = {points.get_label(): points for points in figures[0].axes[0].collections}
    heights = drawn["ours, the best of the same cells"].get_offsets()[:, 1]
    assert sorted(heights) == pytest.approx([0.83, 0.95, 0.982])  # seeds: 0.981, 0.982, 0.983


@pytest.mark.parametrize("cells", [["bc-ee-boxes"], ["bc-ee-boxes", "bc-ee-wall"]])
def test_trainers_do_not_outlive_the_command(tmp_path, cells):
    script = ROOT / "benchmarks" / "paper_tables.py"
    flags = ["--steps", "1000000", "--runs-dir", str(tmp_path), "--workers", str(len(cells))]
    command = [sys.executable, str(script), *flags, "--only", *cells]
    process = psutil.Popen(command, stderr=subprocess.PIPE)
    begun = []
    try:
        until = time.time() + 120
        while len(list(tmp_path.glob("*/*/args.json"))) < len(cells):
            assert time.time() < until
            time.sleep(0.05)
        begun = process.children(recursive=True)
        process.terminate()
        assert b"terminated; the same command" in process.communicate(timeout=60)[1]
        assert process.returncode == 128 + signal.SIGTERM
        assert len(begun) >= len(cells) and not any(one.is_running() for one in begun)
    finally:  # also where the assertions fail
        with contextlib.suppress(psutil.NoSuchProcess):
            begun += process.children(recursive=True)
        for one in (*begun, process):
            with contextlib.suppress(psutil.NoSuchProcess):
                one.kill()


def test_policies_run_side_by_side(tmp_path, monkeypatch, capsys):
    cells = ["bc-ee-wall", "bc-combined-vae-random_boxes_hard-on-three_shelves", "bc-ee-boxes"]
    flags = ["--num-queries", "10", "--steps", "100", "--runs-dir", str(tmp_path), "--no-tables"]
    monkeypatch.setattr(paper_tables, "end_with_one_line", lambda advice: None)
    command = ["paper_tables.py", *flags, "--workers", "2", "--only"]
    monkeypatch.setattr(sys, "argv", [*command, *cells])
    paper_tables.main()
    policies = ["bc-ee-wall-s1", "bc-combined-vae-random_boxes_hard-s1", "bc-ee-boxes-s1"]
    lines = capsys.readouterr().out.splitlines()
    for policy, cell in zip(policies, cells, strict=True):
        log = tmp_path / f"{policy}.log"
        assert log.read_text() == f"{cell}-s1: done before\n"
        begins = lines.index(f"{policy}: begins; its output is in {log}")
        assert begins < lines.index(f"{policy}: ends")
    ended = [line.endswith("ends") for line in lines]
    assert not any(ended[:2]) and any(ended[:3])  # two at a time
    tmp_path.joinpath("bc-ee-wall-s9").touch()  # where the run's folder would be
    monkeypatch.setattr(sys, "argv", [*command, "bc-ee-wall", "--seeds", "9", "1"])
    with pytest.raises(SystemExit, match="error: bc-ee-wall-s9: .* has the logs"):
        paper_tables.main()
    assert "bc-ee-wall-s1: ends" in capsys.readouterr().out


@pytest.fixture
def in_this_process(monkeypatch):
    """Scripts that `paper_tables` starts run in this process, which saves seconds of imports."""
    run = subprocess.run

    def run_script(command, **options):
        if command[0] != sys.executable:  # git
            return run(command, **options)
        assert options == {"check": True}
        return succeeds_here(*command[1:])

    monkeypatch.setattr(paper_tables.subprocess, "run", run_script)


def test_a_run_is_kept_and_not_done_again(
    tmp_path, monkeypatch, capfd, in_this_process, short_episodes
):
    monkeypatch.setattr(paper_tables, "POLICIES", tmp_path / "policies")
    few = ["--eval-queries", "2", "--num-demos", "20", "--eval-every", "30"]
    monkeypatch.setitem(paper_tables.RECIPES, "bc", few)
    cell = CELLS["bc-config-wall"]
    paper_tables.run(cell, 5, 60, 4, tmp_path / "runs")
    kept = json.loads((tmp_path / "policies" / "bc-config-wall-s5.json").read_text())
    assert kept["cell"] == cell.name and kept["seed"] == kept["args"]["seed"] == 5
    assert kept["steps"] == 60 and kept["num_queries"] == 4
    assert [step for step, _ in kept["curve"]] == [30, 60]
    assert re.fullmatch(r"[0-9a-f]{7,}\+?", kept["commit"])
    load_network(tmp_path / "policies" / "bc-config-wall-s5.pt")
    capfd.readouterr()
    paper_tables.run(cell, 5, 60, 4, tmp_path / "runs")
    assert capfd.readouterr().out == "bc-config-wall-s5: done before\n"
    # More queries: no training, and none of its files are needed.
    paper_tables.run(cell, 5, 60, 6, tmp_path / "not_there")
    assert "--total-updates" not in capfd.readouterr().out
    more = json.loads((tmp_path / "policies" / "bc-config-wall-s5.json").read_text())
    evaluated = (
        "success_rate",
        "success_rate_interval",
        "collision_free_success_rate",
        "num_queries",
    )
    assert more["num_queries"] == 6
    assert all(more[name] == kept[name] for name in kept if name not in evaluated)
    elsewhere = replace(cell, task="double_walls")  # another task, the same policy
    paper_tables.run(elsewhere, 5, 60, 3, tmp_path / "runs")
    other = json.loads((tmp_path / "policies" / f"{elsewhere.name}-s5.json").read_text())
    assert other["cell"] == "bc-config-wall-on-double_walls"
    assert other["policy"] == "bc-config-wall-s5" and other["num_queries"] == 3
    assert other["curve"] == kept["curve"]
    assert "--total-updates" not in capfd.readouterr().out

    # Other flags are another run. Its result may stand alone.
    monkeypatch.setitem(paper_tables.RECIPES, "bc", [*few, "--hidden-size", "8"])
    paper_tables.run(cell, 5, 30, 2, tmp_path / "runs", keep_policies=False)
    assert "bc-config-wall-s5: the one that is kept had other flags\n" in capfd.readouterr().out
    assert len(list((tmp_path / "runs" / "bc-config-wall-s5").glob("*/args.json"))) == 2
    (found,) = paper_tables.load_results([tmp_path / "policies"])["bc-config-wall"]
    assert found["args"]["hidden_size"] == 8 and found["steps"] == 30 and not found["kept"]
    paper_tables.run(cell, 5, 30, 3, tmp_path / "runs", keep_policies=False)
    (found,) = paper_tables.load_results([tmp_path / "policies"])["bc-config-wall"]
    assert found["num_queries"] == 3
    paper_tables.run(cell, 5, 30, 4, tmp_path / "elsewhere", keep_policies=False)
    assert "done on 3 queries; its policy is gone" in capfd.readouterr().out
    assert not (tmp_path / "policies" / "bc-config-wall-s5.pt").exists()
    (tmp_path / "policies" / f"{elsewhere.name}-s5.json").unlink()
    paper_tables.run(elsewhere, 5, 30, 2, tmp_path / "runs", keep_policies=False)
    other = json.loads((tmp_path / "policies" / f"{elsewhere.name}-s5.json").read_text())
    assert other["args"]["hidden_size"] == 8 and other["num_queries"] == 2
