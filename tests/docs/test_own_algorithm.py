"""docs/customise/algorithm.md: its example is carried out."""

import json
import re

import numpy as np
from paths import ROOT
from trainers import PATHS, TINIER, load, run_here, succeeds_here

from roboarm_nmp import envs

PAGE = (ROOT / "docs/customise/algorithm.md").read_text()


def test_copied_and_changed_trainer_runs_resumes_and_is_evaluated(tmp_path):
    before, after = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[:2]
    source = PATHS["sac_her_mp"].read_text()
    assert source.count(before) == 1
    script = tmp_path / "sac_final_mp.py"
    script.write_text(source.replace(before, after))

    run_here(script, "--runs-dir", tmp_path / "runs", *TINIER.split(), "--task", "wall")
    (run,) = (tmp_path / "runs").glob("wall__sac_final_mp__1__*")
    run_here(script, "--resume", run, "--total-timesteps", "600")
    assert json.loads((run / "result.json").read_text())["steps"] == 600
    flags = ["--task", "wall", "--policy", run, "--num-queries", "2"]
    flags += ["--json", tmp_path / "result.json"]
    succeeds_here(ROOT / "clean_rl_scripts" / "evaluate.py", *flags)
    assert json.loads((tmp_path / "result.json").read_text())["num_queries"] == 2


def test_example_relabels_with_the_ends_of_episodes(tmp_path, monkeypatch):
    before, after = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[:2]
    script = tmp_path / "sac_final_mp.py"
    script.write_text(PATHS["sac_her_mp"].read_text().replace(before, after))
    monkeypatch.setitem(PATHS, "sac_final_mp", script)
    module = load("sac_final_mp")
    env = envs.make("no_obstacles")
    buffer = module.HerReplayBuffer(env, 100, 1.0, np.random.default_rng(0))
    for length in (3, 7):
        buffer.add_episode(
            [
                {
                    "observation": np.zeros(10),
                    "action": np.zeros(7),
                    "next_observation": np.zeros(10),
                    "next_achieved_goal": np.full(3, 100 * length + step),
                    "desired_goal": np.zeros(3),
                    "collision": False,
                }
                for step in range(length)
            ]
        )
    assert set(np.unique(buffer.sample(200)["desired_goal"])) == {302.0, 706.0}
    env.close()
