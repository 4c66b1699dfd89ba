"""The viewer's simulation, without a browser and without viser."""

from dataclasses import replace

import numpy as np
import pytest

import roboarm_nmp
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.datasets.roadmap_paths import shard_bytes
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.files import save_scene
from roboarm_nmp.envs.scenes.motions import Oscillation, Presence
from roboarm_nmp.envs.scenes.primitives import Box, Scene, Sphere, obstacle_at
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.motions.trajectories import JointTrajectory, save_trajectory
from roboarm_nmp.policies.registry import find_policy, make_policy
from roboarm_nmp.policies.safety_filter import SafetyFilter
from roboarm_nmp.viewer.episodes import (
    demonstration_episodes,
    roadmap_episodes,
    task_episodes,
    trajectory_episodes,
)
from roboarm_nmp.viewer.simulation import PolicyArm, RecordedArm, Simulation

PRETRAINED = "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"
BLOCKED = 5  # number of a query of `wall` on which go-to-goal touches the wall
FAR = Box((0.0, 0.0, 1.5), (0.1, 0.1, 0.1))  # from the arm


@pytest.fixture
def simulation():
    """A function that makes a `Simulation` of a task with policies; all are closed afterwards."""
    made = []

    def make(task, *policies, number=0, split="test", **options):
        simulation = Simulation(task_episodes(task), split, number)
        made.append(simulation)
        for policy in policies:
            simulation.add(PolicyArm(task, policy, **options))
        return simulation

    yield make
    for simulation in made:
        simulation.close()


def run(simulation):
    while not simulation.ended:
        simulation.step()
    return simulation


def same(found, expected):
    """Whether two trajectories are equal, bit for bit, except for their times."""
    names = ("states", "actions", "contacts")
    equal = [np.array_equal(getattr(found, name), getattr(expected, name)) for name in names]
    return all(equal) and found.success == expected.success


def expected_rollout(task, policy, number, seed=0, safety_filter=None, **more):
    path, arguments = find_policy(policy)
    env = roboarm_nmp.make(task, **(arguments | more))
    begin = make_policy(path, env, seed, safety_filter=safety_filter)
    query = load_queries(task)[number]
    trajectory = rollout(env, query, begin(number, query).act)
    env.close()
    return trajectory


@pytest.mark.parametrize(
    ("task", "policy", "number"),
    [
        ("wall", "go-to-goal", BLOCKED),
        ("random_boxes_hard", PRETRAINED, 5),  # with escapes from local minima
    ],
)
def test_episode_without_edits_is_that_of_a_rollout_bit_for_bit(simulation, task, policy, number):
    expected = expected_rollout(task, policy, number, seed=7)
    shown = simulation(task, policy, number=number, seed=7)
    arm = shown.arms[0]
    run(shown)
    assert same(arm.trajectory(), expected)
    assert arm.steps == len(expected) and arm.success == expected.success
    assert arm.contact_steps == expected.contacts.sum()
    # An edit and another query leave nothing behind.
    shown.add_obstacle(FAR)
    shown.step()
    shown.select("test", number + 1)
    shown.step()
    shown.select("test", number)
    assert same(run(shown).arms[0].trajectory(), expected)


def test_safety_filter_around_a_policy_is_that_of_an_evaluation(simulation):
    own = SafetyFilter(0.02)
    arguments = {"link_distances": True, "geometry_source": "ground_truth"}
    expected = expected_rollout("wall", "go-to-goal", BLOCKED, safety_filter=own, **arguments)
    shown = simulation("wall", "go-to-goal", number=BLOCKED, safety_filter=own)
    arm = shown.arms[0]
    corrections = []
    while not arm.ended:
        shown.step()
        if arm.correction is not None:
            assert arm.correction == pytest.approx(np.linalg.norm(arm.action - arm.wanted))
            corrections.append(arm.correction)
        else:
            assert arm.escaping
    assert same(arm.trajectory(), expected)
    assert max(corrections) > 0.005


