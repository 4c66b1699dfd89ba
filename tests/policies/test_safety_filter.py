"""Link distances in observations, and the safety filter that uses them."""

from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.collision.checker import LINK_DISTANCE_RANGE, CollisionChecker
from roboarm_nmp.envs.perception.geometry_source import observed_checker
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.policies.registry import PolicyError, make_policy
from roboarm_nmp.policies.safety_filter import (
    ACTIVATION_DISTANCE,
    ARRIVAL_DISTANCE,
    CBF_GAIN,
    ESCAPE_STEPS,
    MAX_RECOVERY,
    MOMENTUM_STEPS,
    PATIENCE,
    TURNING_JOINTS,
    VIRTUAL_RADIUS,
    VIRTUAL_RADIUS_SHARE,
    SafetyFilter,
)

GROUND_TRUTH = {"link_distances": True, "geometry_source": "ground_truth"}
ESCAPE_JOINTS = PANDA.num_joints - TURNING_JOINTS


def fake_env(max_step, link_distances_at):
    """What `filter_policy` needs of an environment of the Panda."""
    attributes = {"link_distances_at": link_distances_at, "current_checker": lambda: None}
    return SimpleNamespace(robot=PANDA, max_step=max_step, get_wrapper_attr=attributes.get)


# --- Link distances


@pytest.mark.parametrize(
    ("geometry_source", "goal_type"), [("ground_truth", "ee"), ("point_cloud", "combined")]
)
def test_observed_link_distances_are_those_of_the_geometry_source(geometry_source, goal_type):
    options = {"link_distances": True, "geometry_source": geometry_source}
    env = envs.make("random_boxes_hard", goal_type=goal_type, **options)
    find = CollisionChecker if geometry_source == "ground_truth" else observed_checker
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=2)
    for _ in range(3):
        scene = env.unwrapped.scene
        checker = find(scene)
        places = {"link_distances": observation["observation"][:7]}
        if goal_type != "ee":
            places["goal_link_distances"] = observation["desired_goal"][:7]
        for name, state in places.items():
            nearest = checker.signed_distances(state, self_collisions=False)
            near = nearest.distance < LINK_DISTANCE_RANGE
            distances = np.minimum(nearest.distance, LINK_DISTANCE_RANGE).astype(np.float32)
            assert observation[name].shape == (10, 8) and near.any()
            assert observation[name][:, 0].tolist() == distances.tolist()
            expected = np.where(near[:, None], nearest.gradient, 0.0).astype(np.float32)
            assert observation[name][:, 1:].tolist() == expected.tolist()
        assert ("goal_link_distances" in observation) == (goal_type != "ee")
        observation, *_ = env.step(np.full(7, 0.01))
    # Another scene has other distances.
    query = load_queries("random_boxes_hard")[0]
    observation, _ = env.reset_specific(*query)
    checker = find(query.scene)
    least = checker.signed_distances(PANDA.normalise(query.start), False).distance.min()
    assert observation["link_distances"][:, 0].min() == pytest.approx(least, abs=1e-6)
    env.close()


# --- The projection, worked out by hand


def link_distances(*rows):
    """Link distances (links, 8) from the distance and the first gradients of each link."""
    array = np.zeros((len(rows), 8))
    for row, (distance, *gradient) in zip(array, rows, strict=True):
        row[0], row[1 : 1 + len(gradient)] = distance, gradient
    return array


def action(*numbers):
    return np.array([*numbers, *[0.0] * (7 - len(numbers))])


def test_approach_to_a_plane_slows_down_and_violations_recover():
    safety_filter, straight = SafetyFilter(margin=0.01), action(-0.02, 0.02)
    # The distance falls by 0.5 m per unit of the first joint, so by 10 mm. That is just a fifth of
    # the 50 mm that remain to the margin.
    assert safety_filter(straight, link_distances((0.06, 0.5))) == pytest.approx(straight)
    # With 25 mm to the margin, half as much.
    assert safety_filter(straight, link_distances((0.035, 0.5))) == pytest.approx(
        action(-0.01, 0.02)
    )
    # Moving away is not constrained, and a large distance constrains nothing.
    assert safety_filter(-straight, link_distances((0.011, 0.5))) == pytest.approx(-straight)
    assert safety_filter(straight, link_distances((ACTIVATION_DISTANCE, 9.0))) == pytest.approx(
        straight
    )
    # Nearer than the margin, or inside: the action moves away, by at most `MAX_RECOVERY`.
    for distance, out in ((0.005, 0.001), (-0.01, MAX_RECOVERY), (-0.03, MAX_RECOVERY)):
        assert safety_filter(straight, link_distances((distance, 0.5)))[0] == pytest.approx(
            out / 0.5
        )


