"""Policies by name: those that learn nothing, and trained ones from their files.

    policy, arguments = find_policy("via-points")        # or a file, a run's folder, a pretrained name
    env = envs.make("wall", **arguments)
    begin = make_policy(policy, env)
    act, found = begin(0, load_queries("wall")[0])       # at the start of an episode, once
    action = act(observation)                            # at every step

- go-to-goal: straight to the goal configuration, whatever is in the way (paper, section 5.1);
- random: a random action at every step;
- via-points: straight to the goal configuration if that motion is free of collisions, or else by
  way of the first of some random configurations for which the motion is free; if there is none,
  straight all the same;
- planner: OMPL's RRT-Connect plans, within a time limit, and the plan is followed.

The last two know the true obstacles, or only the points that sensors see of them. CircularConv any of
them there may be a last layer, which keeps the arm away from things (`envs.policies.safety_filter`); a trained
policy may have one of its own.
"""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from roboarm_nmp.envs import panda
from roboarm_nmp.envs.subgoals import subgoals

PLANNING = ("via-points", "planner")
"""The policies that look for a motion before they move."""
BASELINES = ("go-to-goal", "random", *PLANNING)
DISPLACING = ("go-to-goal", *PLANNING)
# What a policy's metadata may say about its environment. Tolerances and horizon are not among it:
# they decide what a success is.
ENV_ARGUMENTS = (
    *("goal_type", "action_mode", "max_step", "velocities"),
    *("encoder", "num_points", "geometry_source", "link_distances", "append_link_distances"),
)
PRETRAINED = Path(__file__).parent / "pretrained"
TRIES = 16  # of `via-points`, by default
TIME_LIMIT = 5.0  # s, of `planner`, by default
MAX_RECURRENT_SIZE = 65_536  # numbers


class PolicyError(ValueError):
    """A policy that cannot be had or used; the message says why."""


class EpisodePolicy(NamedTuple):
    """What a policy does in one episode.

    act: act(observation) -> action (7,); None: it gives up.
    found: whether it found a motion; None if it did not look for one.
    """

    act: Callable | None
    found: bool | None = None


def pretrained_policies():
    """The trained policies that come with the project: dict of name -> path."""
    return {path.stem: path for path in sorted(PRETRAINED.glob("*.pt"))}


def policy_file(name):
    """The path of a trained policy: of a file, a run's folder, or a name of `pretrained_policies`.

    Raises PolicyError if it is none of these.
    """
    path = Path(name)
    if path.is_dir():
        path = path / "policy.pt"
    if path.exists():
        return path
    pretrained = pretrained_policies()
    if str(name) not in pretrained:
        raise PolicyError(
            f"no such policy: {path} (expected {', '.join(BASELINES)}, a policy network, a folder "
            f"with a policy.pt in it, or a name: {', '.join(pretrained) or 'there are none'})"
        )
    return pretrained[str(name)]


def find_policy(name):
    """What `make_policy` takes, and the arguments of `envs.make` that it was trained with.

    Args:
        name: one of `BASELINES`, which have no arguments, or what `policy_file` takes.

    Raises:
        PolicyError: there is no such policy, its file is not one, or `planner` lacks OMPL.
    """
    if name == "planner":
        _import_planning()
    if name in BASELINES:
        return name, {}
    path = policy_file(name)
    return path, _load(path)[1]


def own_safety_filter(policy):
    """The `envs.policies.safety_filter.SafetyFilter` that is part of a policy; None if it has none.

    `policy` as for `make_policy`. Raises PolicyError: its file cannot be used.
    """
    return None if callable(policy) or policy in BASELINES else _load(policy)[2]