def test_arm_goes_on_from_where_it_is_when_the_goal_moves(simulation):
    shown = simulation("no_obstacles", "go-to-goal")
    arm = shown.arms[0]
    for _ in range(10):
        shown.step()
    state, position = arm.state, PANDA.forward_kinematics(shown.query.goal)
    there = position + [0.05, -0.1, 0.1]
    shown.move_goal(there)
    assert shown.edited and arm.kinematic and arm.steps == 0
    assert np.abs(arm.state - state).max() < 1e-6
    assert np.abs(PANDA.forward_kinematics(shown.query.goal) - there).max() < 1e-3
    shown.step()
    assert 0.02 < np.linalg.norm(arm.state - state) < 0.031  # a step, not a jump
    run(shown)
    reached = PANDA.forward_kinematics(PANDA.denormalise(arm.state))
    assert arm.success and np.linalg.norm(reached - there) < 0.02
    # From the start, in the physics.
    shown.restart()
    assert not arm.kinematic
    assert np.abs(PANDA.denormalise(arm.state) - shown.query.start).max() < 1e-6


def test_obstacle_moved_into_the_arm_is_a_contact_that_does_not_stop_it(simulation):
    shown = simulation("no_obstacles", "go-to-goal")
    arm = shown.arms[0]
    shown.step()
    assert not arm.in_contact
    hand = PANDA.forward_kinematics(PANDA.denormalise(arm.state))
    shown.add_obstacle(Sphere(tuple(hand), 0.06))
    assert arm.problem is None
    before = arm.state
    shown.step()
    assert arm.in_contact and arm.contacts.links & {8, 9, 10}
    assert np.linalg.norm(arm.state - before) > 0.02
    shown.replace_obstacle(0, FAR)
    shown.step()
    assert not arm.in_contact
    assert shown.query.scene.obstacles == (FAR,)
    shown.remove_obstacle(0)
    assert shown.query.scene.obstacles == ()


def test_point_cloud_policy_observes_an_obstacle_that_was_moved(simulation):
    shown = simulation("random_boxes_hard", PRETRAINED)
    arm = shown.arms[0]
    observed = []
    for x in (0.0, 0.1):
        box = shown.query.scene.obstacles[0]
        position = (box.position[0] + x, *box.position[1:])
        shown.replace_obstacle(0, replace(box, position=position))
        env = roboarm_nmp.make("random_boxes_hard", **find_policy(PRETRAINED)[1])
        query = shown.query._replace(start=PANDA.denormalise(arm.state))
        expected = env.reset_specific(*query)[0]
        env.close()
        found = arm.env.get_wrapper_attr("link_distances_at")(arm.state)
        assert np.allclose(found, expected["link_distances"], atol=1e-6)
        observed.append(arm._episode.observation["observation"])
        assert np.allclose(observed[-1], expected["observation"], atol=1e-6)
    assert not np.allclose(observed[0], observed[1], atol=1e-3)