def smallest_change(wanted, normals, bounds):
    """The nearest of all actions with normals @ action >= bounds, for two half-spaces."""
    candidates = [wanted]
    for active in ([0], [1], [0, 1]):
        n, short = normals[active], bounds[active] - normals[active] @ wanted
        candidates.append(wanted + n.T @ np.linalg.solve(n @ n.T, short))
    feasible = [x for x in candidates if (normals @ x >= bounds - 1e-9).all()]
    return min(feasible, key=lambda x: np.linalg.norm(x - wanted))


def test_change_for_two_half_spaces_is_at_most_a_sixth_longer_than_the_smallest():
    rng, ratios = np.random.default_rng(0), []
    for _ in range(1000):
        distances, normals = rng.uniform(-0.005, 0.03, 2), rng.normal(0, 0.3, (2, 7))
        wanted = rng.normal(0, 0.01, 7)
        rows = np.concatenate([distances[:, None], normals], axis=1)
        done = SafetyFilter(margin=0.01)(wanted, rows, max_step=1.0)
        bounds = np.minimum(CBF_GAIN * (0.01 - distances), MAX_RECOVERY)
        exact = smallest_change(wanted, normals, bounds)
        assert (normals @ done > bounds - 1e-3).all()  # after a limited number of sweeps
        if (normals @ wanted < bounds - 1e-4).any():
            ratios.append(np.linalg.norm(done - wanted) / np.linalg.norm(exact - wanted))
    # Cyclic projection is exact for one half-space, and 2 / sqrt(3) too long at worst for two.
    assert len(ratios) > 500 and np.median(ratios) == pytest.approx(1.0, abs=1e-3)
    assert max(ratios) < 2 / np.sqrt(3) + 0.01


def test_actions_stay_within_the_longest_step_and_batches_equal_single_calls():
    rng, safety_filter = np.random.default_rng(0), SafetyFilter(margin=0.01)
    actions = rng.normal(0, 0.03, (500, 7))
    rows = np.concatenate(
        [rng.uniform(-0.01, 0.05, (500, 10, 1)), rng.normal(size=(500, 10, 7))], 2
    )
    done = safety_filter(actions, rows)
    assert done.dtype == np.float32 and np.linalg.norm(done, axis=1).max() < 0.03 + 1e-6
    assert all(
        (safety_filter(a, row) == one).all()
        for a, row, one in zip(actions, rows, done, strict=True)
    )
    assert (actions != done).any()  # so arguments are not changed in place
    assert safety_filter(np.zeros((0, 7)), np.zeros((0, 10, 8))).shape == (0, 7)


def test_margins_shrink_near_a_goal_that_violates_them():
    safety_filter, at_goal = SafetyFilter(margin=0.01), np.array([0.3, 0.004, -0.001])
    assert safety_filter.margins_near_goal(at_goal, 0.0) == pytest.approx([0.01, 0.004, -0.001])
    assert safety_filter.margins_near_goal(at_goal, 0.1) == pytest.approx([0.01, 0.007, 0.002])


# --- Options


def test_invalid_options_are_rejected():
    with pytest.raises(ValueError, match="margin must be in"):
        SafetyFilter(ACTIVATION_DISTANCE)
    with pytest.raises(ValueError, match="lookahead must be None or in"):
        SafetyFilter(lookahead=-0.1)


def test_options_come_from_a_policys_metadata():
    safety_filter = SafetyFilter(0.012, escape=False, approach=True, lookahead=None)
    metadata = {"margin": 0.012, "escape": False, "approach": True, "lookahead": None}
    assert safety_filter.to_metadata() == metadata
    assert SafetyFilter.from_metadata({"safety_filter": metadata}) == safety_filter
    assert SafetyFilter.from_metadata({}) is None
    for options in ({"margin": 0.012}, {"margin": 1.0, "escape": True}, 0.01):
        with pytest.raises(ValueError, match="invalid safety_filter"):
            SafetyFilter.from_metadata({"safety_filter": options})


# --- In episodes (their collisions and successes: test_evaluation.py)


def test_filter_keeps_the_margin_between_links():
    """The forearm folds towards the hand, without obstacles."""
    env = envs.make("no_obstacles", goal_type="config", **GROUND_TRUTH)
    start, goal = np.zeros(7), np.zeros(7)
    start[[1, 3, 5]], goal[[1, 3, 5]] = (-0.8, -0.5, -0.5), (-0.8, -0.95, -0.95)
    assert not env.in_collision(PANDA.denormalise(start))
    assert env.in_collision(PANDA.denormalise(goal))
    alone = CollisionChecker(Scene(table=None, floor=None))
    least = {}
    for safety_filter in (None, SafetyFilter(escape=False)):
        observation, _ = env.reset_specific(PANDA.denormalise(start), PANDA.denormalise(start))
        act = lambda observation: goal - observation["observation"][:7]  # noqa: E731
        if safety_filter is not None:
            act = safety_filter.filter_policy(act, env, np.random.default_rng(0))
        states = []
        for _ in range(60):
            observation, *_ = env.step(act(observation))
            states.append(observation["observation"][:7])
        states = np.clip(states, -1.0, 1.0)
        least[safety_filter] = alone.signed_distances(states).distance.min()
    env.close()
    without, filtered = least.values()
    assert without < 0.001 and 0.007 < filtered < 0.013


