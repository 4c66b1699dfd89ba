"""Proximity in observations, and the last layer that keeps away from things by it."""

from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from roboarm_nmp import envs
from roboarm_nmp.envs import panda
from roboarm_nmp.envs.collision.checker import LINK_DISTANCE_RANGE, CollisionChecker
from roboarm_nmp.envs.datasets.queries import load_queries
from roboarm_nmp.envs.perception.point_clouds import observed_checker
from roboarm_nmp.envs.policies.registry import PolicyError, make_policy
from roboarm_nmp.envs.policies.safety_filter import (
    ACTIVATION_DISTANCE,
    ARRIVING,
    AVOIDED,
    CARRYING,
    CBF_GAIN,
    DETOUR,
    FADING,
    MAX_RECOVERY,
    MOMENTUM,
    PATIENCE,
    SHARE,
    SafetyFilter,
)
from roboarm_nmp.envs.scenes.primitives import Scene

# --- Gradients and link_distances


def test_gradients_are_differences():
    env = envs.make("random_boxes_hard")
    env.reset(seed=4)
    checker, rng = CollisionChecker(env.scene), np.random.default_rng(0)
    env.close()
    states, step = rng.uniform(-0.95, 0.95, (200, 7)), 1e-5
    for self_collisions in (False, True):
        here = checker.signed_distances(states, self_collisions)
        for joint in range(7):
            move = np.zeros(7)
            move[joint] = step
            a = checker.signed_distances(states + move, self_collisions)
            b = checker.signed_distances(states - move, self_collisions)
            same = (
                (a.geometry == here.geometry)
                & (b.geometry == here.geometry)
                & (here.distance > 0.001)
            )
            slope = (a.distance - b.distance) / (2 * step)
            # (Now and then another point of the same thing is the nearest.)
            assert np.quantile(np.abs(slope - here.gradient[..., joint])[same], 0.99) < 1e-5
            assert same.mean() > 0.7
    nothing = CollisionChecker(Scene(table=None, floor=None)).signed_distances(states, False)
    assert not nothing.gradient.any()


@pytest.mark.parametrize("knows", ["obstacles", "points"])
@pytest.mark.parametrize("goal_type", ["ee", "combined"])
def test_link_distances_in_observations(knows, goal_type):
    env = envs.make("random_boxes_hard", link_distances=knows, goal_type=goal_type)
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=2)
    for _ in range(3):
        scene = env.unwrapped.scene
        checker = CollisionChecker(scene) if knows == "obstacles" else observed_checker(scene)
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
    # In another scene it is another one.
    query = load_queries("random_boxes_hard")[0]
    observation, _ = env.reset_specific(*query)
    checker = (
        CollisionChecker(query.scene) if knows == "obstacles" else observed_checker(query.scene)
    )
    least = checker.signed_distances(panda.normalise(query.start), False).distance.min()
    assert observation["link_distances"][:, 0].min() == pytest.approx(least, abs=1e-6)
    env.close()


def test_what_is_far_away_is_as_good_as_nothing():
    env = envs.make("no_obstacles", link_distances="obstacles")
    seen = np.stack([env.reset(seed=seed)[0]["link_distances"] for seed in range(20)]).reshape(
        -1, 8
    )
    env.close()
    far = seen[:, 0] == np.float32(LINK_DISTANCE_RANGE)
    assert 20 < far.sum() < 180 and not seen[far, 1:].any() and seen[~far, 1:].any()


def test_link_distances_changes_no_episode():
    plain = envs.make("wall")
    more = envs.make("wall", encoder="oracle", link_distances="obstacles")
    (a, _), (b, _) = plain.reset(seed=5), more.reset(seed=5)
    for step in range(20):
        assert a["observation"].tolist() == b["observation"][:10].tolist()
        action = np.random.default_rng(step).uniform(-0.03, 0.03, 7)
        a, b = plain.step(action)[0], more.step(action)[0]
    assert more.in_collision(more.start_configuration) is False
    plain.close()
    more.close()


