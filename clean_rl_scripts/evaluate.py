"""Evaluate a policy on the queries of a task: how often it reaches the goal, and how well.

    roboarm evaluate --policy go-to-goal --task double_walls
    roboarm evaluate --policy sac-ee-wall-p1-s1                  # on the task it was trained on
    roboarm evaluate --policy runs/my_run --task wall --json result.json
    roboarm evaluate --policy planner --problems problems.h5     # of other programs' files
    roboarm evaluate --policy replanning --task moving_boxes_medium --geometry-source point_cloud
    python clean_rl_scripts/evaluate.py --policy random --task boxes    # the same script

An episode is one query, in the query's scene, under the task's standard rules: goal tolerances,
horizon and longest step of `RoboArmEnv`'s defaults, contacts allowed. The same arguments give the
same numbers, times excepted, whatever the number of workers.

A policy that was trained with another longest step (`max_step`) acts with that one, and
`--stop-on-collision` is no standard rule either. Such numbers are not comparable with others: the
table and the JSON (`deviations`, empty under the standard rules) contain a note.

Baselines to compare a trained policy with:

- go-to-goal: straight to the goal configuration, whatever is in the way;
- random: a random action at every step;
- via-points: straight, or through one of `--tries` random configurations if that motion is free;
- planner: follows a plan of OMPL's RRT-Connect, found within `--time-limit` seconds;
- replanning: checks its plan in each step, and plans again whenever it is blocked;
- space-time: follows a plan for the known future motions of obstacles, the reference with them.

The last four check collisions with the obstacles of `--geometry-source`, by default the ground
truth, which `space-time` always has. `--safety-margin` puts a safety filter around any policy. A
result that used ground-truth obstacles is `privileged`.

The success rate counts contacts as no failure, the collision-free success rate does. Both, and the
collision rate, have 95% Wilson intervals. Means over the successful episodes: steps, path length
(rad), smoothness (rad/step^2, lower is smoother), end effector's path (m), duration (s), jerk
(rad/s^3), clearance (m). docs/guide/evaluation.md describes baselines, filter and every number.

From Python: `roboarm_nmp.evaluate(policy, task, ...)` returns the same numbers as a dict.
"""

import io
import json
import sys
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from roboarm_nmp.evaluation.report import report
from roboarm_nmp.policies.baselines import OMPL_PLANNERS, TIME_LIMIT, TRIES
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import check_writable, write_atomically
from roboarm_nmp.utils.signals import end_with_one_line, error_line

FILTER_FLAGS = ("safety_margin", "escape", "lookahead", "obstacle_velocities", "approach")


