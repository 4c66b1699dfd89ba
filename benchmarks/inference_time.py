"""How long policies think, beside RRT-Connect on the same queries (paper: "Prediction times").

    python benchmarks/inference_time.py POLICY ...       # runs' folders, or names (docs/results.md)
    python benchmarks/inference_time.py --num 200 sac-combined-vae-random_boxes_hard-p0.5-s1

Seconds on one core, means over the first test queries of `random_boxes_hard`: rendering what the
sensors see, and encoding it, once per episode; one action; all actions of an episode with the
encoding (the paper's total, without rendering). The scenes' cache is not used. Of RRT-Connect:
finding a path, within 5 s. Nothing else should run beside it. The last line is JSON.
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
from envs.encoders import ORACLE, SceneEncoder
from envs.exported_networks import load_network
from envs.policies import ENV_ARGUMENTS, policy_file

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "clean_rl_scripts"))
from evaluate import evaluate

TASK = "random_boxes_hard"


def policy_times(policy, queries):
    """Means (s) of `rendering`, `encoding`, `action`, `total`; and `success_rate`."""
    program = load_network(policy_file(policy))
    trained = program.metadata["env"]
    arguments = {name: trained[name] for name in ENV_ARGUMENTS if name in trained}
    env = envs.make(TASK, **arguments)
    sees = arguments.get("encoder") not in (None, ORACLE)
    encoder = SceneEncoder(arguments["encoder"]) if sees else None
    rows, actions, successes = [], 0, 0
    for query in tqdm(queries, desc=str(policy), unit="query"):
        rendering = encoding = acting = 0.0
        if encoder is not None:
            began = time.perf_counter()
            seen = encoder.look(query.scene)
            rendered = time.perf_counter()
            encoder.encode(seen)
            rendering, encoding = rendered - began, time.perf_counter() - rendered
        observation, info = env.reset_specific(*query)
        ended = info["is_success"]
        while not ended:
            began = time.perf_counter()
            inputs = {name: torch.from_numpy(observation[name])[None] for name in program.inputs}
            action = program(**inputs)[0].numpy()
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
    parser.add_argument("--time-limit", type=float, default=5.0, help="of RRT-Connect (5 s)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    queries = load_queries(TASK)
    queries = [queries[i] for i in range(min(args.num, len(queries)))]
    results = {policy: policy_times(policy, queries) for policy in args.policies}
    print(
        "| policy | rendering | encoding | an action | total | success |\n|---|---|---|---|---|---|"
    )
    for policy, result in results.items():
        numbers = " | ".join(f"{result[name]:.4f}" for name in list(result)[:4])
        print(f"| `{policy}` | {numbers} | {result['success_rate']:.3f} |", flush=True)
    planned = evaluate("planner", TASK, num_queries=len(queries), time_limit=args.time_limit)
    results["RRT-Connect"] = {name: planned[name] for name in ("planning_seconds", "success_rate")}
    seconds, success = results["RRT-Connect"].values()
    print(f"| RRT-Connect, {args.time_limit:g} s at most | | | | {seconds:.4f} | {success:.3f} |")
    print(json.dumps({"num_queries": len(queries)} | results))


if __name__ == "__main__":
    main()
