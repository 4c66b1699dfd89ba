"""From a raw point cloud to a joint path: time of each step, and whether the plan holds.

    python benchmarks/point_clouds.py
    python benchmarks/point_clouds.py --policy dagger-combined-point_cloud-random_boxes_hard-s1

The clouds are those of validation queries: four sensors with 160 x 160 rays observe the scene, the
arm at the start, table and floor, 102,400 points without labels. Each is prepared and planned in
with one `Planner`, as a process does that receives cloud after cloud. Milliseconds are wall-clock
time and, where other processes run, the processor's. Paths are judged by the ground-truth
obstacles: followed in the simulator, they reach the goal, with or without contact. With `--policy`,
the policy's computing time of an episode is reported, too.
"""

import argparse
import time

import numpy as np

import roboarm_nmp
from roboarm_nmp.datasets.queries import Query, load_queries
from roboarm_nmp.envs.perception.point_clouds import prepare_cloud
from roboarm_nmp.envs.perception.sensors import PointCloud, SensorWorld, cardinal
from roboarm_nmp.envs.scenes.primitives import ObservedScene
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.motions.trajectories import timed
from roboarm_nmp.planning.following import follow
from roboarm_nmp.planning.planner import Planner, PlanningError
from roboarm_nmp.policies.registry import find_policy, make_policy
from roboarm_nmp.utils.progress import progress_bar

STEPS = ("preparation", "scene", "plan", "joint path")


def seconds():
    return np.array([time.perf_counter(), time.process_time()])


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--task", default="random_boxes_hard")
    parser.add_argument("--num-queries", type=int, default=200)
    parser.add_argument("--policy", help="also roll out this policy of observed points")
    args = parser.parse_args()
    queries = load_queries(args.task, "validation")[: args.num_queries]
    env, world = roboarm_nmp.make("no_obstacles"), SensorWorld()
    truth = roboarm_nmp.make(args.task)
    planner, sensors = Planner(env), cardinal(PointCloud, num_samples=160**2).values()
    if args.policy:
        policy, arguments = find_policy(args.policy)
        acting = roboarm_nmp.make(ObservedScene(), **arguments)
        begin = make_policy(policy, acting)
    times, policy_times, reached, free, found = [], [], 0, 0, 0
    for number, query in enumerate(progress_bar(queries, "queries", unit="query")):
        world.show(query.scene, query.start)
        cloud = np.concatenate([sensor.observe(world)["points"] for sensor in sensors])
        if number == 0:  # compiled functions are loaded
            prepare_cloud(cloud, configuration=query.start)
        marks = [seconds()]
        points, _ = prepare_cloud(cloud, configuration=query.start)
        marks.append(seconds())
        scene = ObservedScene(points=points)
        marks.append(seconds())
        try:
            path = planner.plan(query.start, query.goal, scene, seed=number)
        except PlanningError:
            path = None
        marks.append(seconds())
        if path is not None:
            timed(path, env.robot)
            marks.append(seconds())
            times.append(np.diff(marks, axis=0))
            execution = follow(truth, path, query.scene)
            found += 1
            reached += execution.reached
            free += execution.reached and not execution.collided
        if args.policy:
            one = Query(query.start, query.goal, scene)
            episode = rollout(acting, one, begin(number, one).act)
            policy_times.append(episode.times.sum())
    times = 1000 * np.array(times)
    print(f"{len(cloud):,} points, {len(queries)} queries of {args.task}, ms on one core")
    print(f"{'':14}{'median':>8}{'mean':>8}{'processor, median':>19}")
    for row, name in enumerate(STEPS):
        wall, cpu = times[:, row, 0], times[:, row, 1]
        print(f"{name:14}{np.median(wall):8.1f}{wall.mean():8.1f}{np.median(cpu):19.1f}")
    wall, cpu = times.sum(1).T
    print(f"{'together':14}{np.median(wall):8.1f}{wall.mean():8.1f}{np.median(cpu):19.1f}")
    print(f"within 100 ms: {(wall <= 100).mean():.3f}, of the processor {(cpu <= 100).mean():.3f}")
    shares = [n / len(queries) for n in (found, reached, free)]
    print("plan found {:.3f}, success {:.3f}, collision-free {:.3f}".format(*shares))
    if args.policy:
        of_policy = 1000 * np.array(policy_times)
        print(f"policy, an episode: median {np.median(of_policy):.0f} ms")


if __name__ == "__main__":
    main()
