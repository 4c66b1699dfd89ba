"""docs/customise/algorithm.md: its excerpts are SAC's, and its example is carried out."""

import json
import re

from paths import ROOT
from trainers import PATHS, TINIER, run_here, succeeds_here

PAGE = (ROOT / "docs/customise/algorithm.md").read_text()
SAC = PATHS["sac_her_mp"].read_text()


def test_excerpts_of_the_walk_stand_in_the_trainer():
    walk = PAGE.partition("\n## A walk")[2].partition("\n## ")[0]
    excerpts = re.findall(r"```python\n(.*?)```", walk, re.DOTALL)
    assert len(excerpts) >= 5
    for excerpt in excerpts:
        assert excerpt in SAC


def test_redq_diff_applies_and_trains_resumes_and_is_evaluated(tmp_path, short_episodes):
    (diff,) = re.findall(r"```diff\n(.*?)```", PAGE, re.DOTALL)
    assert len(re.findall(r"^\+(?!\+\+)", diff, re.MULTILINE)) <= 20
    run_here(ROOT / "examples" / "07_own_algorithm.py", "--folder", tmp_path, *TINIER.split())
    script = tmp_path / "clean_rl_scripts" / "redq_her_mp.py"
    assert "NUM_CRITICS = 5" in script.read_text()
    (run,) = (tmp_path / "runs").glob("wall__redq_her_mp__1__*")
    run_here(script, "--resume", run, "--total-timesteps", "600")
    assert json.loads((run / "result.json").read_text())["steps"] == 600
    flags = ["--task", "wall", "--policy", run, "--num-queries", "2"]
    flags += ["--json", tmp_path / "result.json"]
    succeeds_here(ROOT / "clean_rl_scripts" / "evaluate.py", *flags)
    assert json.loads((tmp_path / "result.json").read_text())["num_queries"] == 2
