"""The result of an evaluation as text: a header with its settings, and a line per number."""

from roboarm_nmp.envs.arm_env import STANDARD_RULES
from roboarm_nmp.envs.robots.panda import PANDA


def report(result):
    """The text that `roboarm evaluate` prints of a result (dict) of `evaluation.evaluate`.

    docs/guide/evaluation.md describes its lines.
    """

    def row(name, value, unit="", interval=None):
        number = "-" if value is None else f"{value:.4g}" if unit else f"{value:.4f}"
        between = f"[{interval[0]:.4f}, {interval[1]:.4f}]" if interval else unit
        return f"  {name:<24}{number:>9}  {between}"

    count, split = f"{result['num_queries']:,}", result["split"]
    lines = [f"{result['policy']} on {result['task']}: {count} {split} queries"]
    if problems := result.get("problems"):
        lines = [f"{result['policy']} on {problems['file']}: {count} problems"]
    settings = _settings(result)
    lines += [f"  {name:<24}{value}" for name, value in settings.items() if value is not None]
    lines += [
        f"  not comparable: {name} is {value}, not {STANDARD_RULES[name]}"
        for name, value in result["deviations"].items()
    ]
    for label, name in (
        ("success", "success_rate"),
        ("collision-free success", "collision_free_success_rate"),
        ("collision", "collision_rate"),
    ):
        lines.append(row(label, result[name], interval=result[f"{name}_interval"]))
    lines += [
        row("mean steps", result["mean_steps"], "of successful episodes"),
        row("path length", result["path_length"], "rad"),
        row("smoothness", result["smoothness"], "rad/step^2"),
        row("end effector's path", result["ee_path_length"], "m"),
        row("duration", result["duration"], "s"),
        row("mean jerk", result["mean_jerk"], "rad/s^3"),
    ]
    if result["min_clearance"] is not None:
        lines.append(row("smallest clearance", result["min_clearance"], "m"))
    lines.append(row("time per action", result["ms_per_action"], "ms"))
    if result["planning_seconds"] is not None:
        lines += [
            row("planning time", result["planning_seconds"], "s"),
            row("  ... if found", result["planning_seconds_solved"], "s"),
        ]
    lines += [row("free motion", result["free_motion_rate"])] * (result["tries"] is not None)
    return "\n".join(lines)


def _settings(result):
    """What distinguishes this evaluation from others, in words; None where a policy lacks it."""
    from roboarm_nmp.envs.perception.point_clouds import NUM_POINTS

    env, safety_filter = result["env"], result["safety_filter"]
    encoder, margin = env.get("encoder") or "none", "none"
    if encoder == "point_cloud":
        encoder += f", {env.get('num_points', NUM_POINTS)} points"
    if safety_filter is not None:
        escape = "escapes local minima" if safety_filter["escape"] else "no escape"
        margin = f"margin {safety_filter['margin']:g} m, {escape}"
        margin += ", approach paths" * ("approach" in safety_filter)
        if "lookahead" in safety_filter:
            ahead = safety_filter["lookahead"]
            margin += ", no obstacle velocities" if ahead is None else f", {ahead:g} s ahead"
    limit, noise = result["time_limit"], result.get("sensor_noise", {})
    return {
        "robot": None if result["robot"] == PANDA.name else result["robot"],
        "queries": result["queries"],
        "goal type": result["goal_type"],
        "encoder": encoder,
        "geometry source": result["geometry_source"] or "none",
        "privileged": "yes" if result["privileged"] else None,
        "safety filter": margin,
        "replans": "when stuck" if result.get("replan") else None,
        "observed every": f"{result['observe_every']} steps" if "observe_every" in result else None,
        "sensor noise": ", ".join(f"{name} {value:g}" for name, value in noise.items()) or None,
        "time limit": None if limit is None else f"{limit:g} s per query",
        "tries": result["tries"],
        "action delay": _delay(result["action_delay"]),
        "seed": result["seed"],
    }


def _delay(steps):
    """The delay in words; None for none."""
    if steps == "real_time":
        return "real time: the steps that each action takes to compute"
    return f"{steps} steps" if steps else None
