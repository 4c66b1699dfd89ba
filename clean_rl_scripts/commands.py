"""The trainers as commands of an installed package: `roboarm-train-sac` and others.

Each runs its script as `python -m` does. So a trainer stays a file that is read from top to bottom,
with nothing in it for this, and the processes that it spawns find it under its name.
"""

import runpy


def train_sac():
    """SAC + HER: `clean_rl_scripts/sac_her_mp.py`."""
    runpy.run_module("clean_rl_scripts.sac_her_mp", run_name="__main__", alter_sys=True)


def train_td3():
    """TD3 + HER: `clean_rl_scripts/td3_her_mp.py`."""
    runpy.run_module("clean_rl_scripts.td3_her_mp", run_name="__main__", alter_sys=True)


def train_bc():
    """Behavioural cloning: `bc_script/bc.py`."""
    runpy.run_module("bc_script.bc", run_name="__main__", alter_sys=True)


def train_dagger():
    """Imitation of a roadmap planner: `bc_script/dagger.py`."""
    runpy.run_module("bc_script.dagger", run_name="__main__", alter_sys=True)


def collect_demonstrations():
    """Collecting demonstrations: `demo_generation/collect.py`."""
    runpy.run_module("demo_generation.collect", run_name="__main__", alter_sys=True)
