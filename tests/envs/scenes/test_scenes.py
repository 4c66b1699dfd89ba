"""Scenes: their values, their distributions, in the environment, and in files."""

import math
from dataclasses import replace

import numpy as np
import pytest

from roboarm_nmp import envs
from roboarm_nmp.datasets import format as dataset_format
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.queries import load_queries, write_queries
from roboarm_nmp.demo_generation import make_queries
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.perception.encoders import MAX_OBSTACLES
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene, Sphere
from roboarm_nmp.envs.scenes.random_boxes import GRID, KEEP_CLEAR, SHOULDER
from roboarm_nmp.envs.tasks import TASKS
from roboarm_nmp.planning.planner import PlanningError
from roboarm_nmp.utils.bullet import pybullet as p

HARD = "random_boxes_hard"


class Shelves:
    """Two scenes in turn, whatever the random numbers."""

    base = Scene(table=None)
    drawn = 0

    def sample(self, rng):
        self.drawn += 1
        height = 0.4 + 0.1 * (self.drawn % 2)
        return replace(self.base, obstacles=(Box((0.6, 0.0, height), (0.3, 0.3, 0.03)),))


@pytest.fixture
def env():
    env = envs.make(HARD)
    yield env
    env.close()


def distance_to_robot(box):
    """m, of points on the robot's axis below its shoulder; by PyBullet, an independent way."""
    to_box = p.invertTransform(box.position, box.orientation)
    points = [(0.0, 0.0, height) for height in np.linspace(0.0, SHOULDER, 10)]
    local = np.array([p.multiplyTransforms(*to_box, x, (0, 0, 0, 1))[0] for x in points])
    beyond = np.maximum(np.abs(local) - np.array(box.size) / 2, 0.0)
    return np.linalg.norm(beyond, axis=1).min()


# --- Values


@pytest.mark.parametrize(
    "fields",
    [
        {"obstacles": (Sphere((0, 0, 0), 1), Sphere((0, 0, 1), 0))},
        {"obstacles": (Box((0, 0, math.nan), (1, 1, 1)),)},
        {"floor": -math.inf},
        {"friction": -1.0},
        {"obstacles": (Sphere((0, 0, 0), 1),) * 10_001},
    ],
)
def test_wrong_scene_is_rejected_with_the_reason(fields):
    with pytest.raises(ValueError, match=r"obstacle needs finite|at most|floor must|friction must"):
        Scene(**fields)


@pytest.mark.parametrize("orientation", [(0, 0, 0, 1.011), (0, 0, 1), (0, 0, math.nan, 1)])
def test_quaternion_more_than_one_percent_off_is_rejected(orientation):
    for kind, sizes in ((Box, [(1, 1, 1)]), (Cylinder, [0.1, 1.0])):
        with pytest.raises(ValueError, match="a quaternion x, y, z, w"):
            kind((0, 0, 0), *sizes, orientation)


def test_rounded_quaternion_is_normalised_and_an_exact_one_stays_bit_for_bit():
    half = math.sqrt(0.5)
    box = Box((0, 0, 0), (1, 1, 1), [0, 0, 0.7071, 0.7071])
    np.testing.assert_allclose(box.orientation, (0, 0, half, half), rtol=1e-15)
    assert box == Box((0, 0, 0), (1, 1, 1), (0, 0, 0.7071, 0.7071)) and len({box, box}) == 1
    cylinder = Cylinder((0, 0, 0), 0.1, 1.0, np.array([0.6, 0, 0, 0.795]))
    assert math.hypot(*cylinder.orientation) == pytest.approx(1.0, abs=1e-15)
    rng = np.random.default_rng(0)
    for angle in rng.uniform(-math.pi, math.pi, 100):  # all of these differ from 1 by rounding
        orientation = (0.0, 0.0, math.sin(angle), math.cos(angle))
        assert Box((0, 0, 0), (1, 1, 1), orientation).orientation == orientation
        short = tuple(np.float32(orientation).tolist())
        assert Box((0, 0, 0), (1, 1, 1), short).orientation == short


# --- The distribution


@pytest.mark.parametrize("level, fewest, most", [("easy", 2, 4), ("medium", 3, 6), ("hard", 4, 8)])
def test_every_number_of_obstacles_is_equally_likely(level, fewest, most):
    rng = np.random.default_rng(0)
    scenes = TASKS[f"random_boxes_{level}"].scene
    counts = [len(scenes.sample(rng).obstacles) for _ in range(1500)]
    values, found = np.unique(counts, return_counts=True)
    assert values.tolist() == list(range(fewest, most + 1))
    expected = 1500 / len(values)
    assert np.abs(found - expected).max() < 4.5 * math.sqrt(expected)


