"""An arm is the same in every locale: its numbers are read with decimal points."""

import os
import subprocess
import sys

import pytest
from paths import ROOT

from roboarm_nmp.utils.files import cache_folder

EPISODE = """
import hashlib, locale, sys
import numpy as np
import roboarm_nmp
from roboarm_nmp.envs.collision.checker import CollisionChecker

locale.setlocale(locale.LC_ALL, sys.argv[1])
print(locale.localeconv()["decimal_point"])
for task in sys.argv[2:]:
    env = roboarm_nmp.make(task, goal_type="config")
    observation, _ = env.reset(seed=0)
    numbers = [observation["observation"]]
    for step in range(30):
        observation, *_ = env.step(np.full(env.action_space.shape, 0.02))
        numbers.append(observation["observation"])
    states = np.random.default_rng(0).uniform(-1, 1, (500, len(observation["desired_goal"])))
    free = CollisionChecker(env.unwrapped.scene).is_free(states)
    print(hashlib.sha256(np.concatenate([*numbers, free]).tobytes()).hexdigest())
"""


def test_decimal_comma_changes_no_number(tmp_path):
    tasks = ["no_obstacles", f"random_boxes_easy@{ROOT / 'examples/robots/xarm6.yaml'}"]
    name = "de_DE.UTF-8"
    made = subprocess.run(["localedef", "-i", "de_DE", "-f", "UTF-8", tmp_path / name], check=False)
    if made.returncode:
        pytest.skip("localedef cannot make the German locale here")
    outputs = []
    for used in (name, "C"):
        environment = {"LOCPATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
        environment["NUMBA_CACHE_DIR"] = str(cache_folder() / "numba")  # nothing is compiled again
        process = subprocess.run(
            [sys.executable, "-c", EPISODE, used, *tasks],
            capture_output=True,
            text=True,
            env=os.environ | environment,
        )
        assert process.returncode == 0, process.stderr
        outputs.append(process.stdout.split())
    assert [output.pop(0) for output in outputs] == [",", "."]
    assert outputs[0] == outputs[1] and len(set(outputs[0])) == 2
