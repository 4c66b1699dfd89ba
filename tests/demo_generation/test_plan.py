"""`roboarm plan`: a cloud or a task, a start and a goal in; a motion out."""

import numpy as np
import pytest

from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.demo_generation import plan
from roboarm_nmp.envs import make
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.following import follow
from roboarm_nmp.envs.perception.sensors import PointCloud, SensorWorld, cardinal
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.motions.trajectories import load_joint_path, load_trajectory
from roboarm_nmp.utils import flags

POLICY = "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"


def text(numbers):
    return " ".join(f"{number:.6f}" for number in numbers)


def run(*arguments):
    """The exit code of `roboarm plan`: a number or an error's line."""
    with pytest.raises(SystemExit) as end:
        plan.main(flags.parse(plan.Args, [str(argument) for argument in arguments]))
    return end.value.code


@pytest.fixture(scope="module")
def query():
    """A query of `wall` whose straight motion is blocked."""
    queries = load_queries("wall", "validation")[:20]
    checker = CollisionChecker(queries[0].scene)
    return next(
        query
        for query in queries
        if not checker.is_motion_free(*np.clip(PANDA.normalise([query.start, query.goal]), -1, 1))
    )


@pytest.fixture(scope="module")
def cloud(query, tmp_path_factory):
    """A file with the points of four sensors around `wall`, in mm, and another frame."""
    world = SensorWorld()
    world.show(query.scene, query.start)
    points = [sensor.observe(world)["points"] for sensor in cardinal(PointCloud).values()]
    points = np.concatenate([*points, np.full((2, 3), np.nan, np.float32)])
    world.close()
    path = tmp_path_factory.mktemp("cloud") / "wall.npy"
    # Turned by 90 degrees about z, and 1 m higher.
    np.save(path, 1000 * (points[:, [1, 0, 2]] * (1, -1, 1) - (0, 0, 1)))
    return path, ("--units", "mm", "--frame", f"0 0 1 0 0 {0.5**0.5:.9f} {0.5**0.5:.9f}")


def test_retimed_motion_keeps_the_limits_and_its_ends(query, cloud, tmp_path, capsys):
    path, placed = cloud
    ends = "--start", text(query.start), "--goal", text(query.goal)
    output = tmp_path / "motion.yaml"
    assert run("--cloud", path, *placed, *ends, "--retime", "--output", output) == 0
    assert "timed in" in capsys.readouterr().out
    motion = load_trajectory(output, PANDA)
    assert np.allclose(motion.positions[[0, -1]], [query.start, query.goal], atol=1e-5)
    for rates, limit in (
        (motion.velocities, PANDA.velocity),
        (motion.accelerations, PANDA.acceleration),
    ):
        assert (np.abs(rates).max(0) <= limit * 1.001).all() and np.abs(rates).max() > 0.3


def test_retimed_path_in_contact_is_exactly_followed_and_a_line_says_so(query, capsys):
    path = np.stack([query.start, query.goal]).astype(np.float64)  # a blocked motion
    motion = plan._retimed(path, CollisionChecker(query.scene))
    assert "without a check: the path itself collides" in capsys.readouterr().out
    along = (motion.positions - path[0]) @ (path[1] - path[0]) / np.square(path[1] - path[0]).sum()
    assert np.allclose(motion.positions, path[0] + along[:, None] * (path[1] - path[0]), atol=1e-6)


def test_path_among_points_is_followed_without_contact(query, cloud, tmp_path, capsys):
    path, placed = cloud
    ends = "--start", text(query.start), "--goal", text(query.goal)
    output = tmp_path / "path.csv"
    assert run("--cloud", path, *placed, *ends, "--output", output) == 0
    printed = capsys.readouterr().out
    assert "2 not finite" in printed and "of the arm" in printed and "thinned out" in printed
    assert "minimum clearance" in printed and "planned in" in printed
    _, configurations = load_joint_path(output, PANDA)
    np.testing.assert_allclose(configurations[[0, -1]], [query.start, query.goal], atol=1e-5)
    states = np.clip(PANDA.normalise(configurations), -1, 1)
    truth = CollisionChecker(query.scene)
    assert truth.is_free(states).all()
    assert not truth.is_motion_free(states[0], states[-1])
    env = make("wall")
    execution = follow(env, np.float32(configurations), query.scene)
    assert execution.reached and not execution.collided
    env.close()
    again = tmp_path / "again.csv"
    assert run("--cloud", path, *placed, *ends, "--output", again) == 0
    assert again.read_bytes() == output.read_bytes()