def test_obstacles_are_shelves_poles_and_walls_clear_of_the_robot():
    rng = np.random.default_rng(1)
    boxes = [box for _ in range(60) for box in TASKS[HARD].scene.sample(rng).obstacles]
    sizes = np.array([box.size for box in boxes])
    boards = (sizes[:, 2] < 0.05).mean()
    slender = (sizes[:, 2] > 1.0) & (sizes[:, :2].max(axis=1) < 0.09)
    assert 0.1 < boards < 0.9 and 0.1 < slender.mean() < 0.9
    for box in boxes:
        assert np.array_equal(np.divide([*box.position, *box.size], GRID) % 1, np.zeros(6))
        assert distance_to_robot(box) > KEEP_CLEAR - 0.01


def test_mixed_scenes_are_of_three_kinds_and_clear_of_the_robot():
    mixed = envs.get_task("mixed_scenes").scene
    assert mixed.sample(np.random.default_rng(3)) == mixed.sample(np.random.default_rng(3))
    drawn = [mixed.sample(np.random.default_rng([0, i])) for i in range(150)]
    assert len(set(drawn)) == 150 and not {task.scene for task in TASKS.values()} & set(drawn)
    assert max(len(scene.obstacles) for scene in drawn) <= MAX_OBSTACLES
    walls = racks = objects = 0
    for scene in drawn:
        assert scene == replace(mixed.base, obstacles=scene.obstacles)
        boxes = [obstacle for obstacle in scene.obstacles if isinstance(obstacle, Box)]
        assert min(map(distance_to_robot, boxes)) > KEEP_CLEAR - 0.02
        sizes = np.array([box.size for box in boxes])
        places = np.array([box.position for box in boxes])
        walls += (sizes[:, 0] > 0.39).all() and np.allclose(
            places[:, 2], sizes[:, 2] / 2, atol=GRID
        )
        racks += len(np.unique(places[:, :2], axis=0)) < len(places)  # boards above each other
        objects += len(boxes) < len(scene.obstacles)
    assert 30 < walls < 70 and 30 < racks < 70 and 15 < objects < racks


def test_containers_have_places_between_their_parts_and_are_clear_of_the_robot():
    containers = envs.get_task("containers").scene
    drawn = [containers.sample_with_places(np.random.default_rng([0, i])) for i in range(60)]
    assert containers.sample(np.random.default_rng([0, 7])) == drawn[7][0]
    assert len({scene for scene, _ in drawn}) == 60
    kinds, apart = set(), []
    for scene, places in drawn:
        assert scene == replace(containers.base, obstacles=scene.obstacles) and places
        assert len(scene.obstacles) <= MAX_OBSTACLES
        boxes = [obstacle for obstacle in scene.obstacles if isinstance(obstacle, Box)]
        upright = [box for box in boxes if box.orientation[:2] == (0.0, 0.0)]
        assert min(map(distance_to_robot, upright)) > KEEP_CLEAR - 0.02
        # Boards do not cross the places between them. (Objects may stand there; a tilted lid is
        # above its box; those of other furniture may.)
        boards = [box for box in upright if max(box.size) > 0.4]
        for place in places:
            kinds.add(tuple(np.round(place.approach[2:], 1)))
            assert np.linalg.norm(place.approach) == pytest.approx(1.0) and min(place.size) > 0.0
            corners = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), -1).reshape(-1, 3) * place.size
            points = place.centre + corners @ place.rotation.T
            for board in boards:
                to_board = p.invertTransform(board.position, board.orientation)
                local = [p.multiplyTransforms(*to_board, x, (0, 0, 0, 1))[0] for x in points]
                local = np.array(local)
                face = np.array(board.size) / 2 - 2 * GRID  # rounded; all are beyond one face
                apart.append(((local > face).all(0) | (local < -face).all(0)).any())
    assert kinds == {(-1.0,), (0.0,), (-0.6,)} and np.mean(apart) > 0.97


# --- In the environment


def test_scene_stays_for_episodes_per_scene():
    shelves = Shelves()
    env = RoboArmEnv(shelves, episodes_per_scene=3)
    heights = []
    for _ in range(7):
        env.reset()
        heights.append(env.scene.obstacles[0].position[2])
    assert heights == [0.5, 0.5, 0.5, 0.4, 0.4, 0.4, 0.5]
    drawn = shelves.drawn
    env.reset(seed=1)  # must not depend on what was before
    assert shelves.drawn == drawn + 1
    env.close()


def test_replay_is_exact_among_other_scenes(env):
    """Bit for bit, after other scenes in this environment and in a fresh one."""

    def run(env, seed):
        rng = np.random.default_rng(seed)
        env.sample_scene(rng)
        observation, _ = env.reset_specific(*env.sample_query(rng))
        states = [observation["observation"]]
        for action in rng.uniform(-1, 1, (6, 7)).repeat(10, axis=0):
            states.append(env.step(action)[0]["observation"])
        return np.stack(states)

    first = {seed: run(env, seed) for seed in range(4)}
    for seed in (2, 0):
        np.testing.assert_array_equal(run(env, seed), first[seed])
    fresh = envs.make(HARD)
    np.testing.assert_array_equal(run(fresh, 3), first[3])
    fresh.close()


