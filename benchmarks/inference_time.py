"""How long policies think, beside RRT-Connect on the same queries (paper: "Prediction times").

    python benchmarks/inference_time.py POLICY ...       # runs' folders, or names (docs/results.md)
    python benchmarks/inference_time.py --num 200 bc-combined-vae-random_boxes_hard-s1

Seconds on one core, means over the first test queries of `random_boxes_hard`: rendering what the
sensors see, and encoding it, once per episode; finding a path, within 5 s, for those that search;
one action; all of an episode but rendering (the paper's total). Queries share scenes, but nothing
that was seen for one serves another. With `--encoder` what points tell a policy comes from that
encoder's z_E, too. Encoding includes thinning points, asking a decoder, and what distances need; an
action includes distances, and a last layer. RRT-Connect knows the true obstacles, what is seen, and
what the encoder tells. Nothing else should run beside it. The last line is JSON.
"""

import argparse
import json
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from tqdm import tqdm

from roboarm_nmp import envs
from roboarm_nmp.envs.datasets.queries import load_queries
from roboarm_nmp.envs.perception import encoders
from roboarm_nmp.envs.perception import point_clouds as seeing
from roboarm_nmp.envs.perception.encoders import scene_encoder, with_decoded
from roboarm_nmp.envs.perception.point_clouds import geometry_source, observed_points
from roboarm_nmp.envs.policies.registry import find_policy, make_policy

TASK = "random_boxes_hard"
SHOWN = ("rendering", "encoding", "planning", "action", "total")


def forget(names):
    """Forget all scenes that were seen; `names` of encoders."""
    checkers = seeing.observed_checker, seeing.ground_truth_checker, encoders.decoded_checker
    for cached in (seeing._look, encoders.decoded_points, *checkers):
        cached.cache_clear()
    for name in names:
        scene_encoder(name)._cached.cache_clear()


def seeing_times(encoder, near, scene):
    """`rendering` and `encoding` (s) of a scene that was not seen before.

    Args:
        encoder: the policy's `SceneEncoder`, or None.
        near: what distances are from, as `envs.make(link_distances=...)` takes it, or None.
        scene: the `Scene`.
    """
    if encoder is None and near is None:
        return 0.0, 0.0
    tells = None if encoder is None else encoder.name if encoder.path else encoder.link_distances
    sources = {near, tells} - {None, "obstacles"}
    networks = {name: scene_encoder(name) for name in sources - {"points"}}
    forget(networks)
    began = time.perf_counter()
    if "points" in sources:
        observed_points(scene)
    seen = {name: network.look(scene) for name, network in networks.items()}
    rendering = time.perf_counter() - began if sources else 0.0
    for name, network in networks.items():
        network.encode(seen[name])
    encoding = time.perf_counter() - began - rendering
    for network in networks.values():
        network(scene)  # which it remembers, so that it does not count below
    began = time.perf_counter()
    if encoder is not None:
        encoder(scene)
    if near is not None:
        geometry_source(near)(scene)
    return rendering, encoding + time.perf_counter() - began


def times(policy, queries, encoder=None, time_limit=5.0):
    """Means (s) of what is `SHOWN`, and `success_rate`.

    Args:
        policy: as `envs.policies.registry.find_policy` takes it.
        queries: list of `Query`.
        encoder: what tells a policy of points; what a planner knows instead of the true obstacles.
        time_limit: s, of a planner.
    """
    found, arguments = find_policy(policy)
    searches, arguments = policy == "planner", arguments or {}
    if encoder is not None and not searches:
        arguments = with_decoded(encoder, arguments)
    env = envs.make(TASK, **arguments)
    begin = make_policy(found, env, time_limit=time_limit, encoder=encoder if searches else None)
    near = encoder or "obstacles" if searches else arguments.get("link_distances")
    seen_by = env.encoder if arguments.get("encoder") else None

    def episode(number, query):
        rendering, encoding = seeing_times(seen_by, near, query.scene)
        began = time.perf_counter()
        act = begin(number, query).act  # None: no path was found
        planning, acting, actions = time.perf_counter() - began, 0.0, 0
        observation, info = env.reset_specific(*query)
        ended = info["is_success"] or act is None
        while not ended:
            began = time.perf_counter()
            action = act(observation)
            if "link_distances" in observation:  # which the environment has computed
                env.link_distances_at(observation["observation"][:7])
            acting += time.perf_counter() - began
            actions += 1
            observation, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
        return rendering, encoding, planning, acting, actions, info["is_success"]

    episode(0, queries[0])  # loads compiled code, which does not count
    rows = [episode(*one) for one in enumerate(tqdm(queries, desc=str(policy), unit="query"))]
    env.close()
    rendering, encoding, planning, acting, actions, successes = np.mean(rows, axis=0)
    return {
        "rendering": rendering,
        "encoding": encoding,
        "planning": planning,
        "action": acting / actions if actions else 0.0,
        "total": encoding + planning + acting,
        "success_rate": successes,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("policies", nargs="*", metavar="POLICY")
    parser.add_argument("--num", type=int, default=1000, help="queries (1,000, as in the paper)")
    parser.add_argument("--encoder", help="with a decoder, e.g. field")
    parser.add_argument("--time-limit", type=float, default=5.0, help="of RRT-Connect (5 s)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    queries = load_queries(TASK)
    queries = [queries[i] for i in range(min(args.num, len(queries)))]
    jobs = {policy: (policy, None) for policy in args.policies}
    for policy in args.policies:
        if args.encoder is not None and find_policy(policy)[1].get("link_distances") == "points":
            jobs[f"{policy}, {args.encoder}"] = policy, args.encoder
    for knows in (None, "points", *([args.encoder] if args.encoder else [])):
        jobs["RRT-Connect" if knows is None else f"RRT-Connect, {knows}"] = "planner", knows
    results = {}
    print(f"| policy | {' | '.join(SHOWN)} | success |\n{'|---' * (2 + len(SHOWN))}|")
    for name, (policy, knows) in jobs.items():
        results[name] = result = times(policy, queries, knows, args.time_limit)
        numbers = " | ".join(f"{result[name]:.4f}" for name in SHOWN)
        print(f"| `{name}` | {numbers} | {result['success_rate']:.3f} |", flush=True)
    print(json.dumps({"num_queries": len(queries), "time_limit": args.time_limit} | results))


if __name__ == "__main__":
    main()
