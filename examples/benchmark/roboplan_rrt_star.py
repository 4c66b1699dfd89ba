"""An entry to the benchmark: RRT* of roboplan, among boxes, with Pinocchio's collision checks.

    pip install roboplan
    roboarm benchmark run --function roboplan_rrt_star:begin --observes ground_truth --searches \
        --output entry

It stops at 1,000 nodes, after about a second, and cuts corners. Run the command in this folder.
"""

# pyright: reportMissingImports=false

import itertools
from pathlib import Path

import numpy as np
from roboplan import core, rrt
from scipy.spatial.transform import Rotation

from roboarm_nmp.envs.scenes.primitives import floor_box

NODES = 1_000
STEP = 0.02  # rad, between the configurations of a motion that are checked
MARGIN = 0.005  # m, around boxes, for the arm's lag behind its targets
ARM = "arm"


def begin(problem):
    for margin in (MARGIN, 0.0):  # the start or the goal may be near a box
        scene = make_scene(problem, margin)
        options = rrt.RRTOptions(
            group_name=ARM,
            max_nodes=NODES,
            max_connection_distance=1.0,
            rewire_distance=1.0,
            collision_check_step_size=STEP,
            rrt_connect=True,
            rrt_star=True,
            fast_return=False,
        )
        planner = rrt.RRT(scene, options)
        planner.setRngSeed(problem.seed + problem.number)
        names = list(problem.robot.joint_names)
        ends = [core.JointConfiguration(names, end) for end in (problem.start, problem.goal)]
        try:
            path = planner.plan(ends[0], ends[1])
        except RuntimeError:
            continue
        cut = core.PathShortcuttingOptions(group_name=ARM, max_step_size=STEP, seed=0)
        return np.array(core.PathShortcutter(scene, cut).shortcut(path).positions)
    return None


def make_scene(problem, margin):
    """roboplan's scene of a problem: the same URDF, the same pairs of links, the same boxes."""
    robot = problem.robot
    urdf = Path(robot.urdf)
    scene = core.Scene("scene", core.loadUrdfSceneDescription(urdf, [urdf.parent]))
    scene.addGroup(ARM, list(robot.joint_names))
    names = robot.link_names
    scene.setCollisions(list(itertools.combinations(names.values(), 2)), False)
    scene.setCollisions([(names[a], names[b]) for a, b in robot.self_collision_pairs], True)
    positions = scene.getCurrentJointPositions()
    positions[-len(robot.held_positions) :] = robot.held_positions
    scene.setJointPositions(positions)
    ignored = [names[-1]]  # the base stands on the floor, boxes may stand on a table
    boxes = [*problem.scene.obstacles, problem.scene.table, floor_box(problem.scene.floor)]
    for box in boxes:
        if box is None:
            continue
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(box.orientation).as_matrix()
        pose[:3, 3] = box.position
        shape = core.Box(*(side + 2 * margin for side in box.size))
        name = f"box {len(ignored)}"
        scene.addBoxGeometry(name, "universe", shape, pose, np.ones(4))
        scene.setCollisions([(name, other) for other in ignored], False)
        ignored.append(name)
    return scene
