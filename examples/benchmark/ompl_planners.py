"""Entries to the benchmark: planners of OMPL, as they are, with exact collision checks.

    roboarm benchmark run --function ompl_planners:bit_star --observes ground_truth --searches \
        --output entry

`rrt_connect` (Kuffner and LaValle, 2000) ends with its first path. `rrt_star` (Karaman and
Frazzoli, 2011) and `bit_star` (Gammell et al., 2015) improve it for a second of processor time.
Then OMPL simplifies it. Run the command in this folder.
"""

import functools
import time
from typing import Any

import numpy as np
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from roboarm_nmp.envs.collision.checker import CollisionChecker

SECONDS = 1.0
MARGIN = 0.003  # m, which absorbs most of the arm's lag behind its targets
GROWTH = 0.03  # m per unit of normalised distance, from a start or goal nearer than that

ou.setLogLevel(ou.LogLevel.LOG_NONE)


def plan(planner, problem):
    """The best path (k, n), rad, that a planner finds; None if there is none."""
    robot = problem.robot
    ends = np.clip(robot.normalise(np.stack([problem.start, problem.goal])), -1.0, 1.0)
    checker = CollisionChecker(problem.scene)
    distances = checker.end_distances(ends, 2 * MARGIN)[0] - 1e-4
    is_free = checker.motion_checker(MARGIN, endpoint_margins=(ends, distances, GROWTH))
    joints = range(robot.num_joints)

    def values(state):
        return tuple(state[i] for i in joints)

    class States(ob.StateValidityChecker):
        def isValid(self, state):  # noqa: N802 (OMPL's name)
            state = values(state)
            return is_free(state, state) > 0

    class Motions(ob.MotionValidator):
        def checkMotion(self, start, end):  # noqa: N802
            return is_free(values(start), values(end)) > 0

    ou.RNG.setSeed(1 + problem.seed + problem.number)
    space = ob.RealVectorStateSpace(robot.num_joints)
    space.setBounds(-1.0, 1.0)
    information = ob.SpaceInformation(space)
    information.setStateValidityChecker(States(information))
    information.setMotionValidator(Motions(information))
    information.setup()
    definition = ob.ProblemDefinition(information)
    states: list[Any] = [information.allocState() for _ in ends]
    for state, end in zip(states, ends, strict=True):
        for i in joints:
            state[i] = float(end[i])
    definition.setStartAndGoalStates(states[0], states[1])
    definition.setOptimizationObjective(ob.PathLengthOptimizationObjective(information))
    search = planner(information)
    search.setProblemDefinition(definition)
    search.setup()
    deadline = time.process_time() + SECONDS
    search.solve(ob.PlannerTerminationCondition(lambda: time.process_time() > deadline))
    if not definition.hasExactSolution():
        return None
    path: Any = definition.getSolutionPath()
    og.PathSimplifier(information).simplifyMax(path)
    return robot.denormalise(np.array([values(state) for state in path.getStates()]))


rrt_connect = functools.partial(plan, og.RRTConnect)
bit_star = functools.partial(plan, og.BITstar)
rrt_star = functools.partial(plan, og.RRTstar)
