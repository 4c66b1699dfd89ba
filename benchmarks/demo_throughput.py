"""Verified demonstrations per second on one core, against planning and following the plain way.

    pip install -c constraints.txt -e .
    python benchmarks/demo_throughput.py                                  # 3 minutes
    python benchmarks/demo_throughput.py --planner-range 0 --simplify 3   # other options of ours

`ours` is `demo_generation.collect.Collector`. On `random_boxes_hard` it is timed alone and end to
end, with new scenes and queries (`--random`), because the plain way has one scene. On the other
tasks both ways get the same queries, planner seeds, checks per plan, attempts, scene and arm. A
demonstration counts if it reaches its goal (0.02 m and 0.05 normalised) without contact in any
physics step. Sampling the queries takes both ways the same time, and counts in the column "end to
end" only.

The plain way follows the examples of PyBullet and OMPL:

- world: PyBullet's default physics (1/240 s); the URDF's self-collision switched on, without
  filters. Link pairs that always or never collide (those not in `PANDA.self_collision_pairs`) and
  the base on its table are skipped in Python when contacts are read.
- validity: `resetJointState` joint by joint, `performCollisionDetection`, `getContactPoints`;
  any overlap is a collision. The resolution is ours, as a fraction of the space's diagonal.
- plan: RRT-Connect in joint space (rad), then `simplifyMax`.
- following: the plan, interpolated like ours, is commanded joint by joint with
  `setJointMotorControl2` and default gains. The next point follows when the arm is within 0.01
  (normalised) of this one, or after 30 physics steps. A contact ends the attempt.

The two alternate in one process, block by block, so that a drift of the machine's speed affects
both. Seconds are processor time. A rate is the number of demonstrations by the sum of seconds,
because queries differ too much for a median over blocks; the interval (90 %) is from resampling the
queries.

The last line is JSON.
"""

import argparse
import json
import os
import platform
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pybullet_data
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou
from tqdm import tqdm

from roboarm_nmp import envs
from roboarm_nmp.demo_generation import collect
from roboarm_nmp.envs.collision.checker import RESOLUTION
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Box, Scene
from roboarm_nmp.envs.subgoals import subgoals
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.utils.random_streams import Stream

# The tasks for the plain way: those with a fixed scene, a table and a floor.
FIXED = [
    name for name, task in envs.TASKS.items() if task.trainable and isinstance(task.scene, Scene)
]
BLOCK = 5  # queries
# Of the plain way: seconds for one plan; normalised distance and physics steps for one sub-goal.
TIME_LIMIT, TOLERANCE, STEP_LIMIT = 10.0, 0.01, 30


class GivenUp(Exception):
    """All attempts on a query failed."""


def length_of(path):
    """Of a path (n, 7), rad: L2 in the normalised space."""
    return np.linalg.norm(np.diff(PANDA.normalise(path), axis=0), axis=1).sum()


class Ours:
    """The collector on given queries.

    `checks` has the collision checks of each plan, `lengths` the length of each path found.
    """

    def __init__(self, options):
        self.collector = collect.Collector(options)
        self.collector(0)  # compiles
        self.checks, self.lengths = [], []
        self._draw = self.collector.env.sample_query
        self._plan = self.collector.planner.plan
        self.collector.env.sample_query = self._given
        self.collector.planner.plan = self._counted

    def draw(self, index):
        """Query `index` of the collector: (start, goal, state of the generator after it)."""
        options = self.collector.options
        rng = np.random.default_rng([options["seed"], Stream.DEMONSTRATIONS, index])
        return *self._draw(rng), rng.bit_generator.state

    def _given(self, rng):
        if self._query is None:
            raise GivenUp  # the collector would continue with another query
        start, goal, rng.bit_generator.state = self._query
        self._query = None
        return start, goal

    def _counted(self, *query, **options):
        try:
            path = self._plan(*query, **options)
        finally:
            self.checks.append(self.collector.planner.checks)
        self.lengths.append(length_of(path))
        return path

    def __call__(self, query):
        """Whether a query could be solved."""
        self._query = query
        try:
            self.collector(0)  # the index matters only for drawing
        except GivenUp:
            return False
        return True


