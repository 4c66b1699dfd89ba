"""datasets/episodes.py: episodes on demonstrations' queries, and which fit an environment.

(The contents of episodes, by hand: test_sac_her_mp.py.)
"""

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.episodes import DemoQueriesWrapper, demo_episode, load_demos_for
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.envs.robots.panda import PANDA


def test_resets_draw_queries_of_demonstrations_and_a_seed_repeats_them():
    demos = load_demos("random_boxes_hard")
    env = DemoQueriesWrapper(envs.make("random_boxes_hard", goal_type="config"), demos)
    drawn = []
    for seed in (3, None, None, 3, None, None):
        observation, info = env.reset(seed=seed)
        demo = demos[info["demo"]]
        np.testing.assert_allclose(observation["observation"][:7], demo.states[0], atol=1e-3)
        assert env.unwrapped.scene == demo.scene and info["elapsed_steps"] == 0
        np.testing.assert_array_equal(env.unwrapped.goal_configuration, demo.goal)
        drawn.append(demo.start.tobytes())
    assert drawn[:3] == drawn[3:] and len(set(drawn)) == 3
    env.close()


def test_episode_has_the_observations_of_the_environment():
    demo = load_demos("wall")[0]
    env = envs.make("wall", goal_type="combined")
    episode = demo_episode(demo, env)
    assert len(episode.observation) == len(episode.action) + 1
    for t in [*range(0, len(episode.action), 10), len(episode.action)]:
        there = PANDA.denormalise(demo.states[t]).astype(np.float32)
        observation, info = env.reset_specific(there, demo.goal)
        for name, value in observation.items():
            found = getattr(episode, name) if name == "desired_goal" else getattr(episode, name)[t]
            np.testing.assert_allclose(found, value, atol=1e-4)
        assert info["is_success"] == episode.reached[t] == (t == len(episode.action))
    env.close()


@pytest.mark.parametrize(
    "arguments, message",
    [({"velocities": True}, "have no velocities"), ({"max_step": 0.02}, "steps up to 0.03")],
)
def test_demonstrations_that_do_not_fit_are_rejected(arguments, message):
    with pytest.raises(DatasetError, match=message):
        load_demos_for(envs.make("wall", **arguments), (), "wall")
