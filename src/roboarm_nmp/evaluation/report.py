"""The result of an evaluation as text: a header with its settings, and a line per number."""

from typing import Any

from roboarm_nmp.envs.arm_env import STANDARD_RULES
from roboarm_nmp.envs.robots.panda import PANDA

NUMBERS = (
    ("mean steps", "mean_steps", "of successful episodes"),
    ("path length", "path_length", "rad"),
    ("smoothness", "smoothness", "rad/step^2"),
    ("end effector's path", "ee_path_length", "m"),
    ("duration", "duration", "s"),
    ("mean jerk", "mean_jerk", "rad/s^3"),
    ("smallest clearance", "min_clearance", "m"),
    ("time per action", "ms_per_action", "ms"),
    ("planning time", "planning_seconds", "s"),
    ("  ... if found", "planning_seconds_solved", "s"),
)
"""Lines of the text: label, name in the result, and unit."""


def report(result: dict[str, Any]) -> str:
    """The text that `roboarm evaluate` prints of a result (dict) of `evaluation.evaluate`.

    docs/guide/evaluation.md describes its lines.
    """
    count = f"{result['num_queries']:,}"
    lines = [f"{result['policy']} on {result['task']}: {count} {result['split']} queries"]
    if problems := result.get("problems"):
        lines = [f"{result['policy']} on {problems['file']}: {count} problems"]
    for name, value in _settings(result).items():
        if value is not None:
            lines.append(f"  {name:<24}{value}")
    for name, value in result["deviations"].items():
        lines.append(f"  not comparable: {name} is {value}, not {STANDARD_RULES[name]}")
    for label, name in (
        ("success", "success_rate"),
        ("collision-free success", "collision_free_success_rate"),
        ("collision", "collision_rate"),
    ):
        low, high = result[f"{name}_interval"]
        lines.append(f"  {label:<24}{result[name]:>9.4f}  [{low:.4f}, {high:.4f}]")
    for label, name, unit in NUMBERS:
        if name.startswith("planning") and result["planning_seconds"] is None:
            continue
        value = result[name]
        if name == "min_clearance" and value is None:
            continue
        number = "-" if value is None else f"{value:.4g}"
        lines.append(f"  {label:<24}{number:>9}  {unit}")
    for label, name in (
        ("motion in unseen space", "unobserved_share"),
        ("free motion", "free_motion_rate"),
        ("path verified", "verified_rate"),
        ("  ... by search", "search_rate"),
    ):
        if result.get(name) is not None:
            lines.append(f"  {label:<24}{result[name]:>9.4f}  ")
    return "\n".join(lines)


def _settings(result):
    """What distinguishes this evaluation from others, in words; None where a policy lacks it."""
    from roboarm_nmp.envs.perception.point_clouds import NUM_POINTS

    env = result["env"]
    encoder = env.get("encoder") or "none"
    if encoder == "point_cloud":
        encoder += f", {env.get('num_points', NUM_POINTS)} points"
    noise = result.get("sensor_noise", {})
    observe_every = result.get("observe_every")
    limit = result["time_limit"]
    return {
        "robot": None if result["robot"] == PANDA.name else result["robot"],
        "queries": result["queries"],
        "goal type": result["goal_type"],
        "encoder": encoder,
        "geometry source": result["geometry_source"] or "none",
        "privileged": "yes" if result["privileged"] else None,
        "safety filter": _safety_filter(result["safety_filter"]),
        "replans": "when stuck" if result.get("replan") else None,
        "searches": "where no path is verified" if result.get("search") else None,
        "verified, else": result.get("verify_else"),
        "observed every": f"{observe_every} steps" if observe_every else None,
        "sensor noise": ", ".join(f"{name} {value:g}" for name, value in noise.items()) or None,
        "time limit": None if limit is None else f"{limit:g} s per query",
        "tries": result["tries"],
        "action delay": _delay(result["action_delay"]),
        "seed": result["seed"],
    }


def _safety_filter(options):
    """The filter's options in words."""
    if options is None:
        return "none"
    words = [f"margin {options['margin']:g} m"]
    words.append("escapes local minima" if options["escape"] else "no escape")
    if options.get("approach"):
        words.append("approach paths")
    if "lookahead" in options:
        ahead = options["lookahead"]
        words.append("no obstacle velocities" if ahead is None else f"{ahead:g} s ahead")
    return ", ".join(words)


def _delay(steps):
    """The delay in words; None for none."""
    if steps == "real_time":
        return "real time: the steps that each action takes to compute"
    return f"{steps} steps" if steps else None
