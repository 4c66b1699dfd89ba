"""A recipe for an entry to the benchmark: VAMP's RRT-Connect, among boxes. Not run here.

    roboarm benchmark run --function vamp_rrt_connect:begin --observes ground_truth --searches \
        --output entry

It needs https://github.com/KavrakiLab/vamp, for whose names see its `scripts`. Run the command in
this folder.
"""
# pyright: reportMissingImports=false

import vamp
from scipy.spatial.transform import Rotation

from roboarm_nmp.envs.scenes.primitives import floor_box

MARGIN = 0.005  # m, around boxes, for the arm's lag behind its targets


def begin(problem):
    panda, plan, settings, simplification = vamp.configure_robot_and_planner_with_kwargs(
        "panda", "rrtc"
    )
    scene = problem.scene
    environment = vamp.Environment()
    for box in [*scene.obstacles, scene.table, floor_box(scene.floor)]:
        if box is not None:
            angles = Rotation.from_quat(box.orientation).as_euler("xyz").tolist()
            half = [side / 2 + MARGIN for side in box.size]
            environment.add_cuboid(vamp.Cuboid(list(box.position), angles, half))
    ends = problem.start.tolist(), problem.goal.tolist()
    sampler = panda.halton()
    result = plan(*ends, environment, settings, sampler)
    if not result.solved:
        return None
    return panda.simplify(result.path, environment, simplification, sampler).path.numpy()
