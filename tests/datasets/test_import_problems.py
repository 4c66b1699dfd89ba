"""`roboarm import`: what is imported, what is not and why; problems in other commands."""

import json

import numpy as np
import pytest
from problem_files import (
    GOALS,
    MOVEIT_REQUEST,
    MOVEIT_SCENE,
    MOVEIT_TOUCHING,
    ROBOMETRICS,
    write_file,
    write_folder,
)

import roboarm_nmp
from roboarm_nmp.clean_rl_scripts import evaluate as evaluate_script
from roboarm_nmp.datasets import import_problems as command
from roboarm_nmp.datasets.import_problems import import_problems
from roboarm_nmp.datasets.problems import Problem, load_problems, write_problems
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.evaluation.evaluate import EvaluationError
from roboarm_nmp.viewer import show

IN_THE_CAN = MOVEIT_SCENE.replace("position: [0.6, 0.5, 0.07]", "position: [0.3, 0.0, 0.5]")
BEYOND = MOVEIT_REQUEST.replace("{joint_name: panda_joint4, position: -2.0}",
                                "{joint_name: panda_joint4, position: 0.0166}")  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    """Three good problems; one whose start is in collision, a goal beyond a limit, a cone."""
    folder = tmp_path / "shelf"
    for digits in ("0001", "0002", "0003"):
        write_folder(folder, digits)
    write_folder(folder, "0004", scene=IN_THE_CAN)
    write_folder(folder, "0005", request=BEYOND)
    write_folder(folder, "0006", scene=MOVEIT_SCENE.replace("type: sphere", "type: cone"))
    return folder


def run(*arguments):
    command.main(command.flags.parse(command.Args, [str(one) for one in arguments]))


def test_summary_says_what_was_imported_and_why_others_were_not(folder, tmp_path, capsys):
    output = tmp_path / "problems.h5"
    run(folder, write_file(tmp_path / "set.yaml", ROBOMETRICS), "--output", output)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "imported 4 of 7 problems"
    assert "not imported: 1: start in collision" in lines
    assert "not imported: 1: goal outside the limits by ... rad" in lines
    assert "not imported: 1: cones are not supported (cone)" in lines
    assert "  shelf/0004: start in collision: the arm with obstacle 0" in lines
    assert "  shelf/0005: goal outside the limits by 0.017 rad: joint 4" in lines
    assert f"  shelf/0006: {folder / 'scene0006.yaml'}:29: cones are not supported (cone)" in lines
    problems = load_problems(output)
    assert problems.names == ("shelf/0001", "shelf/0002", "shelf/0003", "shelf/0")
    assert not problems.rejected
    assert list(problems[0].scene.robot.held.values()) == [0.065] * 2


def test_summary_counts_objects_and_names_constraints_that_are_not_supported(tmp_path, capsys):
    request = MOVEIT_REQUEST.replace(
        "  joint_state:\n    name",
        "  attached_collision_objects:\n  - {link_name: panda_hand, object: {primitives: "
        "[{type: sphere, dimensions: [0.02]}], primitive_poses: [{}]}}\n"
        "  joint_state:\n    name",
    )
    folder = write_folder(tmp_path / "shelf", scene=MOVEIT_TOUCHING, request=request)
    upright = f"path_constraints: {{orientation_constraints: [{{weight: 1}}]}}\n{MOVEIT_REQUEST}"
    write_folder(folder, "0002", request=upright)
    run(folder, "--output", tmp_path / "problems.h5")
    lines = capsys.readouterr().out.splitlines()
    assert "  1 with attached objects" in lines
    assert "  1 with obstacles that links may touch" in lines
    assert "not imported: 1: path_constraints are not supported" in lines
    [problem] = load_problems(tmp_path / "problems.h5")
    shapes = [type(one.shape).__name__ for one in problem.scene.robot.attached]
    assert shapes == ["Sphere", "Box"] and list(problem.scene.robot.held.values()) == [0.065] * 2


def test_goals_that_cannot_be_reached_are_left_out(tmp_path):
    far = ROBOMETRICS.replace("[0.5, -0.3, 0.0, -2.0, 0.0, 1.7, 0.8]", "[9, 0, 0, -1, 0, 1, 0]")
    kept, rejected = import_problems([write_file(tmp_path / "set.yaml", far)])
    assert not rejected and kept[0].goals.tolist() == GOALS[1:]