@dataclass
class Args:
    policy: str
    """`go-to-goal`, `random`, `via-points`, `planner`, `replanning`, `space-time` (see above), a
    policy network, a run's folder with a `policy.onnx` in it, or the name of a pretrained policy
    (`roboarm policies`)"""
    task: str | None = None
    """the task, one of `roboarm_nmp.TASKS`, or a scene file (.yaml); with another arm TASK@FILE, a
    robot's file (docs/customise/robot.md); by default the task that the policy was trained on"""
    goal_type: Literal["ee", "config", "combined", "pose"] | None = None
    """what the goal is; by default the policy's own, otherwise `ee`"""
    split: Literal["test", "validation", "original"] = "test"
    """which of the task's queries; few tasks have `original` ones"""
    queries: Path | None = None
    """a query file to use instead of the task's own"""
    problems: Path | None = None
    """a file or folder of problems to use instead of a task's queries: `problems.h5` of `roboarm
    import`, or a file that it reads (docs/customise/problems.md); no task is needed"""
    num_queries: flags.PositiveInt | None = None
    """only the first so many queries of the split"""
    workers: flags.Workers = flags.CORES
    """processes, one core each; by default as many as there are cores"""
    stop_on_collision: bool = False
    """end an episode at the first contact"""
    geometry_source: str | None = None
    """where `planner`, `via-points`, `replanning`, the safety filter and the policy's observations
    take the obstacles from: `ground_truth`, `point_cloud`, or an encoder with a decoder (a name or
    path); by default the policy's own, otherwise `ground_truth`, and with --verify-else
    `point_cloud`"""
    safety_margin: flags.NonNegativeFloat | None = None
    """put a safety filter with this margin (m) around the policy, e.g. 0.01; 0 for no filter; by
    default the filter that the policy includes, if any"""
    escape: bool = True
    """the safety filter escapes local minima, in a random direction"""
    replan: bool = False
    """whenever the policy is stuck, follow a plan for 90 steps, as `replanning` does, among the
    obstacles of the geometry source; the safety filter then makes no escapes"""
    search: bool = False
    """of a policy that draws paths: search for one where none of its own can be verified"""
    unknown: Literal["free", "occupied"] | None = None
    """what space counts as that no sensor sees, for `planner` with the geometry source
    `point_cloud` (by default free), and for a policy that draws paths (by default occupied, and
    free only where it finds no path otherwise)"""
    verify_else: str | None = None
    """predict the policy's motion in static scenes, and verify it in a point cloud before the arm
    moves; where that fails, this policy acts instead, e.g. `planner`, one that draws paths, or the
    policy itself"""
    lookahead: flags.NonNegativeFloat = 0.0
    """s: the safety filter takes distances as they will be after this time, if obstacles continue
    to approach as they do now"""
    obstacle_velocities: bool = True
    """the safety filter takes the velocities of obstacles into account, estimated from successive
    observations; otherwise each observation counts as if nothing moved"""
    approach: bool = False
    """add approach paths to the safety filter: out of starts near obstacles, and into goals near
    obstacles or in boxes and compartments (docs/guide/safety_filter.md)"""
    observe_every: flags.PositiveInt | None = None
    """steps from one observation of the scene to the next, with the arm where it is; by default
    static scenes are observed once, and scenes with moving obstacles in every step"""
    sensor_noise: tuple[str, ...] = ()
    """NAME=VALUE pairs of sensor noise, e.g. `gaussian=0.005 dropout=0.1`
    (docs/guide/perception.md, "Sensor noise")"""
    seed: flags.Seed = 0
    """of random numbers: `random`, `via-points`, `planner`, escapes"""
    tries: flags.PositiveInt = TRIES
    """random configurations that `via-points` tries per query"""
    time_limit: flags.PositiveFloat = TIME_LIMIT
    """seconds that `planner` and `space-time` may search per query"""
    action_delay: flags.NonNegativeInt = 0
    """steps after which an action takes effect, while the arm makes the step before it and then
    holds its configuration; 0: the simulation waits for the policy"""
    real_time: bool = False
    """instead: as many steps of 1/30 s as an action, or a plan, takes to compute, at least 1; the
    numbers depend on the machine and its load"""
    measure_clearance: bool = False
    """also measure each successful episode's smallest distance from the ground-truth obstacles"""
    json: Path | None = None
    """write the results to this file too"""
    image: Path | None = None
    """render the first query's episode as an image strip into this PNG file"""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command. Returns the exit code: 0, or 2 for arguments that cannot be used."""
    args = flags.parse(Args, arguments)
    try:
        flags.check(args)
        _check_baseline_flags(args)
        if args.json is not None and args.json == args.image:
            raise ValueError(f"--json and --image are the same file, {args.json}")
        for path in (args.json, args.image):
            if path is not None:
                check_writable(path)
        # Here, so that neither --help nor these errors wait for PyTorch.
        from roboarm_nmp.envs.perception.noise import SensorNoise
        from roboarm_nmp.evaluation.evaluate import evaluate, first_episode_images

        options = dict(vars(args))
        for name in ("json", "image", *FILTER_FLAGS):
            del options[name]
        options["sensor_noise"] = None
        if args.sensor_noise:
            options["sensor_noise"] = SensorNoise.parse(args.sensor_noise)
        options["safety_filter"] = _safety_filter(args)
        result = evaluate(**options, progress=True)
    except (ValueError, BrokenProcessPool) as error:
        print(error_line(error), file=sys.stderr)
        return 2
    print(report(result | {"policy": args.policy}), flush=True)  # before JSON on /dev/stdout
    try:
        if args.json is not None:
            write_atomically(args.json, (json.dumps(result, indent=2) + "\n").encode())
        if args.image is not None:
            png = io.BytesIO()
            strip = np.hstack(first_episode_images(**options))
            Image.fromarray(strip).save(png, format="PNG")
            write_atomically(args.image, png.getvalue())
    except OSError as error:
        print(error_line(f"cannot write: {error}"), file=sys.stderr)
        return 2
    return 0


def _check_baseline_flags(args):
    """Raise ValueError for flags of another baseline, which would have no effect."""
    policies = {args.policy, args.verify_else}
    if args.tries != TRIES and "via-points" not in policies:
        raise ValueError("--tries is for via-points")
    if args.time_limit != TIME_LIMIT and policies.isdisjoint(OMPL_PLANNERS):
        raise ValueError(f"--time-limit is for {' and '.join(OMPL_PLANNERS)}")


def _safety_filter(args):
    """The flags' safety filter as for `evaluate`. Raises ValueError: there is none to change."""
    from roboarm_nmp.policies.registry import find_policy, own_safety_filter
    from roboarm_nmp.policies.safety_filter import SafetyFilter

    changes = {}
    if not args.escape:
        changes["--no-escape"] = {"escape": False}
    if args.approach:
        changes["--approach"] = {"approach": True}
    if args.lookahead:
        changes["--lookahead"] = {"lookahead": args.lookahead}
    if not args.obstacle_velocities:
        changes["--no-obstacle-velocities"] = {"lookahead": None}
    if args.lookahead and not args.obstacle_velocities:
        raise ValueError(
            "--lookahead needs the velocities that --no-obstacle-velocities leaves out"
        )
    if args.safety_margin is not None:
        safety_filter = SafetyFilter(args.safety_margin) if args.safety_margin else False
    elif changes:
        safety_filter = own_safety_filter(find_policy(args.policy)[0])
    else:
        safety_filter = None  # the policy's own
    if not changes:
        return safety_filter
    if not safety_filter:
        [flag, *_] = changes
        if args.safety_margin == 0:
            raise ValueError(f"{flag}: there is no safety filter with --safety-margin 0")
        raise ValueError(f"{flag}: the policy has no safety filter; --safety-margin adds one")
    for change in changes.values():
        safety_filter = replace(safety_filter, **change)
    return safety_filter


if __name__ == "__main__":
    end_with_one_line("nothing was written; the same command starts again")
    sys.exit(main())