class Plain:
    """The plain way, see above; the same interface."""

    def __init__(self, options):
        self.options = options
        self.checks, self.lengths = [], []
        self.client = client = p.connect(p.DIRECT)
        p.setGravity(0, 0, -9.81, physicsClientId=client)
        self.robot = p.loadURDF(
            pybullet_data.getDataPath() + "/franka_panda/panda.urdf",
            useFixedBase=True,
            flags=p.URDF_USE_SELF_COLLISION,
            physicsClientId=client,
        )
        for finger, opening in zip(PANDA.held_indices, PANDA.held_positions, strict=True):
            p.resetJointState(self.robot, finger, opening, physicsClientId=client)
            self.command(finger, opening, 20.0)
        scene = envs.TASKS[options["task"]].scene
        self.table = self.add(scene.table)
        for box in (Box((0, 0, scene.floor - 0.05), (6, 6, 0.1)), *scene.obstacles):
            self.add(box)

        space = ob.RealVectorStateSpace(PANDA.num_joints)
        bounds = ob.RealVectorBounds(PANDA.num_joints)
        for i in range(PANDA.num_joints):
            bounds.setLow(i, PANDA.lower[i])
            bounds.setHigh(i, PANDA.upper[i])
        space.setBounds(bounds)
        self.space = ob.SpaceInformation(space)
        self.space.setStateValidityChecker(self.is_valid)
        # A share of the longest motion: as far apart, in the normalised space, as ours.
        self.space.setStateValidityCheckingResolution(RESOLUTION / (2 * PANDA.num_joints**0.5))
        self.space.setup()

    def add(self, box):
        half = [edge / 2 for edge in box.size]
        client = self.client
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client)
        return p.createMultiBody(
            0, shape, -1, box.position, box.orientation, physicsClientId=client
        )

    def command(self, joint, angle, force):
        p.setJointMotorControl2(
            self.robot,
            joint,
            p.POSITION_CONTROL,
            targetPosition=angle,
            force=force,
            physicsClientId=self.client,
        )

    def teleport(self, configuration):
        for i in PANDA.joint_indices:
            p.resetJointState(self.robot, i, configuration[i], physicsClientId=self.client)

    def in_contact(self):
        """Whether one of the contacts is a collision."""
        for contact in p.getContactPoints(bodyA=self.robot, physicsClientId=self.client):
            body, link, other_link = contact[2:5]
            if contact[8] >= 0.0 and contact[9] <= 0.0:
                continue
            if body == self.robot:
                pair = (min(link, other_link), max(link, other_link))
                if pair in PANDA.self_collision_pairs:
                    return True
            elif body != self.table or link != -1:
                return True
        return False

    def is_valid(self, state):
        self.plan_checks += 1
        self.teleport(state)
        p.performCollisionDetection(physicsClientId=self.client)
        return not self.in_contact()

    def plan(self, start, goal, seed):
        """A path (n, 7), rad; None if there is none within the limits."""
        self.plan_checks = 0
        deadline = time.monotonic() + TIME_LIMIT
        ou.RNG.setSeed(seed)
        ends = []
        for configuration in (start, goal):
            state = self.space.allocState()
            for i, angle in enumerate(np.clip(configuration, PANDA.lower, PANDA.upper)):
                state[i] = float(angle)
            ends.append(state)
        problem = ob.ProblemDefinition(self.space)
        problem.setStartAndGoalStates(*ends)
        planner = og.RRTConnect(self.space)
        planner.setProblemDefinition(problem)
        planner.setup()
        planner.solve(
            ob.PlannerTerminationCondition(
                lambda: (
                    self.plan_checks >= self.options["max_checks"] or time.monotonic() > deadline
                )
            )
        )
        path = None
        if problem.hasExactSolution():
            path = problem.getSolutionPath()
            og.PathSimplifier(self.space).simplifyMax(path)
            path = np.array([[state[i] for i in range(7)] for state in path.getStates()])
            self.lengths.append(length_of(path))
        self.checks.append(self.plan_checks)
        return path

    def follow(self, path):
        """Whether the arm follows a path from its start to its end without contact."""
        client, robot = self.client, self.robot
        self.teleport(path[0])
        targets = subgoals(path, PANDA)[1:]
        for target in targets:
            for i, angle in zip(PANDA.joint_indices, PANDA.denormalise(target), strict=True):
                self.command(i, angle, PANDA.effort[i])
            for _ in range(STEP_LIMIT):
                p.stepSimulation(physicsClientId=client)
                if self.in_contact():
                    return False
                joints = p.getJointStates(robot, PANDA.joint_indices, physicsClientId=client)
                state = PANDA.normalise([joint[0] for joint in joints])
                if np.linalg.norm(state - target) <= TOLERANCE:
                    break
        link = p.getLinkState(
            robot, PANDA.end_effector_link, computeForwardKinematics=1, physicsClientId=client
        )
        ee_distance = np.linalg.norm(link[4] - PANDA.forward_kinematics(path[-1]))
        return ee_distance <= 0.02 and np.linalg.norm(state - targets[-1]) <= 0.05

    def __call__(self, query):
        """Whether a query could be solved."""
        start, goal, random_state = query
        rng = np.random.default_rng()
        rng.bit_generator.state = random_state
        for _ in range(self.options["attempts"]):
            path = self.plan(start, goal, int(rng.integers(1, 2**32)))
            if path is not None and self.follow(path):
                return True
        return False