def test_nearest_within_a_distance_is_the_same_and_beyond_it_nothing():
    scene = load_queries("random_boxes_hard")[0].scene
    states = np.random.default_rng(0).uniform(-1, 1, (300, 7))
    for checker in (CollisionChecker(scene), observed_checker(scene)):
        for self_collisions in (False, True):
            every = checker.signed_distances(states, self_collisions)
            near = checker.signed_distances(states, self_collisions, within=0.1)
            inside = every.distance < 0.1
            assert 0.1 < inside.mean() < 0.9
            for name in ("distance", "gradient", "thing"):
                one, other = getattr(every, name)[inside], getattr(near, name)[inside]
                np.testing.assert_allclose(one, other, atol=1e-6)
            assert np.isinf(near.distance[~inside]).all() and not near.gradient[~inside].any()


def test_unknown_link_distances_is_refused():
    with pytest.raises(ValueError, match="or an encoder with a decoder: lidar: cannot be read"):
        envs.make("wall", link_distances="lidar")


# --- The projection, worked out by hand


def link_distances(*rows):
    """(distance, gradient's first numbers) for each link -> (links, 8)."""
    table = np.zeros((len(rows), 8))
    for line, (distance, *gradient) in zip(table, rows, strict=True):
        line[0], line[1 : 1 + len(gradient)] = distance, gradient
    return table


def action(*numbers):
    return np.array([*numbers, *[0.0] * (7 - len(numbers))])


def test_a_point_approaches_a_plane():
    layer, straight = SafetyFilter(keep=0.01), action(-0.02, 0.02)
    # The distance falls by 0.5 m per unit of the first joint, so by 10 mm: a fifth of the 50 mm
    # that are left before 10 mm, just so.
    assert layer(straight, link_distances((0.06, 0.5))) == pytest.approx(straight)
    # Of 25 mm only half as much.
    assert layer(straight, link_distances((0.035, 0.5))) == pytest.approx(action(-0.01, 0.02))
    # Away from it, anything; and what is far does not matter.
    assert layer(-straight, link_distances((0.011, 0.5))) == pytest.approx(-straight)
    assert layer(straight, link_distances((ACTIVATION_DISTANCE, 9.0))) == pytest.approx(straight)
    # Too near, or already inside: away, by `MAX_RECOVERY` at most.
    for distance, out in ((0.005, 0.001), (-0.01, MAX_RECOVERY), (-0.03, MAX_RECOVERY)):
        assert layer(straight, link_distances((distance, 0.5)))[0] == pytest.approx(out / 0.5)


def test_the_change_is_the_smallest_one():
    rng, layer = np.random.default_rng(0), SafetyFilter(keep=0.01)
    wanted, gradient = rng.normal(0, 0.01, 7), rng.normal(0, 0.3, 7)
    wanted -= gradient * (gradient @ wanted + 0.008) / (gradient @ gradient)  # 8 mm nearer
    done = layer(wanted, np.array([[0.025, *gradient]]), max_step=1.0)
    by = 0.008 - CBF_GAIN * 0.015  # m: it may come 3 mm nearer
    assert done == pytest.approx(wanted + gradient * by / (gradient @ gradient), abs=1e-7)


def test_between_two_opposing_planes():
    """Along them it goes on; towards either it does not."""
    both = link_distances((0.02, 0.5, 0.0), (0.02, -0.5, 0.0))
    for towards in (-0.02, 0.02):
        done = SafetyFilter(keep=0.01)(action(towards, 0.02), both)
        assert done[1] == pytest.approx(0.02) and abs(done[0]) == pytest.approx(0.004)
    # Where there is too little room for both, it stays about where it is.
    tight = link_distances((0.005, 0.5, 0.0), (0.005, -0.5, 0.0))
    done = SafetyFilter(keep=0.01)(action(0.02, 0.02), tight)
    assert abs(done[0]) <= MAX_RECOVERY / 0.5 + 1e-9 and done[1] == pytest.approx(0.02)


