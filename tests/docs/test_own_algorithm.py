"""docs/customise/algorithm.md: its example is carried out."""

import json
import re

from paths import ROOT
from trainers import PATHS, TINIER, run_here, succeeds_here

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