def recurrent_size(policy):
    """The size of a trained policy's recurrent state; 0 for none.

    Args:
        policy: an exported network, whose metadata may have `recurrent_size`, or a module that may
            have that attribute. How it is called: `envs.networks.exported_networks`.

    Raises:
        PolicyError: it is no integer from 0 to `MAX_RECURRENT_SIZE`.
    """
    metadata = getattr(policy, "metadata", None)
    size = (
        getattr(policy, "recurrent_size", 0)
        if metadata is None
        else metadata.get("recurrent_size", 0)
    )
    if type(size) is not int or not 0 <= size <= MAX_RECURRENT_SIZE:
        raise PolicyError(
            f"a policy's recurrent state has 0 to {MAX_RECURRENT_SIZE:,} numbers, not {size!r}"
        )
    return size


def make_policy(
    policy,
    env,
    seed=0,
    tries=TRIES,
    time_limit=TIME_LIMIT,
    geometry_source=None,
    safety_filter=None,
):
    """A policy in an environment: a function (query's number, `Query`) -> `EpisodePolicy`.

    It is called once per episode, before the environment is put to the start: `planner` moves
    the arm.

    Args:
        policy: one of `BASELINES`, the path of a policy network, or a function from an observation
            to an action (7,).
        env: the `RoboArmEnv` it will act in.
        seed: of what is random; each query has its own generator.
        tries: random configurations that `via-points` tries per query.
        time_limit: seconds that `planner` may search per query.
        geometry_source: of `via-points` and `planner`: `ground_truth`, `point_cloud` or an
            encoder's name (`envs.perception.geometry_source`); None for `ground_truth`.
        safety_filter: an `envs.policies.safety_filter.SafetyFilter` around the policy; None: the one that is part of
            a trained policy, if it has one; False: none. With one, the environment must have
            `link_distances`.

    Raises:
        PolicyError: the policy cannot act in this environment.
    """
    begin = _make_policy(policy, env, seed, tries, time_limit, geometry_source)
    if safety_filter is None:
        safety_filter = own_safety_filter(policy)
    if not safety_filter:
        return begin
    from roboarm_nmp.envs.policies.safety_filter import (
        check_env,  # here, because Numba takes a while to import
    )

    try:
        check_env(env)
    except ValueError as error:
        raise PolicyError(str(error)) from error

    def begin_safely(number, query):
        act, found = begin(number, query)
        rng = np.random.default_rng([seed, number])
        return EpisodePolicy(act and safety_filter.around(act, env, rng), found)

    return begin_safely


def _make_policy(policy, env, seed, tries, time_limit, geometry_source):
    if policy in DISPLACING and env.action_mode != "relative":
        raise PolicyError(f"{policy} gives displacements, not actions of mode {env.action_mode!r}")
    if policy == "go-to-goal":
        return lambda number, query: EpisodePolicy(_go_to_goal(query.goal))
    if policy == "random":
        return lambda number, query: EpisodePolicy(_random(np.random.default_rng([seed, number])))
    if policy == "via-points":
        return _via_points(seed, tries, _checker_source(geometry_source))
    if policy == "planner":
        return _planner(env, seed, time_limit, _checker_source(geometry_source))
    if callable(policy):
        return lambda number, query: EpisodePolicy(policy)
    begin = _trained(policy, env)
    return lambda number, query: EpisodePolicy(begin())


# --- Those that learn nothing


def _go_to_goal(goal):
    target = panda.normalise(goal)
    return lambda observation: target - observation["observation"][:7]


def _random(rng):
    return lambda observation: rng.uniform(-1.0, 1.0, panda.NUM_JOINTS)


def _checker_source(name):
    # Here, because Numba takes a while to import.
    from roboarm_nmp.envs.perception.geometry_source import find_geometry_source

    try:
        return find_geometry_source(name or "ground_truth")
    except ValueError as error:
        raise PolicyError(str(error)) from error


def _via_points(seed, tries, geometry_source):
    # No margin is kept, which would reject more than it saves: with 3 mm, clean success was 2 to 5
    # points lower on `wall`, `double_walls` and `boxes`.
    def begin(number, query):
        checker = geometry_source(query.scene)
        # float32 may round a limit to just beyond it.
        start, goal = np.clip(panda.normalise(np.stack([query.start, query.goal])), -1.0, 1.0)
        if checker.is_motion_free(start, goal):
            return EpisodePolicy(_go_to_goal(query.goal), found=True)
        for via in np.random.default_rng([seed, number]).uniform(-1.0, 1.0, (tries, 7)):
            if checker.is_free(via) and checker.is_motion_free([start, via], [via, goal]).all():
                path = panda.denormalise(np.stack([start, via, goal]))
                return EpisodePolicy(_follow(path), found=True)
        return EpisodePolicy(_go_to_goal(query.goal), found=False)

    return begin


