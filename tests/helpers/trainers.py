"""Trainers as modules and as commands, for the tests."""

import functools
import importlib.util
import runpy
import signal
import subprocess
import sys
import time
from unittest.mock import patch

import pytest
import torch
from paths import ROOT

from roboarm_nmp import envs

PATHS = {
    "sac_her_mp": ROOT / "clean_rl_scripts" / "sac_her_mp.py",
    "td3_her_mp": ROOT / "clean_rl_scripts" / "td3_her_mp.py",
    "crl_mp": ROOT / "clean_rl_scripts" / "crl_mp.py",
    "bc": ROOT / "bc_script" / "bc.py",
    "roadmap_bc": ROOT / "bc_script" / "roadmap_bc.py",
    "flow": ROOT / "bc_script" / "flow.py",
}
# Trainers of policies in fixed scenes.
TRAINERS = ("sac_her_mp", "td3_her_mp", "crl_mp", "bc")
NO_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch sees no GPU here")
GPU = pytest.param("cuda", marks=NO_GPU)  # a `--device`
TINY = "--hidden-size 16 --batch-size 16 --updates-per-step 0.1 --learning-starts 200 --num-envs 3"
TINY += " --horizon 50 --eval-every 300 --eval-queries 2 --test-queries 2 --total-timesteps 600"
TINIER = f"{TINY} --horizon 20 --learning-starts 100 --eval-every 300 --total-timesteps 300"
TINY_BC = "--hidden-size 16 --batch-size 16 --num-demos 20 --eval-every 300 --eval-queries 2"
TINY_BC += " --test-queries 2 --total-updates 600"
TINY_ROADMAP_BC = (
    "--hidden-size 16 --token-width 16 --num-blocks 1 --batch-size 16 --first-scenes 2"
)
TINY_ROADMAP_BC += " --pool-scenes 4 --examples-per-scene 50 --updates-per-scene 10 --workers 0"
TINY_ROADMAP_BC += " --total-updates 40 --eval-every 20 --eval-queries 2 --test-queries 1"
TINY_FLOW = "--hidden-size 16 --token-width 16 --num-blocks 1 --batch-size 16 --first-scenes 2"
TINY_FLOW += " --pool-scenes 4 --num-points 8 --updates-per-scene 10 --workers 0"
TINY_FLOW += " --total-updates 40 --eval-every 20 --eval-queries 2 --test-queries 1"
# For tests of what training leaves in the checkpoint: one evaluation, on one query.
ONE_EVALUATION = ["--eval-every", "600", "--eval-queries", "1", "--test-queries", "0"]


def load(trainer):
    """A trainer's script as a module."""
    spec = importlib.util.spec_from_file_location(trainer, PATHS[trainer])
    module = importlib.util.module_from_spec(spec)
    sys.modules[trainer] = module
    spec.loader.exec_module(module)
    return module


def shared_blocks(path):
    """Name -> lines of a script's blocks from `# SHARED: name` to `# END SHARED`."""
    blocks, name = {}, None
    for line in path.read_text().splitlines():
        if line.strip().startswith("# SHARED: "):
            assert name is None, f"{line} inside {name}"
            name = line.strip().removeprefix("# SHARED: ")
            assert name not in blocks
            blocks[name] = []
        elif line.strip() == "# END SHARED":
            assert name is not None
            name = None
        elif name is not None:
            blocks[name].append(line)
    assert name is None
    return blocks


@functools.cache
def panda_env(goal_type="ee"):
    """An environment that gives networks their sizes."""
    return envs.make("no_obstacles", goal_type=goal_type)


def command(trainer, folder, *flags):
    """A run of seconds; later flags win."""
    tiny = {"bc": TINY_BC, "roadmap_bc": TINY_ROADMAP_BC, "flow": TINY_FLOW}.get(trainer, TINY)
    return [sys.executable, str(PATHS[trainer]), "--runs-dir", str(folder), *tiny.split(), *flags]


def run_script(trainer, folder, *flags):
    """The folder of such a run, made in this process, which saves seconds of imports."""
    run_here(*command(trainer, folder, *flags)[1:])
    return next(folder.iterdir())


def killed_run(trainer, folder, *flags):
    """The folder of such a run in another process, which is killed after its first checkpoint."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command(trainer, folder, *flags), **quiet)
    deadline = time.time() + 300
    while not list(folder.glob("*/checkpoint.pt")) and time.time() < deadline:
        time.sleep(0.02)
    process.kill()
    process.wait()
    (run,) = folder.iterdir()
    assert not (run / "result.json").exists()
    return run


def run_here(script, *arguments):
    """Run a script in this process, so that a test can patch its imports.

    Settings of torch and signal handlers are restored.
    """
    state, threads = torch.get_rng_state(), torch.get_num_threads()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    argv = patch.object(sys, "argv", [str(script), *map(str, arguments)])
    with argv, patch.object(sys, "excepthook", sys.excepthook):
        try:
            runpy.run_path(str(script), run_name="__main__")
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            torch.use_deterministic_algorithms(False)
            torch.set_num_threads(threads)
            torch.set_rng_state(state)


def succeeds_here(script, *arguments):
    """Run a script, which may end with exit code 0, in this process."""
    try:
        run_here(script, *arguments)
    except SystemExit as end:
        assert not end.code, end.code


def error_here(capsys, script, *arguments):
    """The message of a script that ends with an exit code other than 0, in this process."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        run_here(script, *arguments)
    assert end.value.code not in (None, 0)
    return f"{capsys.readouterr().err}{end.value.code}"


def refusal(trainer, capsys, folder, *flags):
    """The message of such a run that rejects its flags before it has made a file."""
    message = error_here(capsys, *command(trainer, folder, *flags)[1:])
    assert not list(folder.iterdir())
    return message