def test_no_step_becomes_too_long_and_a_batch_is_each_alone():
    rng, layer = np.random.default_rng(0), SafetyFilter(keep=0.01)
    actions = rng.normal(0, 0.03, (500, 7))
    rows = np.concatenate(
        [rng.uniform(-0.01, 0.05, (500, 10, 1)), rng.normal(size=(500, 10, 7))], 2
    )
    done = layer(actions, rows)
    assert done.dtype == np.float32 and np.linalg.norm(done, axis=1).max() < 0.03 + 1e-6
    assert all(
        (layer(a, row) == one).all() for a, row, one in zip(actions, rows, done, strict=True)
    )
    assert (actions != done).any()  # and its arguments are left alone
    assert layer(np.zeros((0, 7)), np.zeros((0, 10, 8))).shape == (0, 7)


def test_less_is_kept_near_a_goal_that_is_near_to_something():
    layer, at_goal = SafetyFilter(keep=0.01), np.array([0.3, 0.004, -0.001])
    assert layer.kept(at_goal, 0.0) == pytest.approx([0.01, 0.004, -0.001])
    assert layer.kept(at_goal, 0.1) == pytest.approx([0.01, 0.007, 0.002])


# --- In episodes


def run(env, query, layer, seed=0):
    """Straight to the goal, with the layer or without: states, and the last info."""
    target = panda.normalise(query.goal)

    def act(observation):
        return target - observation["observation"][:7]

    if layer is not None:
        act = layer.around(act, env, np.random.default_rng(seed))
    observation, info = env.reset_specific(*query)
    states, done = [observation["observation"][:7]], info["is_success"]
    while not done:
        observation, _, terminated, truncated, info = env.step(act(observation))
        states.append(observation["observation"][:7])
        done = terminated or truncated
    return np.array(states), info


def test_it_keeps_clear_and_gets_further():
    queries = load_queries("random_boxes_hard", "validation")[:30]
    env = envs.make("random_boxes_hard", link_distances="obstacles", goal_type="combined")
    reached, touched = {}, {}
    for name, layer in {
        "bare": None,
        "layer": SafetyFilter(escape=False),
        "way out": SafetyFilter(),
    }.items():
        infos = [run(env, query, layer)[1] for query in queries]
        reached[name] = sum(info["is_success"] for info in infos)
        touched[name] = sum(info["collision_so_far"] for info in infos)
    env.close()
    assert reached["bare"] < reached["layer"] < reached["way out"]
    assert touched["layer"] < 0.75 * touched["bare"]


def test_links_keep_away_from_each_other():
    """The forearm folds towards the hand, with nothing else around."""
    env = envs.make("no_obstacles", goal_type="config", link_distances="obstacles")
    start, goal = np.zeros(7), np.zeros(7)
    start[[1, 3, 5]], goal[[1, 3, 5]] = (-0.8, -0.5, -0.5), (-0.8, -0.95, -0.95)
    assert not env.in_collision(panda.denormalise(start))
    assert env.in_collision(panda.denormalise(goal))
    alone = CollisionChecker(Scene(table=None, floor=None))
    least = {}
    for layer in (None, SafetyFilter(escape=False)):
        observation, _ = env.reset_specific(panda.denormalise(start), panda.denormalise(start))
        act = lambda observation: goal - observation["observation"][:7]  # noqa: E731
        if layer is not None:
            act = layer.around(act, env, np.random.default_rng(0))
        states = []
        for _ in range(60):
            observation, *_ = env.step(act(observation))
            states.append(observation["observation"][:7])
        states = np.clip(states, -1.0, 1.0)
        least[layer] = alone.signed_distances(states).distance.min()
    env.close()
    bare, kept = least.values()
    assert bare < 0.001 and 0.007 < kept < 0.013


