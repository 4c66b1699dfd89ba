"""Recorded motions become demonstrations like planned ones; what cannot is refused for a reason."""

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import describe, load_demos
from roboarm_nmp.datasets.episodes import load_demos_for
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.datasets.recordings import Recording, fit_path, write_demonstrations
from roboarm_nmp.demo_generation.verify import verify
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.viewer import show

RANDOM = "random_boxes_easy"


def motion(demo, seconds=5.0, noise=1e-3):
    """Joint angles (m, 7), rad, and times (m,), s: a demonstration's at 50 Hz, with noise."""
    times = np.arange(0, seconds, 0.02)
    at = np.linspace(0, len(demo.states) - 1, len(times))
    columns = demo.configurations.T
    positions = np.stack([np.interp(at, np.arange(len(column)), column) for column in columns], 1)
    return positions + noise * np.random.default_rng(0).normal(size=positions.shape), times


def test_noisy_motions_at_50_hz_are_demonstrations_like_planned_ones(tmp_path):
    planned = load_demos("wall")[:4]
    path = tmp_path / "recorded.h5"
    motions = [motion(demo) for demo in planned]
    recordings = [Recording(*motions[0]), Recording(motions[1][0], actions=motions[1][0])]
    recordings += [Recording(*motions[2], goal=planned[2].goal), motions[3][0]]
    assert write_demonstrations(path, recordings, "wall", made_by="a test") == []
    demos = load_demos(path, "wall")
    assert len(demos) == 4 and not demos.collided.any() and demos.made_by == "a test"
    np.testing.assert_array_equal(demos.goal[2], planned.goal[2])
    np.testing.assert_allclose(demos.start, planned.start, atol=0.01)
    assert describe(demos)["steps"] < 1.1 * describe(planned)["steps"]
    for ours, theirs in zip(demos, planned, strict=True):  # the same way, not only the same ends
        distance = np.linalg.norm(ours.states[:, None] - theirs.states, axis=2).min(1)
        assert distance.max() < 0.03
        assert np.median(np.linalg.norm(ours.actions, axis=1)) > 0.025  # at full speed
    assert verify(path, progress=False)["good"] == 4
    assert len(load_demos_for(envs.make("wall"), [path], "wall")) == 4
    image = ["--output", str(tmp_path / "a.png"), "--size", "64", "48"]
    assert show.main(["wall", "--policy", "demo", "--demos", str(path), *image]) == 0


def test_scenes_that_vary_are_those_of_the_recordings(tmp_path):
    planned = load_demos(RANDOM)[:2]
    recordings = [Recording(*motion(demo), scene=demo.scene) for demo in planned]
    path = tmp_path / "recorded.h5"
    ((name, reason),) = write_demonstrations(path, [*recordings, motion(planned[0])[0]], RANDOM)
    assert name == "2" and "has no scene" in reason
    assert [demo.scene for demo in load_demos(path)] == [demo.scene for demo in planned]
    assert verify(path, progress=False, repair=True)["good"] == 2


def test_every_other_recording_is_refused_for_one_reason(tmp_path):
    demo = load_demos("wall")[0]
    positions, times = motion(demo, noise=0.0)
    queries = load_queries("wall")
    free, hits = (np.stack([queries.start[i], queries.goal[i]]) for i in (0, 10))
    nan = positions.copy()
    nan[5, 3] = np.nan
    jump = positions.copy()
    jump[100:, 0] -= 0.8
    bad = {
        "it is good": Recording(positions, times),
        "start and goal of recording it is good": Recording(positions, times),
        "are they in degrees?": Recording(np.degrees(positions)),
        "outside the limits by": Recording(positions + [0, 0, 0, 3, 0, 0, 0]),
        "positions[5] is not finite": Recording(nan),
        "rad/s (its limit is 2.17) at 1.9": Recording(jump, times),
        "times must be 250 numbers that increase": Recording(positions, times[::-1]),
        "must have shape (m, 7), got (250, 6)": Recording(positions[:, :6]),
        "at least two": Recording(positions[:1]),
        "split it where it reaches": Recording(np.concatenate([positions, positions[::-1]])),
        "from its goal": Recording(positions, goal=demo.start),
        "is fixed": Recording(positions, scene=load_demos("boxes")[0].scene),
        "are a test query of wall": Recording(free),
        "contact in the simulation: the arm with obstacle 0, in step": Recording(hits - 1e-4),
    }
    recordings = [Recording(**{**vars(one), "name": name}) for name, one in bad.items()]
    path = tmp_path / "recorded.h5"
    refused = write_demonstrations(path, recordings, "wall")
    assert len(load_demos(path)) == 1 and [name for name, _ in refused] == list(bad)[1:]
    assert [name for name, reason in refused if name not in reason] == []
    with pytest.raises(DatasetError, match="no recording can be used, of 1: .*degrees"):
        write_demonstrations(path, recordings[2:3], "wall")
    assert len(load_demos(path)) == 1
    assert write_demonstrations(path, recordings[-1:], "wall", allow_collisions=True) == []
    assert load_demos(path).collided.all() and verify(path, progress=False)["good"] == 1


def test_fitted_path_keeps_the_order_of_waypoints_and_returns_to_where_it_was():
    there_and_back = PANDA.lower + np.array([0.0, 1.0, 0.2, 0.6, 0.0])[:, None]
    np.testing.assert_array_equal(fit_path(there_and_back, 0.01), there_and_back)
    assert len(fit_path(PANDA.lower + np.array([0.0, 1e-3, 0.0])[:, None], 0.01)) == 3
