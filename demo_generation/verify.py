"""Verify demonstration files: follow every plan again in the simulator; repair what fails.

    roboarm verify src/roboarm_nmp/datasets/demos/double_walls.h5 --repair

Paper: appendix "Software package description" ("verification, and correction"). A demonstration
is good if following its plan repeats the stored execution exactly, reaches the goal and has no
contact (unless the file was collected with --allow-collisions). The exit code is 1 if any is not.
"""

import contextlib
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from roboarm_nmp.datasets.demonstrations import Demo, demo_path, load_demos, write_demos
from roboarm_nmp.datasets.format import DatasetError, locate
from roboarm_nmp.demo_generation.collect import Demonstration, demonstrate, make_planner
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.following import Execution, follow
from roboarm_nmp.envs.tasks import is_task
from roboarm_nmp.utils import flags, workers
from roboarm_nmp.utils.flags import CORES, Workers
from roboarm_nmp.utils.progress import progress_bar, write_line
from roboarm_nmp.utils.signals import end_with_one_line, error_line, exit_interrupted

VERDICTS = ("good", "changed", "missed", "collided", "refused")
REPAIR_ATTEMPTS = 10


@dataclass
class Args:
    files: tyro.conf.Positional[tuple[str, ...]]
    """Demonstration files, or tasks (names or scene files; with another arm, TASK@FILE)."""
    task: str | None = None
    """The task that the files are for. Files of an arm other than the Panda need it: TASK@FILE."""
    workers: Workers = CORES
    """Number of processes, by default that of the cores."""
    repair: bool = False
    """Plan failed demonstrations anew, on the same queries, and replace the file."""


class Verifier:
    """Follows the demonstrations of a file; with `repair`, plans failed ones anew."""

    def __init__(self, path: str | Path, repair: bool, task: str | None = None):
        self.demos = load_demos(path, task)
        self.repair = repair
        self.env = RoboArmEnv(self.demos.scenes.base)
        options = self.demos.parameters["options"]
        self.allow_collisions = options["allow_collisions"]
        # Recorded motions were not planned, and cannot be planned anew.
        self.planner = make_planner(self.env, options) if "planner" in options else None

    def __call__(self, index: int) -> tuple[int, str, dict | None]:
        """`(index, verdict, demo)`: one of `VERDICTS`, and, with `repair`, the repaired demo.

        That is a dict of plan, states, plan_seed, digest and collided; None: it was not repaired.
        """
        demo = self.demos[index]
        seed = int(self.demos.plan_seed[index])
        try:
            execution = follow(self.env, demo.plan, demo.scene)
        except ValueError:
            return index, "refused", None  # start or goal is infeasible: no plan can help
        verdict = self._verdict(demo, execution)
        if not self.repair:
            return index, verdict, None
        if verdict in ("good", "changed"):
            return index, verdict, _columns(Demonstration(demo.plan, execution, seed))
        if self.planner is None:
            return index, verdict, None
        rng = np.random.default_rng([seed, index])
        repaired = demonstrate(
            self.planner,
            demo.start,
            demo.goal,
            rng,
            attempts=REPAIR_ATTEMPTS,
            allow_collisions=self.allow_collisions,
        )
        return index, verdict, None if repaired is None else _columns(repaired)

    def _verdict(self, demo: Demo, execution: Execution) -> str:
        if not execution.reached:
            return "missed"
        if execution.collided and not self.allow_collisions:
            return "collided"
        # The digest is exact; the stored states are rounded.
        if execution.digest != demo.digest or execution.states.shape != demo.states.shape:
            return "changed"
        close = np.abs(execution.states - demo.states).max() <= 0.51 * self.demos.quantum
        return "good" if close else "changed"


def _columns(demo: Demonstration) -> dict:
    return {
        "plan": demo.plan,
        "states": demo.execution.states,
        "plan_seed": demo.plan_seed,
        "digest": demo.execution.digest,
        "collided": demo.execution.collided,
    }


def verify(
    task_or_path: str | Path,
    num_workers: int = 1,
    repair: bool = False,
    progress: bool = True,
    task: str | None = None,
) -> dict[str, int]:
    """Follow every demonstration of a task or file; with `repair`, replace the file by a good one.

    `task` is that of a file, as of `load_demos`.

    A repair stores an execution that has changed as it is now, plans anew where the execution
    misses the goal or collides, and removes demonstrations for which that fails.

    Returns:
        A dict: how many demonstrations have each of `VERDICTS`, `total`, and `removed`.

    Raises:
        DatasetError: the file cannot be used.
        OSError: it cannot be written.
    """
    path, own_task = locate(task_or_path, demo_path)
    task = task or own_task
    demos = load_demos(path, task)
    arguments = (path, repair, task)
    task = task or demos.task
    if repair and not is_task(task):
        raise DatasetError(f"{path}: to repair it, name the scene file {task}.yaml instead")
    if "options" not in demos.parameters:
        raise DatasetError(f"{path}: has no record of the options it was collected with")
    counts = Counter()
    repaired = {}  # number -> demonstration; None for one that is removed
    results = workers.run(Verifier, arguments, range(len(demos)), num_workers, write_line)
    bar = progress_bar(results, path.name, len(demos), unit="demo", disable=not progress)
    with contextlib.closing(results):
        for index, verdict, demo in bar:
            counts[verdict] += 1
            repaired[index] = demo
    bad = len(demos) - counts["good"]
    removed = 0
    if repair and bad:
        kept = [index for index in range(len(demos)) if repaired[index] is not None]
        good = [repaired[index] for index in kept]
        removed = len(demos) - len(good)
        if not good:
            raise DatasetError(f"{path}: none of its demonstrations can be repaired")
        write_demos(
            path,
            task,
            demos.seed,
            [demo["plan"] for demo in good],
            [demo["states"] for demo in good],
            {name: [demo[name] for demo in good] for name in ("plan_seed", "digest", "collided")},
            made_by=demos.made_by,
            parameters={
                **demos.parameters,
                "repaired": demos.parameters.get("repaired", 0) + bad - removed,
                "removed": demos.parameters.get("removed", 0) + removed,
            },
            scenes_of=None if demos.scenes.index is None else [demos.scenes[i] for i in kept],
        )
    totals = {name: counts[name] for name in VERDICTS}
    return {**totals, "total": len(demos), "removed": removed}


def main(args: Args):
    """The command. It exits with 1 if any demonstration is bad and was not repaired."""
    try:
        flags.check(args)
    except ValueError as error:
        sys.exit(error_line(error))
    failed = False
    for name in args.files:
        try:
            counts = verify(name, args.workers, args.repair, task=args.task)
        except (ValueError, OSError, RuntimeError) as error:
            print(error_line(error), file=sys.stderr)
            failed = True
            continue
        except KeyboardInterrupt as interrupt:
            exit_interrupted(interrupt, f"{name} is unchanged: the same command verifies it again")
        bad = counts["total"] - counts["good"]
        text = ", ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS)
        text += f" of {counts['total']} demonstrations"
        if bad and args.repair:
            text += f"; {bad - counts['removed']} repaired, {counts['removed']} removed"
        print(f"{name}: {text}")
        failed = failed or (bad > 0 and not args.repair)
    sys.exit(int(failed))


if __name__ == "__main__":
    end_with_one_line("nothing has changed")
    main(flags.parse(Args))