def measure(args, number, progress):
    """Both ways with the collector's `Args`.

    Returns dict way -> (seconds (n,), solved (n,), checks, length), and the seconds for sampling a
    query.
    """
    options = collect.options_of(args)
    ways = {"ours": Ours(options), "plain": Plain(options)}
    seconds, solved = {way: [] for way in ways}, {way: [] for way in ways}
    drawing = 0.0
    for first in range(0, number, BLOCK):
        block = range(first, min(first + BLOCK, number))
        began = time.process_time()
        queries = [ways["ours"].draw(index) for index in block]
        drawing += time.process_time() - began
        for way, solve in ways.items():
            for query in queries:
                began = time.process_time()
                solved[way].append(solve(query))
                seconds[way].append(time.process_time() - began)
        progress.update(len(block))
    measured = {
        name: (
            np.array(seconds[name]),
            np.array(solved[name]),
            np.mean(way.checks),
            np.mean(way.lengths),
        )
        for name, way in ways.items()
    }
    return measured, drawing / number


def random_scenes(number, progress):
    """Our demonstrations per second on `random_boxes_hard`, and the share of queries solved."""
    collector = collect.Collector(collect.options_of(collect.Args("random_boxes_hard")))
    collector(number)
    seconds = given_up = 0.0
    for index in range(number):
        began = time.process_time()
        given_up += collector(index)["given_up"]
        seconds += time.process_time() - began
        progress.update(1)
    return number / seconds, number / (number + given_up)


def ratio_of(measured, rows):
    """Our rate by the plain one, on the queries `rows`."""
    (seconds, solved, *_), (plain_seconds, plain_solved, *_) = measured["ours"], measured["plain"]
    ours = solved[rows].sum(-1) / seconds[rows].sum(-1)
    return ours * plain_seconds[rows].sum(-1) / np.maximum(plain_solved[rows].sum(-1), 1)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--num", type=int, default=100, help="queries per task")
    parser.add_argument("--tasks", nargs="+", default=FIXED, choices=FIXED)
    parser.add_argument("--random", type=int, default=500, help="of random_boxes_hard (500)")
    for name in ("planner_range", "simplify"):
        default = getattr(collect.Args, name)
        flag = f"--{name.replace('_', '-')}"
        parser.add_argument(flag, type=type(default), default=default, help=f"of ours ({default})")
    args = parser.parse_args()
    if args.num < 1 or args.random < 1:
        parser.error("--num and --random must be at least 1")

    names = (
        "demos_per_second",
        "end_to_end_demos_per_second",
        "plain_demos_per_second",
        "ratio_to_plain",
        "ratio_interval",
        "solved",
        "plain_solved",
        "checks_per_plan",
        "plain_checks_per_plan",
        "length",
        "plain_length",
    )
    result = {name: {} for name in names}
    resamples = np.random.default_rng(0).integers(0, args.num, (2000, args.num))
    with tqdm(total=args.num * len(args.tasks) + args.random, unit=" queries") as progress:
        for task in args.tasks:
            progress.set_description(task)
            options = {"planner_range": args.planner_range, "simplify": args.simplify}
            measured, drawing = measure(collect.Args(task, **options), args.num, progress)
            seconds, solved, checks, length = measured["ours"]
            plain_seconds, plain_solved, plain_checks, plain_length = measured["plain"]
            interval = np.percentile(ratio_of(measured, resamples), [5, 95])
            values = (
                solved.sum() / seconds.sum(),
                solved.sum() / (seconds.sum() + args.num * drawing),
                plain_solved.sum() / plain_seconds.sum(),
                ratio_of(measured, np.arange(args.num)),
                interval.tolist(),
                solved.mean(),
                plain_solved.mean(),
                checks,
                plain_checks,
                length,
                plain_length,
            )
            for name, value in zip(names, values, strict=True):
                result[name][task] = value
        progress.set_description("random_boxes_hard")
        random_rate, random_solved = random_scenes(args.random, progress)

    print(
        "\ndemonstrations per second and core; solved: share of queries; checks, length: a plan's "
        "mean\n"
    )
    print(
        f"{'task':22}{'ours':>7}{'end to end':>12}{'plain':>7}{'ratio':>7}{'interval':>12}"
        f"{'solved':>8}{'plain':>7}{'checks':>8}{'plain':>7}{'length':>8}{'plain':>7}"
    )
    for task in args.tasks:
        row = {name: result[name][task] for name in names}
        low, high = row["ratio_interval"]
        print(
            f"{task:22}{row['demos_per_second']:7.1f}{row['end_to_end_demos_per_second']:12.1f}"
            f"{row['plain_demos_per_second']:7.2f}{row['ratio_to_plain']:7.2f}"
            f"{f'{low:.1f} to {high:.1f}':>12}{row['solved']:8.2f}{row['plain_solved']:7.2f}"
            f"{row['checks_per_plan']:8.0f}{row['plain_checks_per_plan']:7.0f}"
            f"{row['length']:8.2f}{row['plain_length']:7.2f}"
        )
    print(f"\n{'random_boxes_hard':22}{random_rate:19.1f}{random_solved:39.2f}\n")
    result |= {"random_demos_per_second": random_rate, "random_solved": random_solved}
    result |= {"queries_per_task": args.num, "python": platform.python_version()}
    print(json.dumps(result))


if __name__ == "__main__":
    main()
