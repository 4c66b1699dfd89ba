"""Policies by name: non-learning baselines, and trained policies from their files.

    policy, arguments = find_policy("via-points")        # or a file, a folder, a pretrained name
    env = roboarm_nmp.make("wall", **arguments)
    begin = make_policy(policy, env)
    act, *_ = begin(0, load_queries("wall")[0])          # once, at the start of an episode
    action = act(observation)                            # at every step

A safety filter may be put around any policy (`policies.safety_filter`); a trained policy may
include one. Baselines: `policies.baselines`. Whole episodes: `evaluation.rollout`.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.goals import GOAL_TYPES
from roboarm_nmp.envs.robots.metadata import check_robot, robot_metadata
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.networks.network_file import Network, load_network
from roboarm_nmp.networks.untrusted import NetworkError
from roboarm_nmp.policies.baselines import (
    BASELINES,
    CHECKING,
    OMPL_PLANNERS,
    REPLANNING,
    TIME_LIMIT,
    TRIES,
    make_baseline,
    make_replanning,
)
from roboarm_nmp.policies.policy import BeginEpisode, EpisodePolicy, Method, Policy
from roboarm_nmp.policies.pose_goals import ConfigurationGoals
from roboarm_nmp.utils.names import suggest

if TYPE_CHECKING:  # Numba takes a while to import
    from roboarm_nmp.envs.perception.geometry_source import Unknown
    from roboarm_nmp.policies.safety_filter import SafetyFilter

# The arguments of an environment that a policy's metadata may contain. Tolerances and horizon are
# not among them: they define what a success is.
ENV_ARGUMENTS = (
    *("goal_type", "action_mode", "max_step", "velocities"),
    *("encoder", "num_points", "geometry_source", "link_distances", "append_link_distances"),
)
OUTPUTS = ("action", "next_recurrent_state")
"""Names of a policy network's outputs; the second one only of a recurrent policy."""
PRETRAINED = Path(__file__).parent / "pretrained"
MAX_RECURRENT_SIZE = 65_536  # numbers


class PolicyError(ValueError):
    """A policy that cannot be found or used; the message says why."""


def pretrained_policies() -> dict[str, Path]:
    """The trained policies that come with the project: dict of name -> path."""
    return {path.stem: path for path in sorted(PRETRAINED.glob("*.onnx"))}


def policy_file(name: str | Path) -> Path:
    """The path of a trained policy: of a file, a run's folder, or a name of `pretrained_policies`.

    Raises PolicyError if it is none of these.
    """
    path = Path(name)
    if path.is_dir():
        path = path / "policy.onnx"
    if path.exists():
        return path
    pretrained = pretrained_policies()
    if str(name) not in pretrained:
        otherwise = (
            f"expected {', '.join(BASELINES)}, a policy network, a folder with a policy.onnx "
            "in it, or a name that `roboarm policies` lists"
        )
        hint = suggest(name, [*BASELINES, *pretrained], otherwise)
        raise PolicyError(f"no such policy: {path}: {hint}")
    return pretrained[str(name)]


def find_policy(name: str | Path) -> tuple[str | Path, dict[str, Any]]:
    """The policy as `make_policy` takes it, and the arguments of `envs.make` it was trained with.

    Args:
        name: one of `BASELINES`, which have no arguments, or a name or path as for `policy_file`.

    Raises:
        PolicyError: there is no such policy, its file is not one, or OMPL is missing, which
            `planner` and `space-time` need.
    """
    if name in OMPL_PLANNERS:
        try:
            import ompl  # noqa: F401
        except ImportError as error:
            raise PolicyError(f"the policy {name} needs OMPL (docs/install.md): {error}") from error
    if name in BASELINES:
        return name, {}
    path = policy_file(name)
    return path, _load(path).env_arguments


def own_safety_filter(policy: str | Path | Policy | Method) -> "SafetyFilter | None":
    """The `policies.safety_filter.SafetyFilter` that a policy includes; None without one.

    `policy` as for `make_policy`. Raises PolicyError: its file cannot be used.
    """
    if not isinstance(policy, (str, Path)) or policy in BASELINES:
        return None
    return _load(policy).safety_filter


