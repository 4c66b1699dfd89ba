"""Environment steps per second on one core, against panda-gym and against bare PyBullet.

    pip install -c constraints.txt -e ".[bench]"
    python benchmarks/env_throughput.py

Three loops take turns in one process, block by block, so that a machine whose speed drifts slows
all of them; medians over the blocks are compared. Only steps are timed, resets are not.

- ours: `double_walls` with every collision on, made by `gymnasium.make`.
- panda-gym: `PandaReachJoints-v3`, random actions.
- bare loop: PyBullet alone in the same world, replaying the joint targets our env commanded on the
  same episodes: the same commands, physics steps, and reads of contacts, joints and end-effector.

Then, with 4 to 8 random boxes, what drawing a new scene adds to a reset: the mean over many, which
includes the worlds that are made anew now and then.

The last line is JSON.
"""

import argparse
import json
import os
import platform
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium
import numpy as np
import panda_gym  # noqa: F401  (registers PandaReachJoints-v3)
from tqdm import trange

from roboarm_nmp import envs
from roboarm_nmp.envs.robots.control import SUBSTEPS
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.utils.bullet import pybullet as p

EPISODE = 100  # steps


def make_episodes(env, number, rng):
    """Queries with actions that keep a random direction for 10 steps at a time."""
    episodes = []
    for _ in range(number):
        directions = rng.uniform(-1, 1, (EPISODE // 10, 7)).astype(np.float32)
        episodes.append((*env.sample_query(rng), directions.repeat(10, axis=0)))
    return episodes


def run_ours(env, episode):
    """Seconds for the steps of one episode."""
    start, goal, actions = episode
    env.unwrapped.reset_specific(start, goal)
    began = time.perf_counter()
    for action in actions:
        env.step(action)
    return time.perf_counter() - began


def run_panda_gym(env, actions):
    env.reset()
    began = time.perf_counter()
    for action in actions:
        env.step(action)
    return time.perf_counter() - began


def run_bare(env, start, targets):
    client, body = env.client, env.body
    env.world.arm.set_configuration(start)
    forces = PANDA.effort.tolist()
    began = time.perf_counter()
    for target in targets:
        p.setJointMotorControlArray(
            body,
            PANDA.joint_indices,
            p.POSITION_CONTROL,
            targetPositions=target,
            forces=forces,
            positionGains=PANDA.gains,
            physicsClientId=client,
        )
        for _ in range(SUBSTEPS):
            p.stepSimulation(physicsClientId=client)
            p.getContactPoints(bodyA=body, physicsClientId=client)
        p.getJointStates(body, PANDA.joint_indices, physicsClientId=client)
        p.getLinkState(
            body, PANDA.end_effector_link, computeForwardKinematics=1, physicsClientId=client
        )
    return time.perf_counter() - began


def record_targets(env, episode):
    """The joint targets that our env commands on an episode, and how well the arm follows them.

    Tracking: the share of a commanded displacement that the arm made, steps without contact.
    """
    start, goal, actions = episode
    targets, tracking = [], []
    command = env.world.arm.command
    env.world.arm.command = lambda target: (targets.append(target), command(target))
    try:
        env.reset_specific(start, goal)
        targets.clear()
        before = PANDA.normalise(start)
        for action in actions:
            observation, _, _, _, info = env.step(action)
            after = observation["observation"][:7].astype(np.float64)
            asked = PANDA.normalise(targets[-1]) - before
            if not info["collision"]:
                tracking.append((after - before) @ asked / (asked @ asked))
            before = after
    finally:
        del env.world.arm.command
    return targets, tracking


def seconds_per_scene(number, rng):
    """Mean seconds for drawing a scene of `random_boxes_hard` and putting the arm into it."""
    env = envs.make("random_boxes_hard")
    seconds = 0.0
    for _ in trange(number, unit="scene"):
        began = time.perf_counter()
        env.sample_scene(rng)
        seconds += time.perf_counter() - began
        env.sample_query(rng)
    env.close()
    return seconds / number


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--blocks", type=int, default=60, help="blocks of 100 steps per loop")
    parser.add_argument("--scenes", type=int, default=2000, help="random scenes")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)

    ours = gymnasium.make(envs.gymnasium_id("double_walls"))
    ours.reset(seed=args.seed)
    bare = envs.make("double_walls")
    peer = gymnasium.make("PandaReachJoints-v3")
    peer.reset(seed=args.seed)
    peer.action_space.seed(args.seed)

    episodes = make_episodes(bare, args.blocks, rng)
    seconds = {"ours": [], "panda-gym": [], "bare loop": []}
    resets, tracking = [], []
    for i in trange(args.blocks, unit="block"):
        targets, block_tracking = record_targets(bare, episodes[i])
        tracking += block_tracking
        peer_actions = [peer.action_space.sample() for _ in range(EPISODE)]
        seconds["ours"].append(run_ours(ours, episodes[i]))
        seconds["panda-gym"].append(run_panda_gym(peer, peer_actions))
        seconds["bare loop"].append(run_bare(bare, episodes[i][0], targets))
        began = time.perf_counter()
        ours.reset(seed=i)
        resets.append(time.perf_counter() - began)

    scene = seconds_per_scene(args.scenes, rng)

    per_second = {name: EPISODE / np.median(times) for name, times in seconds.items()}
    print(f"\n{'loop':12}{'env steps/s':>14}{'ours / loop':>14}")
    for name, rate in per_second.items():
        print(f"{name:12}{rate:14.0f}{per_second['ours'] / rate:14.2f}")
    print(f"\nreset to a random feasible query: {1e3 * np.median(resets):.2f} ms (median)")
    print(f"a new random scene adds to that: {1e3 * scene:.2f} ms (mean)")
    percentiles = np.percentile(tracking, [5, 50, 95])
    print(
        "share of a commanded displacement made in one step, away from contacts: "
        f"median {percentiles[1]:.3f}, 5 to 95 % {percentiles[0]:.3f} to {percentiles[2]:.3f}\n"
    )
    result = {
        "env_steps_per_second": per_second["ours"],
        "ratio_to_panda_gym": per_second["ours"] / per_second["panda-gym"],
        "ratio_to_bare_loop": per_second["ours"] / per_second["bare loop"],
        "reset_ms": 1e3 * float(np.median(resets)),
        "new_scene_ms": 1e3 * scene,
        "tracking_median": percentiles[1],
        "blocks": args.blocks,
        "python": platform.python_version(),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