def test_distances_at_the_end_of_the_step_count_too():
    """A wall becomes the nearest obstacle of a link only once the link has moved."""
    rows = np.zeros((10, 8))
    rows[:, 0] = ACTIVATION_DISTANCE

    def link_distances_at(state):
        there = rows.copy()
        there[3, :2] = 0.01 - 0.5 * (state[0] - 0.02), -0.5  # nearer than 1 cm beyond 0.02
        return there

    env = fake_env(0.03, link_distances_at)
    act = SafetyFilter(escape=False).filter_policy(lambda _: action(0.03), env, None)
    # (An open pose, without links near each other.)
    state = np.concatenate([[0.0, 0.0, 0.0, -0.3, 0.0, 0.3, 0.0], np.zeros(3)])
    moved = act({"observation": state, "link_distances": rows})
    # Extrapolated back to the start, the wall is 20 mm away, so 10 mm to the margin: a fifth of it.
    assert moved == pytest.approx(action(CBF_GAIN * 0.01 / 0.5), abs=1e-6)


def test_unsuitable_environment_is_rejected():
    for arguments, message in (
        ({}, "needs link_distances"),
        (GROUND_TRUTH | {"action_mode": "subgoal"}, "action_mode 'relative', not 'subgoal'"),
    ):
        env = envs.make("wall", **arguments)
        with pytest.raises(PolicyError, match=message):
            make_policy(lambda observation: np.zeros(7), env, safety_filter=SafetyFilter())
        env.close()


@pytest.mark.parametrize(
    ("to_goal", "radius"), [(1.0, VIRTUAL_RADIUS), (0.2, VIRTUAL_RADIUS_SHARE * 0.2)]
)
def test_virtual_obstacle_keeps_the_arm_from_a_local_minimum(to_goal, radius):
    """A policy returns to the local minimum. The obstacle is smaller where the goal is near."""
    begin = np.array([0.0, 0.0, 0.0, -0.3, 0.0, 0.3, 0.0])  # no links are near each other
    goal = begin + np.array([to_goal, 0, 0, 0, 0, 0, 0.5])

    def back(observation):
        return np.clip(begin - observation["observation"][:7], -0.01, 0.01)

    rows = link_distances(*[(ACTIVATION_DISTANCE,)] * 10)
    env = fake_env(0.03, lambda state: rows)
    act = SafetyFilter().filter_policy(back, env, np.random.default_rng(1))
    state, away = begin.copy(), []
    for _ in range(PATIENCE + ESCAPE_STEPS + MOMENTUM_STEPS):  # (without a second escape)
        observation = {"observation": np.concatenate([state, np.zeros(3)]), "link_distances": rows}
        observation |= {"desired_goal": goal, "goal_link_distances": rows}
        state = state + act(observation)
        away.append(np.linalg.norm((state - begin)[:ESCAPE_JOINTS]))
    assert max(away[:PATIENCE]) == 0.0
    assert away[PATIENCE + ESCAPE_STEPS - 1] == pytest.approx(0.03 * ESCAPE_STEPS, rel=0.01)
    assert radius - 0.03 < away[-1] < radius + 0.06 and state[6] == 0.0


@pytest.mark.parametrize(
    ("away", "cbf_gain"), [(0.5, CBF_GAIN), (ARRIVAL_DISTANCE / 2, (1 + CBF_GAIN) / 2)]
)
def test_gain_grows_near_the_goal(away, cbf_gain):
    state = np.array([0.0, 0.0, 0.0, -0.3, 0.0, 0.3, 0.0])
    goal = state + np.array([away, 0, 0, 0, 0, 0, 0])
    # A wall 15 mm ahead of the first joint, so 5 mm to the margin.
    rows = link_distances((0.015, -1.0), *[(ACTIVATION_DISTANCE,)] * 9)
    env = fake_env(0.03, lambda state: rows)
    act = SafetyFilter(0.01).filter_policy(lambda _: goal - state, env, np.random.default_rng(0))
    observation = {"observation": np.concatenate([state, np.zeros(3)]), "link_distances": rows}
    there = link_distances(*[(ACTIVATION_DISTANCE,)] * 10)
    done = act(observation | {"desired_goal": goal, "goal_link_distances": there})
    assert done == pytest.approx([cbf_gain * 0.005, 0, 0, 0, 0, 0, 0], abs=1e-6)
