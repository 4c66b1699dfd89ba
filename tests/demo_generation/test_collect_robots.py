"""Queries, demonstrations and roadmaps of another arm than the Panda, from the command line."""

import shutil

import numpy as np
import pytest
from paths import ROOT
from trainers import roboarm

from roboarm_nmp.datasets.demonstrations import demo_path, load_demos
from roboarm_nmp.datasets.queries import query_path, validate
from roboarm_nmp.demo_generation import roadmaps
from roboarm_nmp.demo_generation.roadmap_examples import RoadmapExamples
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.encoders import make_encoder
from roboarm_nmp.envs.robots.files import load_robot

ROBOTS = ROOT / "examples" / "robots"


@pytest.fixture
def file(tmp_path):
    """The file of an arm in a folder of its own."""
    return shutil.copy(ROBOTS / "xarm6.yaml", tmp_path / "xarm6.yaml")


def test_queries_and_demonstrations_of_another_arm_are_made_and_verified(file):
    task = f"random_boxes_hard@{file}"
    flags = ["--task", task, "--workers", 1]
    sizes = ["--num-test", 4, "--num-validation", 2]
    made = roboarm("queries", *flags, *sizes, "--solvable")
    assert made.returncode == 0, made.stderr
    assert set(validate(query_path(task), task, simulate=True)) == {"test", "validation"}
    made = roboarm("collect", *flags, "--num", 4)
    assert made.returncode == 0, made.stderr
    demos, robot = load_demos(task), load_robot(file)
    assert len(demos) == 4 and demos.plan.shape[1] == robot.num_joints
    assert demos.scenes.base.robot == robot and not demos.collided.any()
    verified = roboarm("verify", task, "--workers", 1)
    assert verified.returncode == 0, verified.stderr
    assert "4 good, 0 changed, 0 missed, 0 collided, 0 refused" in verified.stdout
    by_path = roboarm("verify", demo_path(task), "--workers", 1)
    assert by_path.returncode == 1 and "name the robot's file, as TASK@" in by_path.stderr


def test_roadmaps_and_examples_have_the_joints_of_the_arm(tmp_path):
    args = roadmaps.Args(
        tmp_path / "roadmaps",
        task=f"random_boxes_hard@{ROBOTS / 'xarm6.yaml'}",
        scenes=2,
        paths_per_scene=6,
        num_nodes=150,
        shard_size=1,
        workers=1,
    )
    paths = roadmaps.collect(args, progress=False)
    assert len(paths) == 2 and paths.points.shape[1] == 6
    scene = int(np.argmax(np.diff(paths.path_offsets)))  # the goals of one have no room around them
    assert len(paths.of_scene(scene)) == 6
    checker = CollisionChecker(paths.scenes[scene])
    for path in paths.of_scene(scene):
        assert checker.is_motion_free(path[:-1], path[1:]).all()
    encoder = make_encoder("oracle")
    _, examples = RoadmapExamples(args.task, paths, encoder, CollisionChecker, 1, count=8)(0)
    links = checker.link_distances(paths.points[:1]).shape[1:]
    assert examples["observation"].shape == (8, 9) and examples["direction"].shape == (8, 6)
    assert examples["link_distances"].shape == (8, *links) and links[1] == 7
