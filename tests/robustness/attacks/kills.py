"""`kill -9` at random moments: afterwards the same command continues, to the same results.

An attempt kills a command (training, collecting, rendering, sweeping) a few times, and then lets it
finish. Its results must be those of an undisturbed run, without any other file.
"""

import hashlib
import random
import shutil
import subprocess
import sys
import time

from paths import ROOT
from trainers import command

from attacks.children import RAN
from attacks.flags import TRAINER

SECONDS, MEGABYTES = 900, 20_000
KILLS = 4  # of an attempt
SLOW_TRAINER = TRAINER.replace("run.mkdir", "import time\ntime.sleep(1.0)\nrun.mkdir").replace(
    "parents=True", "parents=True, exist_ok=True"
)


def commands(folder):
    """Dict from a name to the command line and the file that it makes, in a folder."""
    python = sys.executable
    return {
        "training": (
            command("sac_her_mp", folder / "runs", "--task", "wall", "--eval-every", "300"),
            "runs/*/policy.onnx",
        ),
        "cloning": (
            command("bc", folder / "runs", "--task", "wall", "--eval-every", "300"),
            "runs/*/policy.onnx",
        ),
        "collecting": (
            [python, "-m", "roboarm_nmp", "collect", "--task", "wall", "--num", "150"]
            + ["--workers", "1", "--output", folder / "demos.h5"],
            "demos.h5",
        ),
        "observing": (
            [python, "-m", "roboarm_nmp", "observations", "--num", "60", "--shard-size", "10"]
            + ["--image-size", "64", "--num-samples", "900", "--workers", "1"]
            + ["--output", folder / "observations"],
            "observations/*.h5",
        ),
        "rendering": (
            [python, "-m", "roboarm_nmp", "show", "wall", "--output", folder / "a.gif"],
            "a.gif",
        ),
        "sweeping": (
            [python, ROOT / "clean_rl_scripts" / "sweep.py", folder / "trainer.py"]
            + ["--search", "x=1..3", "--trials", "4", "--folder", folder / "sweep"],
            "sweep/trial_*/run/result.json",
        ),
    }


def attempts(seed, folder):
    """The attempt: a function from a number to the outcome of killing a command."""
    expected, seconds = {}, {}
    for name in commands(folder):
        here = _folder(folder / f"{name}-undisturbed")
        began = time.time()
        arguments, pattern = commands(here)[name]
        subprocess.run(arguments, check=True, capture_output=True)
        expected[name], seconds[name] = _made(here, pattern), time.time() - began

    def attempt(number):
        rng = random.Random(f"{seed} {number}")
        name = list(expected)[number % len(expected)]
        here = _folder(folder / f"{name}-{number}")
        try:
            arguments, pattern = commands(here)[name]
            for kill in range(KILLS + 1):
                begun = sorted(here.glob("runs/*/args.json"))
                resumed = [*arguments, "--resume", begun[-1].parent] if begun else arguments
                process = subprocess.Popen(
                    resumed, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
                )
                try:
                    last = kill == KILLS
                    output, _ = process.communicate(
                        timeout=None if last else rng.uniform(0.1, 1.0) * seconds[name]
                    )
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.communicate()
                    continue
                # A killed process may have finished its file already.
                if process.returncode != 0 and "exists; --overwrite" not in output:
                    return f"{name}: exit code {process.returncode}: {output[-300:]}"
                break
            if _made(here, pattern) != expected[name]:
                return f"{name}: another result"
            left = [path.name for path in here.rglob("*") if _is_leftover(path)]
            return f"{name}: left {sorted(left)}" if left else RAN
        finally:
            shutil.rmtree(here)

    return attempt


def _folder(path):
    path.mkdir()
    (path / "trainer.py").write_text(SLOW_TRAINER)
    return path


def _is_leftover(path):
    return path.name.endswith((".tmp", ".part", ".journal"))


def _made(folder, pattern):
    """Digests of the files that a command has made; for a sweep, their number."""
    paths = sorted(folder.glob(pattern))
    if pattern.startswith("sweep"):  # a disturbed search samples other values
        return len(paths)
    return [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths]
