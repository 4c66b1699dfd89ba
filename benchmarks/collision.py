"""Compiled collision checks against PyBullet's: agreement and speed.

    pip install -c constraints.txt -e .
    python benchmarks/collision.py                # 2 minutes
    python benchmarks/collision.py --num 15000    # fewer configurations
    python benchmarks/collision.py --robot examples/robots/iiwa.yaml

Agreement of `envs.collision.checker` with `RoboArmEnv.in_collision`: `--num` configurations, as
many for each of the thirteen tasks' scenes (random boxes: 40 scenes each, of the validation
queries) and for the 100 original problems of each MotionBenchMaker shelf. Two thirds are uniform.
The others were moved along a line between two of those to a distance from contact that is uniform
from -1 cm to 1 cm.

With `--robot`, the scenes are those of another arm: 40 scaled scenes of each distribution of random
boxes, the obstacles of every other task as they are, as in a scene file with that robot, and the
files of `--scenes`.

- disagreement: share of configurations with different answers;
- deepest_mm: of these, the largest distance from contact, by whichever of the two has the larger.

Speed: uniform configurations in 40 scenes of `random_boxes_hard`, processor time of one core, in
turns, the median of `--rounds`. `link_distances` takes one free configuration at a time, as at
every step of a policy, with three geometry sources: the ground truth, the observed point cloud, and
points decoded by the encoder `field`, which is the Panda's. `pybullet` sets the joints, detects
collisions and reads the contacts; `in_collision` also clears old contacts first.

The last line is JSON.
"""

import argparse
import json
import os
import platform
import time
from dataclasses import replace
from functools import partial

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from tqdm import tqdm

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.geometry_source import find_geometry_source
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.files import load_scene
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.tasks import STATIC_TASKS, with_robot
from roboarm_nmp.utils.bullet import pybullet as p

CONTACT_RANGE = 0.01  # m
SCENES = 40  # of each distribution
NUDGES = 1000  # at most, per scene
SPEED_TASK = "random_boxes_hard"


def scenes_of(task, split):
    """Distinct scenes of a task's queries."""
    scenes = load_queries(task, split).scenes
    return list(dict.fromkeys(scenes[i] for i in range(len(load_queries(task, split)))))


def groups_of_panda():
    """Names of groups of scenes, with the scenes: of validation queries and original problems."""
    groups = [(task, "validation") for task in STATIC_TASKS]
    groups += [(task, "original") for task in STATIC_TASKS if task.startswith("benchmaker")]
    for task, split in groups:
        scenes = scenes_of(task, split)
        yield f"{task}, {split}", scenes[:SCENES] if split == "validation" else scenes


def groups_of(robot, files, rng):
    """Likewise for another arm."""
    for name, task in STATIC_TASKS.items():
        scene = with_robot(task.scene, robot)
        if isinstance(scene, Scene):
            yield f"the obstacles of {name}", [scene]
        else:
            yield name, [scene.sample(rng) for _ in range(SCENES)]
    for file in files:
        yield file, [replace(load_scene(file), robot=robot)]


def nudge(checker, states, rng):
    """Configurations (n, 7) moved to within `CONTACT_RANGE` of contact; fewer if lines miss it."""
    others = rng.uniform(-1.0, 1.0, states.shape)
    wanted = rng.uniform(-CONTACT_RANGE, CONTACT_RANGE, len(states))

    def beyond(shares):
        there = states + shares[:, None] * (others - states)
        return checker.signed_distances(there).distance.min(-1) - wanted

    low, high = np.zeros(len(states)), np.ones(len(states))
    below, above = beyond(low), beyond(high)
    crossing = np.sign(below) != np.sign(above)
    for _ in range(30):
        middle = (low + high) / 2
        same = np.sign(beyond(middle)) == np.sign(below)
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return (states + low[:, None] * (others - states))[crossing]


def pybullet_distance(env):
    """Smallest distance (m) that PyBullet reports after `in_collision`; NaN without contacts."""
    contacts = p.getContactPoints(bodyA=env.body, physicsClientId=env.client)
    return min((contact[8] for contact in contacts), default=np.nan)