def filter_around(
    policy: str | Path | Policy | Method,
    safety_filter: "SafetyFilter | Literal[False] | None",
    replan: bool = False,
) -> "SafetyFilter | Literal[False] | None":
    """A safety filter as it acts around a policy: a policy that replans needs no escapes."""
    if safety_filter and (replan or policy == REPLANNING):
        return replace(safety_filter, escape=False)
    return safety_filter


def own_task(policy: str | Path | Policy | Method) -> str | None:
    """The task that a trained policy was trained on, a name or path; None for other policies.

    `policy` as for `make_policy`. Raises PolicyError: its file cannot be used.
    """
    if not isinstance(policy, (str, Path)) or policy in BASELINES:
        return None
    task = _load(policy).network.metadata.get("task")
    return task if isinstance(task, str) else None


def recurrent_size(policy: Any) -> int:
    """The size of a trained policy's recurrent state; 0 for none.

    Args:
        policy: a `networks.network_file.Network`, whose metadata may have `recurrent_size`, or a
            module that may have that attribute.

    Raises:
        PolicyError: it is no integer from 0 to `MAX_RECURRENT_SIZE`.
    """
    metadata = getattr(policy, "metadata", None)
    if metadata is None:
        size = getattr(policy, "recurrent_size", 0)
    else:
        size = metadata.get("recurrent_size", 0)
    if type(size) is not int or not 0 <= size <= MAX_RECURRENT_SIZE:
        raise PolicyError(
            f"a policy's recurrent state has 0 to {MAX_RECURRENT_SIZE:,} numbers, not {size!r}"
        )
    return size


def policy_metadata(
    task: str | Path,
    env_arguments: dict[str, Any],
    robot: Robot,
    safety_filter: "SafetyFilter | None",
) -> dict[str, Any]:
    """The metadata of a policy's network file (docs/reference/file_formats.md)."""
    metadata = {
        "kind": "policy",
        "task": str(task),
        "env": env_arguments,
        "joint_limits": [robot.lower.tolist(), robot.upper.tolist()],
        **robot_metadata(robot),
    }
    if safety_filter is not None:
        metadata["safety_filter"] = safety_filter.to_metadata()
    return metadata