def test_demonstrations_are_replayed_configuration_by_configuration():
    shown = Simulation(demonstration_episodes("wall"), number=4)
    shown.add(RecordedArm("demonstration"))
    demo = load_demos("wall")[4]
    states = [shown.arms[0].state]
    while not shown.ended:
        shown.step()
        states.append(shown.arms[0].state)
    assert np.array_equal(states, demo.states)
    assert shown.arms[0].success and shown.arms[0].contact_steps == 0
    # In a scene with an obstacle in the way there are contacts.
    shown.restart()
    middle = PANDA.denormalise(demo.states[len(demo.states) // 2])
    shown.add_obstacle(Sphere(tuple(PANDA.forward_kinematics(middle)), 0.05))
    assert run(shown).arms[0].contact_steps > 0
    shown.close()


def test_roadmap_paths_are_replayed_along_their_points(tmp_path):
    scenes = [Scene(), Scene((FAR,))]
    ends = [np.array([[0.0] * 7, [0.1] * 7, [0.1, 0.3] + [0.1] * 5], np.float32), np.eye(7)[:2]]
    paths = [[ends[0]], [ends[0][:2], ends[1].astype(np.float32)]]
    contents = shard_bytes("random_boxes_hard", 1, 0, scenes, paths, "a test")
    (tmp_path / "shard_00000.h5").write_bytes(contents)
    episodes = roadmap_episodes(tmp_path)
    assert episodes.count("roadmap path") == 3
    for number, (scene, path) in enumerate(
        [(scenes[0], ends[0]), (scenes[1], ends[0][:2]), (scenes[1], ends[1])]
    ):
        query, states = episodes.get("roadmap path", number)
        assert query.scene.obstacles == scene.obstacles
        assert np.allclose(states[0], path[0], atol=1e-6)
        assert np.allclose(states[-1], path[-1], atol=1e-6)
        assert np.linalg.norm(np.diff(states, axis=0), axis=1).max() < 0.03
        for point in path:
            assert np.linalg.norm(states - point, axis=1).min() < 1e-6


def test_file_of_a_trajectory_is_played_in_the_scene_of_each_query(tmp_path):
    ends = np.array([[0, -0.5, 0, -1.5, 0, 1, 0.8], [0.3, -0.5, 0, -1.5, 0, 1, 0.8]])
    rest = np.zeros_like(ends)
    trajectory = JointTrajectory(np.array([0.0, 1.0]), ends, rest, rest, PANDA)
    save_trajectory(tmp_path / "motion.yaml", trajectory)
    episodes = trajectory_episodes("random_boxes_hard", tmp_path / "motion.yaml")
    simulation = Simulation(episodes, "validation", 7)
    simulation.add(RecordedArm("trajectory"))
    scene = load_queries("random_boxes_hard", "validation")[7].scene
    assert simulation.query.scene == scene and episodes.recording == "trajectory"
    run(simulation)
    (arm,) = simulation.arms
    assert arm.steps == 30 and arm.success
    np.testing.assert_allclose(PANDA.denormalise(arm.state), ends[1], atol=1e-5)
    middle = PANDA.denormalise(arm.trace[15])
    np.testing.assert_allclose(middle[0], 0.15, atol=1e-5)  # the cubic's, between rest and rest
    simulation.close()


def test_obstacles_move_as_in_an_evaluation_and_are_drawn_where_they_are(simulation, tmp_path):
    viser = pytest.importorskip("viser")
    from roboarm_nmp.viewer.drawing import Drawing

    swinging = Box((0.5, 0.0, 0.3), (0.1, 0.1, 0.4), motion=Oscillation((0.0, 0.3, 0.0), 3.0))
    late = Sphere((0.4, 0.6, 0.5), 0.1, Presence(((0.1, 1.0),)))
    scene = Scene((swinging, late, FAR))
    save_scene(scene, tmp_path / "moving.yaml")
    shown = simulation(str(tmp_path / "moving.yaml"), "go-to-goal", split="random")
    arm, server = shown.arms[0], viser.ViserServer(port=0, verbose=False)
    try:
        drawing = Drawing(server, shown)
        places = []
        for _ in range(6):
            drawing.update()
            here = [body for (body, _), _ in drawing._places[0].bodies[:3]]
            assert here == [obstacle_at(obstacle, arm.time) for obstacle in scene.obstacles]
            assert arm.time == arm.env.unwrapped.time
            places.append(here[0])
            shown.step()
        assert len(set(places)) == 6 and here[1] is not None
    finally:
        server.stop()
    expected = rollout(arm.env, shown.query, make_policy("go-to-goal", arm.env)(0, shown.query).act)
    shown.restart()
    run(shown)
    np.testing.assert_array_equal(arm.trajectory().states, expected.states)