def test_file_is_replaced_only_if_asked_and_by_usable_problems(folder, tmp_path, capsys):
    output = write_file(tmp_path / "problems.h5", "mine")
    with pytest.raises(SystemExit, match="exists; --overwrite replaces it"):
        run(folder, "--output", output)
    bad = write_folder(tmp_path / "bad", scene=IN_THE_CAN)
    with pytest.raises(SystemExit, match="no problem can be used: nothing was written"):
        run(bad, "--output", output, "--overwrite")
    assert output.read_text() == "mine" and "imported 0 of 1" in capsys.readouterr().out
    run(folder, "--output", output, "--overwrite")
    assert len(load_problems(output)) == 3


def test_evaluation_names_the_file_and_its_hash(folder, tmp_path, capsys):
    output, result = tmp_path / "problems.h5", tmp_path / "result.json"
    run(folder, "--output", output)
    arguments = ["--policy", "planner", "--problems", output, "--json", result, "--workers", "1"]
    assert evaluate_script.main([str(one) for one in arguments]) == 0
    assert "planner on problems.h5: 3 problems" in capsys.readouterr().out
    found, problems = json.loads(result.read_text()), load_problems(output)
    assert found["problems"] == {"file": "problems.h5", "sha256": problems.digest}
    assert found["task"] is None and found["num_queries"] == 3
    assert found["collision_free_success_rate"] == 1.0


def test_evaluation_takes_the_nearest_free_goal_or_one_with_the_pose(tmp_path):
    box = Scene((Box((0.4, 0.3, 0.3), (0.1, 0.1, 0.6)),))
    start, near = np.array([0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.8]), np.zeros(7)
    near[0] = 0.2
    far, blocked = 3.0 * near, np.array([0.64, 0.3, 0.0, -1.9, 0.0, 2.2, 0.8])
    goals, pose = (
        np.array([start + far, blocked, start - near]),
        PANDA.end_effector_pose(start - far),
    )
    problems = [
        Problem("several", start, goals, None, box),
        Problem("a pose", start, np.empty((0, 7)), pose, box),
    ]
    write_problems(tmp_path / "a.h5", problems)
    given = {"problems": tmp_path / "a.h5", "goal_type": "config"}
    found = roboarm_nmp.evaluate("go-to-goal", **given)
    assert found["success_rate"] == found["collision_free_success_rate"] == 1.0
    # Straight to the nearest goals; the others are farther away, or in the box.
    assert 0.15 < found["path_length"] < 0.35
    blocked_only = problems[0]._replace(goals=np.array([blocked, blocked]))
    beyond = problems[1]._replace(goal_pose=np.array([2.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0]))
    for problem, message in (
        (blocked_only, "all of its goals are in"),
        (beyond, "no collision-free configuration has its goal pose"),
    ):
        write_problems(tmp_path / "a.h5", [problem])
        with pytest.raises(EvaluationError, match=f"problem {problem.name}: .*{message}"):
            roboarm_nmp.evaluate("go-to-goal", **given)


def test_evaluation_of_unusable_problems_says_what_to_do(folder, tmp_path):
    with pytest.raises(EvaluationError, match="cones are not.*`roboarm import` writes a file of"):
        roboarm_nmp.evaluate("go-to-goal", problems=folder)
    with pytest.raises(EvaluationError, match="give one of them"):
        roboarm_nmp.evaluate("go-to-goal", problems=folder, queries="a.h5")
    with pytest.raises(EvaluationError, match="problems have no splits"):
        roboarm_nmp.evaluate("go-to-goal", problems=folder, split="validation")


def test_image_of_a_problem(folder, tmp_path):
    run(folder, "--output", tmp_path / "a.h5")
    arguments = ["--problems", tmp_path / "a.h5", "--size", "64", "48", "--output"]
    assert show.main([str(one) for one in [*arguments, tmp_path / "a.png"]]) == 0
    assert (tmp_path / "a.png").exists()
    assert show.main([str(one) for one in [*arguments, tmp_path / "a.png", "--query", "3"]]) == 2