def test_world_made_anew_changes_no_number(env, monkeypatch):
    env.reset(seed=2)
    before = env.reset(seed=3)[0]
    monkeypatch.setattr("roboarm_nmp.envs.world.MAX_BODIES_MADE", 10)
    for seed in range(10):
        env.reset(seed=seed)
    after = env.reset(seed=3)[0]
    # Robot, floor, table, obstacles, and no others.
    assert p.getNumBodies(physicsClientId=env.client) == 3 + len(env.scene.obstacles)
    for name in before:
        np.testing.assert_array_equal(before[name], after[name])


def test_changing_the_scene_changes_its_obstacles():
    one, two = Box((0.5, 0.0, 0.3), (0.1, 0.1, 0.6)), Box((0.0, 0.5, 0.3), (0.1, 0.1, 0.6))
    env = RoboArmEnv(Scene((one, two)))
    reaching = np.array([0.0, 0.6, 0.0, -1.6, 0.0, 2.2, 0.7])  # into `one`
    turned = reaching + np.array([np.pi / 2, 0, 0, 0, 0, 0, 0])  # into `two`
    for obstacles, hit in [
        ((one, two), (True, True)),
        ((one,), (True, False)),
        ((two,), (False, True)),
        ((two, one), (True, True)),
        ((), (False, False)),
    ]:
        env.set_scene(Scene(obstacles))
        assert (env.in_collision(reaching), env.in_collision(turned)) == hit
    env.close()


# --- In files


def random_queries(n, rng):
    return tuple(rng.uniform(-0.08, -0.01, (2, n, 7)).astype(np.float32))


@pytest.fixture
def scenes():
    rng = np.random.default_rng(4)
    return [TASKS[HARD].scene.sample(rng) for _ in range(3)]


def write(path, scenes):
    rng = np.random.default_rng(6)
    index = [0, 1, 1, 2, 0, 2, 2]
    splits = {
        "test": (*random_queries(7, rng), [scenes[i] for i in index]),
        "validation": (*random_queries(2, rng), scenes[:2]),
    }
    write_queries(path, HARD, 0, splits, "made by a test", {})
    return index


def test_queries_come_back_with_their_scenes(tmp_path, scenes):
    index = write(tmp_path / "queries.h5", scenes)
    queries = load_queries(tmp_path / "queries.h5")
    assert [queries[i].scene for i in range(7)] == [scenes[i] for i in index]
    assert queries[2:5][1].scene == scenes[index[3]]
    assert queries[np.array([6, 1])][0].scene == scenes[index[6]]
    assert len(queries.scenes.offsets) == 4  # each scene is stored once
    assert load_queries(tmp_path / "queries.h5", "validation")[1].scene == scenes[1]


def test_damaged_scenes_are_rejected(tmp_path, scenes):
    write(tmp_path / "queries.h5", scenes)
    path = tmp_path / "queries.h5"
    _, arrays, base = dataset_format.read_file(path, dataset_format.QUERY_SCHEMA, HARD)
    for name, change, complaint in [
        ("test/scene", lambda a: a + 1, "does not fit"),
        ("test/obstacle_count", lambda a: a + 1, "does not fit"),
        ("test/obstacles", lambda a: np.where(np.arange(11) == 0, 9.0, a), "unknown kind"),
        ("test/obstacles", lambda a: np.where(np.arange(11) == 3, np.inf, a), "not finite"),
    ]:
        damaged = arrays | {name: change(arrays[name]).astype(arrays[name].dtype)}
        with pytest.raises(DatasetError, match=complaint):
            dataset_format.read_scenes(path, base, damaged, "test/")


def test_an_unsolvable_query_is_rejected_and_counted(monkeypatch):
    sampler = make_queries.Sampler("no_obstacles", solvable=True)
    solve, tried = sampler.planner.plan, []

    def fail_on_the_first_two(start, goal, **options):
        if len(tried) < 2 and not any((start == other).all() for other in tried):
            tried.append(start)
        if any((start == other).all() for other in tried):
            raise PlanningError("no path")
        return solve(start, goal, **options)

    monkeypatch.setattr(sampler.planner, "plan", fail_on_the_first_two)
    query = sampler((0, "test", 0))
    assert query["rejected"]["unsolved"] == len(tried) == 2
    assert not any((query["start"] == other).all() for other in tried)


# --- MotionBenchMaker's scenes


@pytest.mark.parametrize("name", ["tall", "thin"])
def test_original_starts_and_goals_are_feasible_in_our_world(name):
    task = f"benchmaker_bookshelf_{name}"
    queries = load_queries(task, "original")[::10]
    assert len(queries) == 10
    nominal = {can.radius for can in TASKS[task].scene.obstacles if isinstance(can, Cylinder)}
    env = envs.make(task)
    for start, goal, scene in queries:
        assert len(scene.obstacles) == len(TASKS[task].scene.obstacles)
        assert {o.radius for o in scene.obstacles if isinstance(o, Cylinder)} == nominal
        env.set_scene(scene)
        assert env.is_feasible(start) and env.is_feasible(goal)
    env.close()
