"""A recipe for an entry to the benchmark: cuRobo's `MotionGen`, among boxes. Not run here.

    roboarm benchmark run --function curobo_motion_gen:begin --observes ground_truth --searches \
        --workers 1 --output entry

It needs a GPU and cuRobo 0.7 (https://curobo.org). Run the command in this folder.
"""
# pyright: reportMissingImports=false

import functools

from curobo.geom.types import WorldConfig
from curobo.types.robot import JointState
from curobo.wrap.reacher.motion_gen import MotionGen, MotionGenConfig, MotionGenPlanConfig

from roboarm_nmp.envs.scenes.primitives import floor_box


@functools.cache
def generator():
    far = {"cuboid": {"far": {"dims": [0.1, 0.1, 0.1], "pose": [9, 9, 9, 1, 0, 0, 0]}}}
    config = MotionGenConfig.load_from_robot_config(
        "franka.yml", far, collision_cache={"obb": 100}, interpolation_dt=0.02
    )
    motion_gen = MotionGen(config)
    motion_gen.warmup()
    return motion_gen


def begin(problem):
    motion_gen = generator()
    scene = problem.scene
    boxes = {}
    for box in [*scene.obstacles, scene.table, floor_box(scene.floor)]:
        if box is not None:
            x, y, z, w = box.orientation
            pose = [*box.position, w, x, y, z]
            boxes[f"box {len(boxes)}"] = {"dims": list(box.size), "pose": pose}
    motion_gen.update_world(WorldConfig.from_dict({"cuboid": boxes}))
    to_device = motion_gen.tensor_args.to_device
    start, goal = (
        JointState.from_position(to_device(end[None])) for end in (problem.start, problem.goal)
    )
    result = motion_gen.plan_single_js(start, goal, MotionGenPlanConfig(max_attempts=20))
    if not result.success.item():
        return None
    return result.get_interpolated_plan().position.cpu().numpy()
