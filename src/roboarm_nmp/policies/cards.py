"""Model cards: what the pretrained policies and scene encoders are, and what was measured of them.

    policy_card("sac-ee-wall-p1-s1")["success_rate"]

A card joins a network's metadata with the JSON file beside it, which has the training's flags and,
of a policy, its result on test queries of its task. A policy is measured with the safety filter
that it includes, if any.
"""

import json
from typing import Any

from roboarm_nmp.envs.perception import encoders
from roboarm_nmp.envs.perception.point_clouds import NUM_POINTS, POINT_CLOUD
from roboarm_nmp.envs.perception.sensors import PointCloud, sensors_from_json
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.policies.registry import PolicyError, pretrained_policies
from roboarm_nmp.utils.names import suggest

RESULTS = (
    *("success_rate", "success_rate_interval", "collision_free_success_rate", "num_queries"),
    *("training_seconds", "date"),
)


def policy_card(name: str) -> dict[str, Any]:
    """What is known of a pretrained policy: a dict that fits into JSON.

    - `name`, `trainer`, `task`, `goal_type`;
    - `encoder`, `num_points` (of observed points), `link_distances`, `geometry_source`: what the
      policy observes of the scene; None or False for nothing;
    - `safety_filter`: dict of `margin` (m), `escape` and others, or None;
    - `success_rate`, its 95% Wilson interval `success_rate_interval`,
      `collision_free_success_rate`, `num_queries`: on test queries of its task;
    - `steps` and their `unit`, `training_seconds`, `date`, `args`: the training, and its flags.

    Raises:
        PolicyError: there is no such policy.
    """
    paths = pretrained_policies()
    if name not in paths:
        raise PolicyError(f"no such pretrained policy: {name}: {suggest(name, [*paths])}")
    metadata = load_network(paths[name]).metadata
    saved = json.loads(paths[name].with_suffix(".json").read_text())
    env = metadata["env"]
    encoder = env.get("encoder")
    return {
        "name": name,
        "trainer": metadata["script"],
        "task": metadata["task"],
        "goal_type": env["goal_type"],
        "encoder": encoder,
        "num_points": env.get("num_points", NUM_POINTS) if encoder == POINT_CLOUD else None,
        "link_distances": bool(env.get("link_distances")),
        "geometry_source": env.get("geometry_source"),
        "safety_filter": metadata.get("safety_filter"),
        **{key: saved[key] for key in RESULTS},
        "steps": metadata["step"],
        "unit": "environment steps" if "total_timesteps" in saved["args"] else "updates",
        "args": saved["args"],
    }


def observes(card: dict[str, Any]) -> str:
    """What a policy observes of the scene, in words."""
    encoder = card["encoder"]
    parts = []
    if encoder == POINT_CLOUD:
        parts.append(f"{card['num_points']} points")
    elif encoder == encoders.ORACLE:
        parts.append("ground-truth obstacles")
    elif encoder is not None:
        parts.append(f"latent code of {encoder}")
    if card["link_distances"]:
        parts.append("link distances")
    if not parts:
        return "nothing"
    source = f" from {card['geometry_source']}" if card["geometry_source"] else ""
    return " and ".join(parts) + source


def encoder_card(name: str) -> dict[str, Any]:
    """What is known of a pretrained scene encoder: a dict that fits into JSON.

    - `name`, `task` (the scenes it was trained on), `scenes` (their number);
    - `receives`: `images` or `point clouds`, of how many `sensors`;
    - `has_decoder`: whether obstacles can be decoded from its latent code;
    - `updates`, `training_seconds`, `date`, `args`: the training, and its flags.
    """
    path = encoders.PRETRAINED / f"{name}.onnx"
    metadata = load_network(path).metadata
    saved = json.loads(path.with_suffix(".json").read_text())
    sensors = sensors_from_json(metadata["sensors"]).values()
    clouds = all(isinstance(sensor, PointCloud) for sensor in sensors)
    return {
        "name": name,
        "task": metadata["task"],
        "scenes": saved["scenes"],
        "receives": "point clouds" if clouds else "images",
        "sensors": len(sensors),
        "has_decoder": path.with_name(name + encoders.DECODER).exists(),
        "updates": metadata["step"],
        "training_seconds": saved["seconds"],
        "date": saved["date"],
        "args": saved["args"],
    }
