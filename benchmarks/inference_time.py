"""How long policies take, beside RRT-Connect on the same queries (paper: "Prediction times").

    python benchmarks/inference_time.py POLICY ...  # runs' folders, or names of pretrained policies
    python benchmarks/inference_time.py --num 200 bc-combined-vae-random_boxes_hard-s1

Seconds on one core, means over the first test queries of `random_boxes_hard`: rendering the
sensors' images, and encoding them, once per episode; finding a path, within 5 s, for planners; one
action; all of an episode but rendering (the paper's total). Queries share scenes, but nothing
observed for one query serves another. With `--geometry-source`, policies with point clouds are
timed with points decoded from that encoder's latent code, too. Encoding includes thinning points,
decoding, and what distances need; an action includes link distances, and a safety filter. RRT-
Connect uses ground truth, observed points, and decoded points. Nothing else should run beside it.
The last line is JSON.
"""

import argparse
import json
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from tqdm import tqdm

import roboarm_nmp
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.perception import geometry_source, point_clouds
from roboarm_nmp.envs.perception.encoders import NetworkEncoder, make_encoder
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.policies.registry import find_policy, make_policy

TASK = "random_boxes_hard"
SHOWN = ("rendering", "encoding", "planning", "action", "total")


def forget(networks):
    """Empty all caches of scenes, those of these encoders, too."""
    for cached in (
        point_clouds._clouds,
        point_clouds._observe,
        geometry_source.observed_checker,
        geometry_source.fine_observed_checker,
        geometry_source.ground_truth_checker,
        geometry_source.decoded_checker,
    ):
        cached.cache_clear()
    for network in networks:
        network._cached.cache_clear()
        network._decoded.cache_clear()


def observing_times(encoder, source, scene):
    """`rendering` and `encoding` (s) of a scene that was not observed before.

    Args:
        encoder: the policy's encoder, or None.
        source: the geometry source of link distances or of a planner, or None.
        scene: the `Scene`.
    """
    if encoder is None and source is None:
        return 0.0, 0.0
    sources = {source} - {None, "ground_truth"}
    if encoder is not None:
        name = encoder.name if isinstance(encoder, NetworkEncoder) else encoder.geometry_source
        sources |= {name} - {"ground_truth"}
    networks = [make_encoder(name) for name in sorted(sources - {"point_cloud"})]
    forget(networks)
    began = time.perf_counter()
    if "point_cloud" in sources:
        point_clouds.observed_points(scene)
    observed = [network.observe(scene) for network in networks]
    rendering = time.perf_counter() - began if sources else 0.0
    for network, inputs in zip(networks, observed, strict=True):
        network.encode(inputs)
    encoding = time.perf_counter() - began - rendering
    for network in networks:
        network(scene)  # cached, so that it does not count below
    began = time.perf_counter()
    if encoder is not None:
        encoder(scene)
    if source is not None:
        geometry_source.find_geometry_source(source)(scene)
    return rendering, encoding + time.perf_counter() - began


def times(policy, queries, source=None, time_limit=5.0):
    """Means (s) of what is `SHOWN`, and `success_rate`.

    Args:
        policy: as `policies.registry.find_policy` takes it.
        queries: list of `Query`.
        source: geometry source of a planner, or instead of a policy's own; None for that,
            otherwise `ground_truth`.
        time_limit: s, of a planner.
    """
    found, arguments = find_policy(policy)
    is_planner, arguments = policy == "planner", arguments or {}
    if source is not None and not is_planner:
        arguments = arguments | {"geometry_source": source}
    env = roboarm_nmp.make(TASK, **arguments)
    begin = make_policy(found, env, time_limit=time_limit, geometry_source=source or "ground_truth")
    if is_planner:
        source = source or "ground_truth"
    else:
        source = arguments["geometry_source"] if arguments.get("link_distances") else None
    encoder = env.encoder if arguments.get("encoder") else None

    def episode(number, query):
        rendering, encoding = observing_times(encoder, source, query.scene)
        began = time.perf_counter()
        act = begin(number, query).act  # None: no path was found
        planning = time.perf_counter() - began

        def act_and_sense(observation):
            if "link_distances" in observation:  # which the environment has computed
                env.link_distances_at(observation["observation"][:7])
            return act(observation)

        trajectory = rollout(env, query, act and act_and_sense)
        acting = trajectory.times.sum()
        return rendering, encoding, planning, acting, len(trajectory), trajectory.success

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
    parser.add_argument("--geometry-source", help="an encoder with a decoder, e.g. field")
    parser.add_argument("--time-limit", type=float, default=5.0, help="of RRT-Connect (5 s)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    queries = load_queries(TASK)
    queries = [queries[i] for i in range(min(args.num, len(queries)))]
    jobs = {policy: (policy, None) for policy in args.policies}
    source = args.geometry_source
    for policy in args.policies:
        if source and find_policy(policy)[1].get("geometry_source") == "point_cloud":
            jobs[f"{policy}, {source}"] = policy, source
    for name in (None, "point_cloud", *([source] if source else [])):
        jobs["RRT-Connect" if name is None else f"RRT-Connect, {name}"] = "planner", name
    results = {}
    print(f"| policy | {' | '.join(SHOWN)} | success |\n{'|---' * (2 + len(SHOWN))}|")
    for name, (policy, source) in jobs.items():
        results[name] = result = times(policy, queries, source, args.time_limit)
        numbers = " | ".join(f"{result[name]:.4f}" for name in SHOWN)
        print(f"| `{name}` | {numbers} | {result['success_rate']:.3f} |", flush=True)
    print(json.dumps({"num_queries": len(queries), "time_limit": args.time_limit} | results))


if __name__ == "__main__":
    main()