def test_it_looks_where_an_action_leads():
    """Along a wall that a link only sees once it has moved: slower than the first look allows."""
    rows = np.zeros((10, 8))
    rows[:, 0] = ACTIVATION_DISTANCE

    def link_distances_at(state):
        there = rows.copy()
        there[3, :2] = 0.01 - 0.5 * (state[0] - 0.02), -0.5  # 1 cm is kept up to 0.02
        return there

    env = SimpleNamespace(max_step=0.03, get_wrapper_attr=lambda name: link_distances_at)
    act = SafetyFilter(escape=False).around(lambda _: action(0.03), env, None)
    # (An open pose, with no link near another one.)
    state = np.concatenate([[0.0, 0.0, 0.0, -0.3, 0.0, 0.3, 0.0], np.zeros(3)])
    moved = act({"observation": state, "link_distances": rows})
    # Seen from here the wall is 20 mm away, 10 mm more than what is kept: a fifth of those.
    assert moved == pytest.approx(action(CBF_GAIN * 0.01 / 0.5), abs=1e-6)


def test_where_it_cannot_act_it_says_so():
    for arguments, message in (
        ({}, "needs link_distances"),
        ({"link_distances": "points", "action_mode": "subgoal"}, "action_mode 'subgoal'"),
    ):
        env = envs.make("wall", **arguments)
        with pytest.raises(PolicyError, match=message):
            make_policy(lambda observation: np.zeros(7), env, safety_filter=SafetyFilter())
        env.close()


def test_an_environments_longest_step():
    env = envs.make("no_obstacles", goal_type="config", link_distances="obstacles", max_step=0.05)
    query = load_queries("no_obstacles", "validation")[0]
    observation, _ = env.reset_specific(*query)
    act = make_policy("go-to-goal", env, safety_filter=SafetyFilter())(0, query).act
    assert 0.04 < np.linalg.norm(act(observation)) < 0.05 + 1e-6
    env.close()


def test_out_of_a_dead_end():
    """It stands for `PATIENCE` steps, is off for `DETOUR`, and a seed gives the same way."""
    layer, asked = SafetyFilter(), []

    def stay(observation):
        asked.append(None)
        return np.zeros(7)

    nothing = link_distances(*[(ACTIVATION_DISTANCE,)] * 10)
    env = SimpleNamespace(max_step=0.01, get_wrapper_attr=lambda name: lambda state: nothing)

    def walk(seed):
        state, moves = np.zeros(10), []
        state[3], state[5] = -0.3, 0.3  # no link is near another one, and will be
        act = layer.around(stay, env, np.random.default_rng(seed))
        for _ in range(PATIENCE + DETOUR + 25):
            moves.append(act({"observation": state, "link_distances": nothing}))
            state = np.concatenate([state[:7] + moves[-1], state[7:]])
        return np.array(moves)

    moves = walk(1)
    assert not moves[:PATIENCE].any()
    detour, after = np.split(moves[PATIENCE:], [DETOUR])
    assert (detour == detour[0]).all()
    assert np.linalg.norm(detour[0]) == pytest.approx(0.01)
    # Momentum: on in that direction, as fast as can be while it is more than the longest action.
    steps = (MOMENTUM * (1 - np.arange(1, 26) / FADING)).clip(0, 1)
    assert after == pytest.approx(steps[:, None] * detour[0], abs=1e-6) and steps[-1] < 0.8
    assert detour[0, :CARRYING].all() and not detour[0, CARRYING:].any()
    assert len(asked) == PATIENCE + 25
    assert (walk(1) == moves).all() and (walk(2) != moves).any()