def make_policy(
    policy: str | Path | Policy | Method,
    env: RoboArmEnv,
    seed: int = 0,
    tries: int = TRIES,
    time_limit: float = TIME_LIMIT,
    geometry_source: str | Path = "ground_truth",
    safety_filter: "SafetyFilter | Literal[False] | None" = None,
    replan: bool = False,
    search: bool = False,
    unknown: "Unknown | None" = None,
    verify_else: str | Path | None = None,
) -> BeginEpisode:
    """A policy in an environment: a function (query's number, `Query`) -> `EpisodePolicy`.

    It is called once per episode, before the environment's reset to the query: `planner` moves the
    arm.

    In an environment with the goal type `pose`, the goal is the pose of the query's goal. Baselines
    and policies for configurations then head for a configuration that inverse kinematics finds.

    Args:
        policy: one of `BASELINES`, the path of a policy network, a function from an observation to
            an action (n,), or a `Method`.
        env: the `RoboArmEnv` it will act in.
        seed: of random numbers, >= 0; each query has its own generator.
        tries: random configurations that `via-points` tries per query.
        time_limit: seconds that `planner` may search per query.
        geometry_source: where `via-points`, `planner` and `replanning` take the obstacles from:
            `ground_truth`, `point_cloud` or an encoder's name (`envs.perception.geometry_source`).
        safety_filter: a `policies.safety_filter.SafetyFilter` around the policy; None for the
            one that a trained policy includes, if any; False for none. In a static scene, one that
            a policy includes does not change a motion that was verified. The environment must have
            `link_distances`, whose geometry source is the filter's.
        replan: whenever the policy is stuck, follow a plan for a while
            (`policies.replanning.ReplanWhenStuck`); a safety filter then makes no escapes.
        search: a policy that draws paths searches for one where it can verify none
            (`policies.generative`).
        unknown: what space counts as that no sensor sees: `free` or `occupied`. None: for a policy
            that draws paths, occupied, and free only where it finds no path otherwise; for
            `planner` with the geometry source `point_cloud`, free.
        verify_else: a policy, one of `BASELINES` or a name or path. The motion of the first policy
            is then predicted in each static scene, and verified before the arm moves; where that
            fails, this one acts, to which `search` and `unknown` then apply (`policies.predicted`).

    Raises:
        PolicyError: the policy cannot act in this environment.
    """
    if verify_else is not None:
        return _verified(
            make_policy(
                policy, env, seed, tries, time_limit, geometry_source, safety_filter, replan
            ),
            make_policy(
                find_policy(verify_else)[0],
                *(env, seed, tries, time_limit, geometry_source),
                search=search,
                unknown=unknown,
            ),
            env,
            seed,
            searches=verify_else in CHECKING,
        )
    as_observed = None
    if isinstance(policy, Method):
        begin = policy.begin(env, seed)
    elif not isinstance(policy, (str, Path)):
        begin = lambda number, query: EpisodePolicy(policy)  # noqa: E731
    elif policy in BASELINES:
        try:
            begin = make_baseline(
                str(policy), env, seed, tries, time_limit, geometry_source, unknown
            )
        except ValueError as error:
            raise PolicyError(str(error)) from error
    else:
        begin, as_observed = _trained(policy, env, seed, search, unknown)
    own = own_safety_filter(policy)
    if safety_filter is None:
        safety_filter = own
    if replan:
        begin = _replanned(begin, env, seed, geometry_source)
    if safety_filter:
        around = filter_around(policy, safety_filter, replan)
        begin = _filtered(begin, env, seed, around, trust_verified=safety_filter == own)
    return begin if as_observed is None else _translated(begin, as_observed)


def _filtered(begin, env, seed, safety_filter, trust_verified):
    # Here, because Numba takes a while to import.
    from roboarm_nmp.policies.safety_filter import check_env

    try:
        check_env(env)
    except ValueError as error:
        raise PolicyError(str(error)) from error

    def begin_filtered(number, query):
        begun = begin(number, query)
        # The filter sees a coarser cloud than the one in which the motion was verified.
        verified = trust_verified and begun.plan_found and query.scene.is_static
        if begun.act is None or verified:
            return begun
        rng = np.random.default_rng([seed, number])
        return begun._replace(act=safety_filter.filter_policy(begun.act, env, rng))

    return begin_filtered


def _replanned(begin, env, seed, geometry_source):
    from roboarm_nmp.envs.perception.geometry_source import find_geometry_source
    from roboarm_nmp.policies.replanning import ReplanWhenStuck

    if env.action_mode != "relative":
        raise PolicyError(f"plans give displacements, not actions of mode {env.action_mode!r}")
    if env.goal_type == "pose":
        raise PolicyError("replan needs goals that are configurations, not poses")
    try:
        source = find_geometry_source(geometry_source, env.robot)
    except ValueError as error:
        raise PolicyError(str(error)) from error
    begin_replanning = make_replanning(env, seed, source)

    def begin_replanned(number, query):
        begun = begin(number, query)
        replanning = begin_replanning(number, query)
        if begun.act is None or replanning is None:
            return begun
        goal = env.robot.normalise(query.goal)
        return begun._replace(act=ReplanWhenStuck(begun.act, replanning, goal))

    return begin_replanned


def _verified(begin, otherwise, env, seed, searches):
    # Here, because Numba takes a while to import.
    from roboarm_nmp.policies.predicted import Predicted

    try:
        return Predicted(begin, otherwise, env, seed, searches)
    except ValueError as error:
        raise PolicyError(f"verify_else: {error}") from error


def _translated(begin, goals):
    """A policy for configurations in an environment of goal poses, by its `ConfigurationGoals`."""

    def begin_translated(number, query):
        if not goals.begin(query):
            return EpisodePolicy(None, plan_found=False)
        act, plan_found, _ = begin(number, query)
        return EpisodePolicy(lambda observation: act(goals(observation)), plan_found)

    return begin_translated


