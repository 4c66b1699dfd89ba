"""An entry to the benchmark: an artificial potential field (Khatib, 1986) on observed points.

    roboarm benchmark run --function potential_field:begin --observes point_cloud --output entry

`begin` receives the problem of an episode and returns a policy: a function from an observation to
an action. Run the command in this folder.
"""

import numpy as np

from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.scenes.primitives import ObservedScene

INFLUENCE = 0.1  # m: nearer points push
GAIN = 0.0002


def begin(problem):
    robot = problem.robot
    scene = ObservedScene(robot=robot, points=problem.points)
    checker = CollisionChecker(scene)
    goal = robot.normalise(problem.goal)

    def act(observation):
        state = observation["observation"][: robot.num_joints]
        attraction = goal - state
        attraction = 0.03 * attraction / max(np.linalg.norm(attraction), 0.03)
        links = checker.link_distances(state[None])[0]  # distance (m) and its gradient, per link
        distance = np.clip(links[:, :1], 0.005, INFLUENCE)
        push = GAIN * (1.0 / distance - 1.0 / INFLUENCE) * links[:, 1:]
        return attraction + push.sum(0)

    return act