def test_goal_pose_is_reached(query, cloud, tmp_path):
    path, placed = cloud
    pose, output = PANDA.end_effector_pose(query.goal), tmp_path / "path.npz"
    ends = "--start", text(query.start), "--goal-pose", text(pose)
    assert run("--cloud", path, *placed, *ends, "--output", output) == 0
    _, configurations = load_joint_path(output, PANDA)
    found = PANDA.end_effector_pose(configurations[-1])
    np.testing.assert_allclose(found[:3], pose[:3], atol=2e-4)
    assert abs(found[3:] @ pose[3:]) > 1 - 1e-6
    truth = CollisionChecker(query.scene)
    assert truth.is_free(np.clip(PANDA.normalise(configurations), -1, 1)).all()


def test_policy_acts_on_the_points(tmp_path, capsys):
    """A box of points between start and goal: straight to the goal hits it."""
    rng = np.random.default_rng(0)
    np.save(tmp_path / "box.npy", rng.uniform((0.5, -0.05, 0.0), (0.6, 0.05, 0.6), (5000, 3)))
    ends = "--start", "1 0.4 0 -1.8 0 2.2 0.8", "--goal", "-1 0.4 0 -1.8 0 2.2 0.8"
    clearances = []
    for policy in ("go-to-goal", POLICY):
        output = tmp_path / f"{policy}.csv"
        arguments = "--cloud", tmp_path / "box.npy", *ends, "--policy", policy
        assert run(*arguments, "--output", output) == 0
        printed = capsys.readouterr().out
        assert "goal reached" in printed and output.exists()
        clearances.append(float(printed.partition("minimum clearance ")[2].split()[0]))
    assert clearances[0] < -10 and clearances[1] > 0


def test_task_is_the_geometry_instead(query, tmp_path):
    ends = "--start", text(query.start), "--goal", text(query.goal)
    assert run("--task", "wall", *ends, "--output", tmp_path / "path.csv") == 0
    _, configurations = load_joint_path(tmp_path / "path.csv", PANDA)
    states = np.clip(PANDA.normalise(configurations), -1, 1)
    assert CollisionChecker(query.scene).is_free(states).all()


START, GOAL = "1 0.4 0 -1.8 0 2.2 0.8", "-1 0.4 0 -1.8 0 2.2 0.8"
BELOW = "0.4 0.3 -0.03 1 0 0 0"  # a pose in the table


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "wall"], "one of --goal and --goal-pose"),
        (["--task", "wall", "--goal", "1 2"], "--goal must be 7 finite numbers, got '1 2'"),
        (["--task", "moving_boxes_easy", "--goal", GOAL], "obstacles of moving_boxes_easy move"),
        (["--cloud", "none.ply", "--goal", GOAL], "none.ply: no such file"),
        (["--cloud", "mm.npy", "--goal", GOAL], "200 of 200 points are not finite or out of reach"),
        (["--cloud", "far.npy", "--goal-pose", "3 0 0 0 0 0 1"], "the arm cannot reach it"),
        (["--task", "wall", "--goal-pose", BELOW], "no collision-free configuration has the goal"),
        (["--cloud", "goal.npy", "--goal", GOAL], "--goal is in collision: a point is"),
    ],
)
def test_bad_arguments_give_one_line(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("far.npy", np.full((5, 3), 0.9))
    # Around the middle of the hand at the goal.
    hand = PANDA.end_effector_pose([float(word) for word in GOAL.split()])[:3] + (0, 0, 0.1)
    cloud = hand + np.random.default_rng(0).normal(0, 0.02, (200, 3))
    np.save("goal.npy", cloud)
    np.save("mm.npy", 1000 * cloud)
    code = run("--start", START, *arguments)
    assert isinstance(code, str) and message in code and "\n" not in code