@pytest.mark.parametrize(("to_goal", "avoided"), [(1.0, AVOIDED), (0.2, SHARE * 0.2)])
def test_it_does_not_come_near_a_dead_end_again(to_goal, avoided):
    """A policy that wants to go back there is kept away, less where the goal is near."""
    begin = np.array([0.0, 0.0, 0.0, -0.3, 0.0, 0.3, 0.0])  # no link is near another one
    goal = begin + np.array([to_goal, 0, 0, 0, 0, 0, 0.5])

    def back(observation):
        return np.clip(begin - observation["observation"][:7], -0.01, 0.01)

    rows = link_distances(*[(ACTIVATION_DISTANCE,)] * 10)
    env = SimpleNamespace(max_step=0.03, get_wrapper_attr=lambda name: lambda state: rows)
    act = SafetyFilter().around(back, env, np.random.default_rng(1))
    state, away = begin.copy(), []
    for _ in range(PATIENCE + DETOUR + FADING):  # (it is not stuck a second time)
        observation = {"observation": np.concatenate([state, np.zeros(3)]), "link_distances": rows}
        observation |= {"desired_goal": goal, "goal_link_distances": rows}
        state = state + act(observation)
        away.append(np.linalg.norm((state - begin)[:CARRYING]))
    assert max(away[:PATIENCE]) == 0.0
    assert away[PATIENCE + DETOUR - 1] == pytest.approx(0.03 * DETOUR, rel=0.01)
    assert avoided - 0.03 < away[-1] < avoided + 0.06 and state[6] == 0.0


@pytest.mark.parametrize(("share", "arrives"), [(0.05, True), (0.01, False)])
def test_a_slow_arrival_is_no_dead_end(share, arrives):
    """Near the goal, what counts is the share of the rest that ten steps make."""
    begin = np.array([0.0, 0.0, 0.0, -0.3, 0.0, 0.3, 0.0])
    goal, rows = begin + 0.03, link_distances(*[(ACTIVATION_DISTANCE,)] * 10)
    env = SimpleNamespace(max_step=0.03, get_wrapper_attr=lambda name: lambda state: rows)
    act = SafetyFilter().around(
        lambda seen: share * (goal - seen["observation"][:7]), env, np.random.default_rng(1)
    )
    state, away = begin, [np.linalg.norm(goal - begin)]
    for _ in range(4 * PATIENCE):
        observation = {"observation": np.concatenate([state, np.zeros(3)]), "link_distances": rows}
        state = state + act(observation | {"desired_goal": goal, "goal_link_distances": rows})
        away.append(np.linalg.norm(goal - state))
    assert away[0] < 0.08  # so all of the way there would not be enough elsewhere
    assert (np.diff(away) < 0).all() == arrives
    assert away[-1] == pytest.approx(away[0] * 0.95 ** (4 * PATIENCE), rel=1e-3) or not arrives


@pytest.mark.parametrize(
    ("away", "brake"), [(0.5, CBF_GAIN), (ARRIVING, CBF_GAIN), (ARRIVING / 2, (1 + CBF_GAIN) / 2)]
)
def test_near_the_goal_it_brakes_less(away, brake):
    state = np.array([0.0, 0.0, 0.0, -0.3, 0.0, 0.3, 0.0])
    goal = state + np.array([away, 0, 0, 0, 0, 0, 0])
    rows = link_distances(
        (0.015, -1.0), *[(ACTIVATION_DISTANCE,)] * 9
    )  # a wall ahead of the first joint, 15 mm away
    env = SimpleNamespace(max_step=0.03, get_wrapper_attr=lambda name: lambda state: rows)
    act = SafetyFilter(0.01).around(lambda _: goal - state, env, np.random.default_rng(0))
    seen = {"observation": np.concatenate([state, np.zeros(3)]), "link_distances": rows}
    there = link_distances(*[(ACTIVATION_DISTANCE,)] * 10)
    taken = act(seen | {"desired_goal": goal, "goal_link_distances": there})
    assert taken == pytest.approx([brake * 0.005, 0, 0, 0, 0, 0, 0], abs=1e-6)