def _planner(env, seed, time_limit, geometry_source):
    planning = _import_planning()
    planner = planning.Planner(env, geometry_source=geometry_source)

    def begin(number, query):
        try:
            path = planner.plan(*query, seed=[seed, number], time_limit=time_limit)
        except planning.PlanningError:
            return EpisodePolicy(None, found=False)
        return EpisodePolicy(_follow(path), found=True)

    return begin


def _import_planning():
    # The one place where `envs` uses `demo_generation`, which is built on it: only when somebody
    # asks for this policy by name, so that neither it nor OMPL is needed by anything else.
    try:
        from roboarm_nmp.demo_generation import planning
    except ImportError as error:
        raise PolicyError(f"the policy planner needs OMPL, and {error}") from error
    return planning


def _follow(path):
    """One sub-goal per step along a path (n, 7), rad, and then the goal again and again."""
    targets = subgoals(path)[1:]
    left = itertools.chain(targets, itertools.repeat(targets[-1]))
    return lambda observation: next(left) - observation["observation"][:7]


# --- Trained ones. PyTorch is imported only here: it takes seconds.


def _load(path):
    """A policy network, the arguments of the environment it was trained in, its last layer."""
    from roboarm_nmp.envs.networks.exported_networks import load_network
    from roboarm_nmp.envs.networks.operations import NetworkError
    from roboarm_nmp.envs.policies.safety_filter import safety_filter_of

    try:
        network = load_network(path)
        safety_filter = safety_filter_of(network.metadata)
        recurrent_size(network)  # or it raises
    except NetworkError as error:
        raise PolicyError(str(error)) from error
    except ValueError as error:
        raise PolicyError(f"{path}: {error}") from error
    trained = network.metadata.get("env")
    if network.metadata.get("kind") != "policy" or not isinstance(trained, dict):
        raise PolicyError(f"{path}: a network, but not a policy")
    if "goal_type" not in trained:
        raise PolicyError(f"{path}: does not say which goal type it was trained with")
    return (
        network,
        {name: trained[name] for name in ENV_ARGUMENTS if name in trained},
        safety_filter,
    )


def _trained(path, env):
    """A policy network as a function without arguments, called at the start of an episode.

    It returns another one, from an observation to an action.
    """
    import torch

    from roboarm_nmp.envs.networks.operations import NetworkError

    network, trained, _ = _load(path)
    mode = trained.get("action_mode", "relative")
    if mode != env.action_mode:
        raise PolicyError(f"{path}: its actions are of mode {mode!r}, not {env.action_mode!r}")
    size = recurrent_size(network)

    def begin():
        recurrent_state = np.zeros(size, np.float32)

        # One observation at a time: in a batch its last bits would depend on the batch's size, for
        # a gain of a tenth of the time at most.
        def act(observation):
            nonlocal recurrent_state
            given = observation | {"recurrent_state": recurrent_state} if size else observation
            inputs = {name: torch.from_numpy(given[name])[None] for name in network.inputs}
            if not size:
                return network.predict_one(inputs, panda.NUM_JOINTS)
            action, recurrent_state = network.predict_one(inputs, (panda.NUM_JOINTS, size))
            return action

        return act

    space = env.observation_space
    unknown = set(network.inputs) - {*space, *(["recurrent_state"] if size else [])}
    if unknown:
        raise PolicyError(f"{path}: needs {', '.join(sorted(unknown))}, which is not observed")
    try:
        begin()({name: np.zeros(one.shape, np.float32) for name, one in space.items()})
    except NetworkError as error:
        raise PolicyError(str(error)) from error
    return begin
