"""Trainers as modules and as commands, and `roboarm` in this process, for the tests."""

import contextlib
import functools
import importlib.util
import io
import re
import runpy
import signal
import subprocess
import sys
import warnings
from unittest.mock import patch

import pytest
import torch
from paths import ROOT

from roboarm_nmp import __main__, envs
from roboarm_nmp.evaluation import evaluate
from roboarm_nmp.training import runs

PATHS = {
    "sac_her_mp": ROOT / "clean_rl_scripts" / "sac_her_mp.py",
    "td3_her_mp": ROOT / "clean_rl_scripts" / "td3_her_mp.py",
    "crl_mp": ROOT / "clean_rl_scripts" / "crl_mp.py",
    "bc": ROOT / "bc_script" / "bc.py",
    "gciql": ROOT / "bc_script" / "gciql.py",
    "diffusion": ROOT / "bc_script" / "diffusion.py",
    "roadmap_bc": ROOT / "bc_script" / "roadmap_bc.py",
    "flow": ROOT / "bc_script" / "flow.py",
}
# Trainers of policies in fixed scenes.
TRAINERS = ("sac_her_mp", "td3_her_mp", "crl_mp", "bc", "gciql", "diffusion")
NO_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch sees no GPU here")
GPU = pytest.param("cuda", marks=NO_GPU)  # a `--device`
TINY = "--hidden-size 16 --batch-size 16 --updates-per-step 0.1 --learning-starts 200 --num-envs 3"
TINY += " --horizon 50 --eval-every 300 --eval-queries 2 --test-queries 2 --total-timesteps 600"
TINIER = f"{TINY} --horizon 20 --learning-starts 100 --eval-every 300 --total-timesteps 300"
TINY_BC = "--hidden-size 16 --batch-size 16 --num-demos 20 --eval-every 100 --eval-queries 2"
TINY_BC += " --test-queries 2 --total-updates 200"
TINY_PATHS = "--hidden-size 16 --token-width 16 --num-blocks 1 --batch-size 16 --first-scenes 2"
TINY_PATHS += " --pool-scenes 4 --updates-per-scene 10 --workers 0"
TINY_PATHS += " --total-updates 40 --eval-every 20 --eval-queries 2 --test-queries 1"
TINY_BY_TRAINER = dict.fromkeys(("bc", "gciql", "diffusion"), TINY_BC)
TINY_BY_TRAINER["roadmap_bc"] = f"{TINY_PATHS} --examples-per-scene 50"
TINY_BY_TRAINER["flow"] = f"{TINY_PATHS} --num-points 8"
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
    """Name -> text of a script's parts, each from `# SHARED: name` to the next such comment."""
    parts = re.split(r"^ *# (?=SHARED|ALGO LOGIC|MODEL)|^if __name", path.read_text(), flags=re.M)
    shared = [part.partition("\n") for part in parts if part.startswith("SHARED: ")]
    blocks = {name: text.rstrip() for name, _, text in shared}
    assert len(blocks) == len(shared)
    return blocks


@functools.cache
def panda_env(goal_type="ee"):
    """An environment that gives networks their sizes."""
    return envs.make("no_obstacles", goal_type=goal_type)


def command(trainer, folder, *flags):
    """A run of seconds; later flags win."""
    tiny = TINY_BY_TRAINER.get(trainer, TINY)
    return [sys.executable, str(PATHS[trainer]), "--runs-dir", str(folder), *tiny.split(), *flags]


def run_script(trainer, folder, *flags):
    """The folder of such a run, made in this process, which saves seconds of imports."""
    run_here(*command(trainer, folder, *flags)[1:])
    return next(folder.iterdir())


class Stopped(BaseException):
    """The end of a run right after its first checkpoint."""


def stopped_run(folder, *words):
    """The folder of a run in which nothing is executed after its first checkpoint.

    (Processes are killed at random moments in tests/robustness/attacks/kills.py.)
    """

    def save_and_stop(run, save=runs.Run.save):
        save(run)
        raise Stopped

    with patch.object(runs.Run, "save", save_and_stop), pytest.raises(Stopped):
        run_here(*words)
    (run,) = folder.iterdir()
    assert not (run / "result.json").exists()
    return run


@contextlib.contextmanager
def short_evaluations(steps=30):
    """A context in which episodes of evaluations are over after so many steps."""

    def make_short(job, make=evaluate._Job.make, **options):
        env, begin = make(job, **options)
        env.unwrapped.horizon = steps
        return env, begin

    with patch.object(evaluate._Job, "make", make_short):
        yield


@contextlib.contextmanager
def as_command(*argv):
    """A context for a command in this process: settings of torch and of signals are restored."""
    state, threads = torch.get_rng_state(), torch.get_num_threads()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with (
        patch.object(sys, "argv", [str(word) for word in argv]),
        patch.object(sys, "excepthook", sys.excepthook),
        warnings.catch_warnings(),
    ):
        warnings.filterwarnings("ignore", ".*found in sys.modules")
        try:
            yield
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            torch.use_deterministic_algorithms(False)
            torch.set_num_threads(threads)
            torch.set_rng_state(state)


def run_here(script, *arguments):
    """Run a script in this process, so that a test can patch its imports."""
    with as_command(script, *arguments):
        runpy.run_path(str(script), run_name="__main__")


def outcome_of(function, *arguments):
    """The result of a command's function as `subprocess.run` has it."""
    out, errors, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        try:
            code = function(*arguments)
        except SystemExit as end:
            code = end.code
    if isinstance(code, str):  # as the interpreter does
        errors.write(f"{code}\n")
        code = 1
    return subprocess.CompletedProcess(arguments, code or 0, out.getvalue(), errors.getvalue())


def roboarm(*arguments):
    """The result of `roboarm ARGUMENTS` in this process, which saves seconds of imports."""
    with as_command("roboarm"):
        return outcome_of(__main__.main, [str(argument) for argument in arguments])


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