# --- Trained policies


class _TrainedPolicy(NamedTuple):
    """A policy network, and what its metadata say."""

    network: Network
    env_arguments: dict[str, Any]
    safety_filter: "SafetyFilter | None"
    recurrent_size: int


def _load(path: str | Path) -> _TrainedPolicy:
    from roboarm_nmp.policies.safety_filter import SafetyFilter

    try:
        network = load_network(path)
        safety_filter = SafetyFilter.from_metadata(network.metadata)
        size = recurrent_size(network)
    except NetworkError as error:
        raise PolicyError(str(error)) from error
    except ValueError as error:
        raise PolicyError(f"{path}: {error}") from error
    trained = network.metadata.get("env")
    if network.metadata.get("kind") != "policy" or not isinstance(trained, dict):
        raise PolicyError(f"{path}: a network, but not a policy")
    if trained.get("goal_type") not in GOAL_TYPES:
        raise PolicyError(f"{path}: does not say which goal type it was trained with")
    arguments = {name: trained[name] for name in ENV_ARGUMENTS if name in trained}
    return _TrainedPolicy(network, arguments, safety_filter, size)


def _trained(path, env, seed, search, unknown):
    """`make_policy` of a policy network, and its `ConfigurationGoals`, None if it needs none."""
    network, trained, _, size = _load(path)
    robot = env.unwrapped.robot
    try:
        check_robot(path, network.metadata, robot)
    except NetworkError as error:
        raise PolicyError(str(error)) from error
    mode = trained.get("action_mode", "relative")
    if mode != env.action_mode:
        raise PolicyError(
            f"{path}: its actions are of mode {mode!r}, not {env.action_mode!r}: make the "
            f"environment with action_mode={mode!r}"
        )

    if "paths" in network.metadata:
        # Here, because Numba takes a while to import.
        from roboarm_nmp.policies.generative import Generative

        try:
            return Generative(network, env, seed, search, unknown), None
        except NetworkError as error:
            raise PolicyError(f"{path}: {error}") from error
    if search or unknown is not None:
        raise PolicyError(f"{path}: search and unknown are for policies that draw paths")

    # One observation at a time: in a batch its last bits would depend on the batch's size, for a
    # gain of a tenth of the time at most.
    def predict(observation, recurrent_state) -> tuple[np.ndarray, np.ndarray]:
        if size:
            observation = observation | {"recurrent_state": recurrent_state}
            action, recurrent_state = network.predict_one(observation, robot.num_joints, size)
        else:
            [action] = network.predict_one(observation, robot.num_joints)
        return action, recurrent_state

    def begin(number, query):
        recurrent_state = np.zeros(size, np.float32)

        def act(observation):
            nonlocal recurrent_state
            action, recurrent_state = predict(observation, recurrent_state)
            return action

        return EpisodePolicy(act)

    example = {
        name: np.zeros(space.shape, np.float32) for name, space in env.observation_space.items()
    }
    as_observed = None
    if env.goal_type == "pose" and GOAL_TYPES[trained["goal_type"]].has_configuration:
        as_observed = ConfigurationGoals(env, trained["goal_type"])
        as_observed.begin_anywhere()
        example = as_observed(example)
    unknown = set(network.inputs) - set(example)
    if size:
        unknown -= {"recurrent_state"}
    if unknown:
        raise PolicyError(
            f"{path}: needs {', '.join(sorted(unknown))}, which is not observed: make the "
            f"environment with the arguments that it was trained with, `roboarm policies` has them"
        )
    for name, shape in network.inputs.items():
        if name in example and example[name].shape != shape[1:]:
            raise PolicyError(
                f"{path}: its input {name} has the shape {shape[1:]}, the environment's "
                f"observation {example[name].shape}"
            )
    try:
        predict(example, np.zeros(size, np.float32))  # to see whether that raises
    except NetworkError as error:
        raise PolicyError(str(error)) from error
    return begin, as_observed
