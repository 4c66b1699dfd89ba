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

if len(sys.argv) > 2:
    locale.setlocale(locale.LC_ALL, sys.argv[2])
    assert locale.localeconv()["decimal_point"] == ","
env = roboarm_nmp.make(sys.argv[1], goal_type="config")
observation, _ = env.reset(seed=0)
numbers = [observation["observation"]]
for step in range(30):
    observation, *_ = env.step(np.full(env.action_space.shape, 0.02))
    numbers.append(observation["observation"])
configurations = np.random.default_rng(0).uniform(-1, 1, (500, len(observation["desired_goal"])))
free = CollisionChecker(env.unwrapped.scene).is_free(configurations)
print(hashlib.sha256(np.concatenate([*numbers, free]).tobytes()).hexdigest())
"""


@pytest.mark.parametrize(
    "task", ["no_obstacles", f"random_boxes_easy@{ROOT / 'examples/robots/xarm6.yaml'}"]
)
def test_decimal_comma_changes_no_number(task, tmp_path):
    name = "de_DE.UTF-8"
    made = subprocess.run(["localedef", "-i", "de_DE", "-f", "UTF-8", tmp_path / name], check=False)
    if made.returncode:
        pytest.skip("localedef cannot make the German locale here")
    outputs = []
    for arguments in ([task, name], [task]):
        environment = {"LOCPATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
        environment["NUMBA_CACHE_DIR"] = str(cache_folder() / "numba")  # nothing is compiled again
        process = subprocess.run(
            [sys.executable, "-c", EPISODE, *arguments],
            capture_output=True,
            text=True,
            env=os.environ | environment,
        )
        assert process.returncode == 0, process.stderr
        outputs.append(process.stdout)
    assert outputs[0] == outputs[1]
