"""How long policies think, beside RRT-Connect on the same queries (paper: "Prediction times").

    python benchmarks/inference_time.py POLICY ...       # runs' folders, or names (docs/results.md)
    python benchmarks/inference_time.py --num 200 sac-combined-vae-random_boxes_hard-p0.5-s1

Seconds on one core, means over the first test queries of `random_boxes_hard`: rendering what the
sensors see, and encoding it, once per episode; one action; all actions of an episode with the
encoding (the paper's total, without rendering). The scenes' cache is not used. With `--encoder`
what points tell a policy comes from that encoder's z_E. Encoding includes thinning points, asking a
decoder, and what distances need; an action includes distances, and a last layer. Of planning, with
the true obstacles, with what is seen, and with what the encoder tells: finding a path, within 5 s,
and looking before. Nothing else should run beside it. The last line is JSON.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from tqdm import tqdm

import envs
from envs.datasets import load_queries
from envs.encoders import ORACLE, scene_encoder, with_told
from envs.policies import find_policy, make_policy
from envs.seeing import checker_of, seen_points

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "clean_rl_scripts"))
from evaluate import evaluate

TASK = "random_boxes_hard"


def seeing_times(env, scene):
    """`rendering` and `encoding` (s) of a scene that was not seen before."""
    encoder, encoding = env.encoder, 0.0
    if encoder.name == ORACLE:
        return 0.0, 0.0
    began = time.perf_counter()
    if encoder.path is None and encoder.proximity == "points":
        seen_points(scene)
        rendering = time.perf_counter() - began
    else:
        network = encoder if encoder.path else scene_encoder(encoder.proximity)
        seen = network.look(scene)
        rendering = time.perf_counter() - began
        network.encode(seen)
        encoding = time.perf_counter() - began - rendering
        network(scene)  # which it remembers, so that it does not count below
    began = time.perf_counter()
    encoder(scene)
    if "proximity" in env.observation_space.spaces:
        checker_of(encoder.proximity)(scene)
    return rendering, encoding + time.perf_counter() - began


def policy_times(policy, queries, encoder=None):
    """Means (s) of `rendering`, `encoding`, `action`, `total`; and `success_rate`."""
    name, arguments = find_policy(policy)
    if encoder is not None:
        arguments = with_told(encoder, arguments)
    env = envs.make(TASK, **arguments)
    begin = make_policy(name, env)
    rows, actions, successes = [], 0, 0
    sees = arguments.get("encoder") is not None
    for number, query in enumerate(tqdm(queries, desc=str(policy), unit="query")):
        rendering, encoding = seeing_times(env, query.scene) if sees else (0.0, 0.0)
        act, acting = begin(number, query).act, 0.0
        observation, info = env.reset_specific(*query)
        ended = info["is_success"]
        while not ended:
            began = time.perf_counter()
            action = act(observation)
            if "proximity" in observation:  # which the environment has computed
                env.proximity_at(observation["observation"][:7])
            acting += time.perf_counter() - began
            actions += 1
            observation, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
        successes += info["is_success"]
        rows.append((rendering, encoding, acting))
    env.close()
    rendering, encoding, acting = np.mean(rows, axis=0)
    return {
        "rendering": rendering,
        "encoding": encoding,
        "action": acting * len(rows) / max(1, actions),
        "total": encoding + acting,
        "success_rate": successes / len(rows),
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
    results = {policy: policy_times(policy, queries) for policy in args.policies}
    for policy in args.policies:
        knows = find_policy(policy)[1]
        if args.encoder is not None and knows.get("proximity") == "points":
            times = policy_times(policy, queries, args.encoder)
            results[f"{policy}, {args.encoder}"] = times
    print(
        "| policy | rendering | encoding | an action | total | success |\n|---|---|---|---|---|---|"
    )
    for policy, result in results.items():
        numbers = " | ".join(f"{result[name]:.4f}" for name in list(result)[:4])
        print(f"| `{policy}` | {numbers} | {result['success_rate']:.3f} |", flush=True)
    limit = {"num_queries": len(queries), "time_limit": args.time_limit}
    for knows in (None, "points", *([args.encoder] if args.encoder else [])):
        planned = evaluate("planner", TASK, encoder=knows, **limit)
        name = "RRT-Connect" if knows is None else f"RRT-Connect, {knows}"
        results[name] = {key: planned[key] for key in ("planning_seconds", "success_rate")}
        seconds, success = results[name].values()
        print(f"| {name}, {args.time_limit:g} s at most | | | | {seconds:.4f} | {success:.3f} |")
    print(json.dumps({"num_queries": len(queries)} | results))


if __name__ == "__main__":
    main()