def compare(env, scenes, num, rng, progress):
    """Number of configurations, `num` over all scenes, and depths (m) of the disagreements."""
    compared = 0
    depths = []
    joints = env.robot.num_joints
    shares = np.diff(np.linspace(0, num, len(scenes) + 1).round().astype(int))
    for scene, count in zip(scenes, shares.tolist(), strict=True):
        env.set_scene(scene)
        checker = CollisionChecker(scene)
        nudged = np.empty((0, joints))
        for _ in range(NUDGES):  # a line between two configurations may miss contact
            if len(nudged) == count // 3:
                break
            more = nudge(checker, rng.uniform(-1.0, 1.0, (count, joints)), rng)
            nudged = np.concatenate([nudged, more])[: count // 3]
        uniform = rng.uniform(-1.0, 1.0, (count - len(nudged), joints))
        states = np.concatenate([uniform, nudged])
        free = checker.is_free(states)
        for state, is_free in zip(states, free, strict=True):
            if env.in_collision(env.robot.denormalise(state)) == is_free:
                ours = abs(checker.signed_distances(state).distance.min())
                depths.append(float(np.nanmax([ours, abs(pybullet_distance(env))])))
        compared += count
        progress.update(count)
    return compared, depths


def pybullet_check(env, configuration):
    env.world.arm.set_configuration(configuration)
    p.performCollisionDetection(physicsClientId=env.client)
    contacts = p.getContactPoints(bodyA=env.body, physicsClientId=env.client)
    return any(contact[8] < 0.0 for contact in contacts)


def run(check, configurations):
    for configuration in configurations:
        check(configuration)


def timed(function, *arguments):
    began = time.process_time()
    function(*arguments)
    return time.process_time() - began


def speed(rounds, rng, robot):
    """Microseconds of processor time per configuration: dict name -> median over rounds."""
    env = envs.RoboArmEnv(Scene(robot=robot))
    batch = 10_000
    joints = robot.num_joints
    if robot == PANDA:
        scenes = scenes_of(SPEED_TASK, "validation")[:SCENES]
    else:
        distribution = with_robot(envs.get_task(SPEED_TASK).scene, robot)
        scenes = [distribution.sample(rng) for _ in range(SCENES)]
    checkers = [CollisionChecker(scene) for scene in scenes]
    middle = np.zeros(joints)
    checkers[0].is_free(middle)  # compiles
    checkers[0].signed_distances(middle)
    sources = ["ground_truth", "point_cloud"]
    if robot == PANDA:
        sources.append("field")
    per_source = {
        f"link_distances, {name}": [find_geometry_source(name)(scene) for scene in scenes]
        for name in sources
    }
    for source_checkers in per_source.values():
        source_checkers[0].link_distances(middle)
    names = "is_free", "signed_distances", *per_source, "pybullet", "in_collision"
    seconds = {name: [] for name in names}
    for _ in range(rounds):
        total = dict.fromkeys(seconds, 0.0)
        for i, (scene, checker) in enumerate(zip(scenes, checkers, strict=True)):
            states = rng.uniform(-1.0, 1.0, (batch, joints))
            total["is_free"] += timed(checker.is_free, states) / batch
            total["signed_distances"] += timed(checker.signed_distances, states[:500]) / 500
            free = states[:1000][checker.is_free(states[:1000])][:100]
            for name, source_checkers in per_source.items():
                seconds_of_all = timed(run, source_checkers[i].link_distances, free)
                total[name] += seconds_of_all / max(len(free), 1)
            env.set_scene(scene)
            configurations = env.robot.denormalise(states[:100]).tolist()
            total["pybullet"] += timed(run, partial(pybullet_check, env), configurations) / 100
            total["in_collision"] += timed(run, env.in_collision, configurations) / 100
        for name, value in total.items():
            seconds[name].append(value / len(scenes))
    env.close()
    return {name: 1e6 * float(np.median(values)) for name, values in seconds.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--robot", help="a robot's file (.urdf, .yaml); the Panda without")
    parser.add_argument("--scenes", nargs="*", default=[], help="scene files, with --robot")
    parser.add_argument("--num", type=int, default=100_000, help="configurations to compare")
    parser.add_argument("--rounds", type=int, default=5, help="of timing")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    if args.num < 1000 or args.rounds < 1 or args.seed < 0:
        parser.error("--num must be at least 1000, --rounds at least 1, --seed at least 0")
    if args.scenes and not args.robot:
        parser.error("--scenes goes with --robot")
    rng = np.random.default_rng(args.seed)
    robot = load_robot(args.robot) if args.robot else PANDA
    groups = list(groups_of(robot, args.scenes, rng) if args.robot else groups_of_panda())
    env = envs.RoboArmEnv(Scene(robot=robot))
    compared = 0
    depths = []
    print(f"{'scenes':42}{'configurations':>15}{'disagree':>10}{'deepest':>12}")
    with tqdm(total=args.num, unit=" configurations") as progress:
        for i, (name, scenes) in enumerate(groups):
            share = args.num * (i + 1) // len(groups) - args.num * i // len(groups)
            count, deep = compare(env, scenes, share, rng, progress)
            deepest = f"{1e3 * max(deep):.3f} mm" if deep else "-"
            progress.write(f"{name:42}{count:15,}{len(deep):10}{deepest:>12}")
            compared += count
            depths += deep
    env.close()
    micros = speed(args.rounds, rng, robot)
    print()
    for name, value in micros.items():
        print(f"{name:30}{value:10.2f} us")
    print()
    result = {
        "robot": robot.name,
        "configurations": compared,
        "disagreement": len(depths) / compared,
        "deepest_mm": 1e3 * max(depths, default=0.0),
        "checks_per_second": 1e6 / micros["is_free"],
        "ratio_to_pybullet": micros["pybullet"] / micros["is_free"],
        "ratio_to_in_collision": micros["in_collision"] / micros["is_free"],
        "signed_distances_per_second": 1e6 / micros["signed_distances"],
        "link_distances_us": micros["link_distances, ground_truth"],
        "link_distances_point_cloud_us": micros["link_distances, point_cloud"],
        "link_distances_field_us": micros.get("link_distances, field"),
        "python": platform.python_version(),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
