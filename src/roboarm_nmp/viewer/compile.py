"""Compile what plans, evaluations and the viewer need, once per machine.

    roboarm compile

Numba compiles the collision checks at their first call, which takes most of a first command's time.
This command makes those calls, under a bar, and keeps the result in the user's cache folder. It has
nothing to do until the project's compiled functions, Numba or the processor change.
"""

import itertools
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.scenes.primitives import ObservedScene
from roboarm_nmp.evaluation.evaluate import evaluate
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.progress import progress_bar
from roboarm_nmp.utils.signals import end_with_one_line, error_line

POLICY = "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"
TASK = "random_boxes_hard"


@dataclass
class Args:
    force: bool = False
    """call all functions even if they were compiled before"""


def _evaluate():
    evaluate(POLICY, TASK, num_queries=1)


def _check():
    from roboarm_nmp.envs.collision.checker import CollisionChecker  # Numba takes a while

    query = load_queries(TASK)[0]
    checker = CollisionChecker(query.scene)
    state = query.scene.robot.normalise(query.start).astype(np.float64)
    checker.signed_distances(state)
    checker.end_distances(state[None], 0.01)
    checker.is_motion_free(state, state)
    checker.is_motion_free(state, state, continuous=True)
    checker.motion_checker()(tuple(state), tuple(state))


def _plan():
    query = load_queries(TASK)[0]
    _plan_in(query.scene, query.start, query.goal)


def _plan_among_points():
    from roboarm_nmp.envs.perception.point_clouds import prepare_cloud  # Numba takes a while

    query = load_queries("no_obstacles")[0]
    cloud = np.random.default_rng(0).uniform((0.9, 0.9, 0.9), (1.0, 1.0, 1.0), (500, 3))
    points, _ = prepare_cloud(cloud.astype(np.float32), configuration=query.start)
    _plan_in(ObservedScene(points=points), query.start, query.goal)


def _plan_in(scene, start, goal):
    from roboarm_nmp.planning.planner import Planner

    env = RoboArmEnv(scene)
    Planner(env).plan(start, goal, seed=0)
    env.close()


PARTS: dict[str, Callable[[], None]] = {
    "checks": _check,
    "evaluation": _evaluate,
    "plan": _plan,
    "plan among points": _plan_among_points,
}


def compile_all() -> float:
    """Call what is compiled, under a bar. Returns the seconds of processor time that it took."""
    from roboarm_nmp.utils.numba_cache import mark_compiled, watch_compilations

    began, number = time.process_time(), itertools.count(1)
    with progress_bar(total=len(PARTS), unit="part") as bar:
        for name, run in PARTS.items():
            bar.set_description(f"compiling: {name}", refresh=sys.stderr.isatty())
            with watch_compilations(lambda: bar.set_postfix(functions=next(number))):
                run()
            bar.update()
    mark_compiled()
    return time.process_time() - began


def compile_in_process() -> None:
    """`roboarm compile` in another process, so that this one's threads go on.

    It does nothing where all is compiled. If it fails, functions are compiled as they are called.
    """
    from roboarm_nmp.utils.numba_cache import is_compiled

    if not is_compiled():
        subprocess.run([sys.executable, "-m", "roboarm_nmp", "compile"], check=False)


def main(args: Args) -> None:
    """The command."""
    from roboarm_nmp.utils.numba_cache import is_compiled

    if is_compiled() and not args.force:
        print("all functions were compiled before (--force calls them again)")
        return
    print(f"compiled in {compile_all():.0f} s of processor time")


if __name__ == "__main__":
    end_with_one_line("the same command starts again")
    try:
        main(flags.parse(Args, others="compilation"))
    except (OSError, RuntimeError, ValueError) as error:
        sys.exit(error_line(error))
