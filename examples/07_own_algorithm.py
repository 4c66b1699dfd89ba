"""Turn SAC into another algorithm, REDQ, and train it: a copied file with a few changed lines.

    python examples/07_own_algorithm.py --total-timesteps 100000

The changes are the diff in docs/customise/algorithm.md, which explains them. The copy and its runs
are in the folder `own_algorithm`.
"""

import argparse
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "customise" / "algorithm.md"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("own_algorithm"))
    args, flags = parser.parse_known_args()  # all other flags are the trainer's

    script = args.folder / "clean_rl_scripts" / "redq_her_mp.py"
    script.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(ROOT / "clean_rl_scripts" / "sac_her_mp.py", script)
    found = re.search(r"```diff\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert found is not None
    apply = ["git", "apply", "--unsafe-paths", f"--directory={args.folder.resolve()}"]
    subprocess.run(apply, input=found[1], text=True, cwd="/", check=True)
    print(f"{script}: SAC with an ensemble of critics")

    sys.argv = [str(script), "--task", "wall", "--runs-dir", str(args.folder / "runs"), *flags]
    runpy.run_path(str(script), run_name="__main__")


if __name__ == "__main__":
    main()
