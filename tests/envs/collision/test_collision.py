"""Compiled collision checks: PyBullet's answers, distances by hand, motions, invalid input."""

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from paths import ROOT
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist

from roboarm_nmp import envs
from roboarm_nmp.envs.collision import checker as collision
from roboarm_nmp.envs.collision.checker import (
    ARM,
    FLOOR,
    NOTHING,
    RESOLUTION,
    TABLE,
    CollisionChecker,
)
from roboarm_nmp.envs.collision.gjk_kernels import BULLET_MARGIN
from roboarm_nmp.envs.collision.hulls import arm_hulls, vertex_counts
from roboarm_nmp.envs.collision.spheres import hull_spheres
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.urdf import robot_from_urdf
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene, Sphere
from roboarm_nmp.envs.world import World
from roboarm_nmp.utils.bullet import pybullet as p

# Stretched out, upwards and to the front, and far from itself.
LINKS = PANDA.collision_links
STATE = PANDA.normalise([0.3, 0.4, 0.2, -0.9, 0.3, 1.2, 0.4])
EMPTY = Scene(table=None, floor=None)


@pytest.fixture(scope="module")
def env():
    env = envs.RoboArmEnv(EMPTY)
    yield env
    env.close()


@pytest.fixture(scope="module")
def hulls(env):
    """Vertices (n, 3) of each of `LINKS` at `STATE`, in the base's frame, by PyBullet."""
    env.world.arm.set_configuration(PANDA.denormalise(STATE))
    hulls = []
    for link in LINKS:
        flags = p.MESH_DATA_SIMULATION_MESH
        mesh = p.getMeshData(env.body, link, flags=flags, physicsClientId=env.client)[1]
        state = p.getLinkState(
            env.body, link, computeForwardKinematics=1, physicsClientId=env.client
        )
        rotation = np.array(p.getMatrixFromQuaternion(state[1])).reshape(3, 3)
        hulls.append(np.array(mesh) @ rotation.T + state[0])  # meshes are about the mass centre
    return hulls


def random_scene(rng, table=True):
    """Boxes, cylinders and spheres of all sizes and poses within the arm's reach."""
    while True:
        obstacles = []
        for _ in range(2):
            obstacles.append(Box(place(rng), tuple(rng.uniform(0.02, 0.4, 3)), turn(rng)))
            length = rng.uniform(0.02, 0.5)
            obstacles.append(Cylinder(place(rng), rng.uniform(0.01, 0.1), length, turn(rng)))
            obstacles.append(Sphere(place(rng), rng.uniform(0.01, 0.15)))
        scene = Scene(tuple(obstacles))
        if not table:
            scene = Scene(tuple(obstacles), table=None, floor=None)
        if CollisionChecker(scene).is_free(rng.uniform(-1, 1, (200, 7))).mean() > 0.15:
            return scene


def place(rng):
    direction = rng.normal(size=3)
    direction[2] = abs(direction[2])
    return tuple(rng.uniform(0.4, 0.9) * direction / np.linalg.norm(direction))


def turn(rng):
    quaternion = rng.normal(size=4)
    return tuple(quaternion / np.linalg.norm(quaternion))


# --- The same answers as PyBullet


def near_contact(checker, rng, number):
    """States with a smallest distance from -5 mm to 5 mm: (number, 7)."""
    states = np.empty((0, 7))
    while len(states) < number:
        a, b = rng.uniform(-1, 1, (2, 200, 7))
        low, high = np.zeros(200), np.ones(200)
        wanted = rng.uniform(-0.005, 0.005, 200)

        def beyond(share, a=a, b=b, wanted=wanted):
            return checker.signed_distances(a + share[:, None] * (b - a)).distance.min(-1) > wanted

        crosses = beyond(low) != beyond(high)
        below = beyond(low)
        for _ in range(25):
            middle = (low + high) / 2
            same = beyond(middle) == below
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        states = np.concatenate([states, (a + low[:, None] * (b - a))[crosses]])
    return states[:number]


def arm_of_boxes(folder):
    """Seven joints between links that are boxes, some of which are turned in their links."""
    inertial = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" {}/></inertial>'
    inertial = inertial.format('ixy="0" ixz="0" iyz="0"')
    elements = ""
    for i in range(8):
        elements += (
            f'<link name="l{i}">{inertial}<collision><origin xyz="0 0 .1" rpy="{i // 4} 0 0"/>'
        )
        elements += '<geometry><box size=".05 .06 .16"/></geometry></collision></link>'
    for i in range(7):
        elements += f'<joint name="j{i}" type="revolute"><parent link="l{i}"/>'
        elements += (
            f'<child link="l{i + 1}"/><origin xyz="0 0 .2"/><axis xyz="{i % 2} 1 {i // 4}"/>'
        )
        elements += '<limit lower="-2.5" upper="2.5" effort="50" velocity="1"/></joint>'
    (folder / "boxes.urdf").write_text(f'<robot name="boxes">{elements}</robot>')
    return robot_from_urdf(folder / "boxes.urdf")


@pytest.mark.parametrize("name", ["panda", "boxes"])
def test_random_scenes_agree_with_pybullet(tmp_path, name):
    """Bullet's boxes have sharp edges towards boxes, and rounded ones towards other shapes."""
    rng = np.random.default_rng(1)
    robot = PANDA if name == "panda" else arm_of_boxes(tmp_path)
    scene = replace(random_scene(rng), robot=robot)
    world = World(scene, drawn=False)
    checker = CollisionChecker(scene)
    for states in (rng.uniform(-1, 1, (200, 7)), near_contact(checker, rng, 200)):
        theirs = [not world.in_collision(c) for c in robot.denormalise(states)]
        np.testing.assert_array_equal(checker.is_free(states), theirs)
        assert 0.05 < np.mean(theirs) < 0.95
    # The states near contact distinguish a millimetre.
    assert (checker.is_free(states, margin=0.001) != theirs).mean() > 0.05
    # A distance is negative in a collision and nowhere else.
    np.testing.assert_array_equal(checker.signed_distances(states).distance.min(-1) >= 0, theirs)
    world.close()


def test_distances_agree_with_pybullet(env):
    """Each link's distance from obstacles of all kinds, apart and overlapping, by Bullet's GJK."""
    rng, further = np.random.default_rng(7), []
    for obstacle in random_scene(rng, table=False).obstacles:
        scene = Scene((obstacle,), table=None, floor=None)
        env.set_scene(scene)
        (body,) = env.world._bodies
        states = rng.uniform(-1, 1, (25, 7))
        near = CollisionChecker(scene).signed_distances(states, self_collisions=False)
        assert (near.geometry == 0).all()
        for state, distances in zip(states, near.distance, strict=True):
            env.world.arm.set_configuration(PANDA.denormalise(state))
            for link, distance in zip(LINKS, distances, strict=True):
                points = p.getClosestPoints(
                    env.body, body, 2.0, linkIndexA=link, physicsClientId=env.client
                )
                if distance > 1e-4:  # where shapes overlap, Bullet's depth is rougher
                    further.append(points[0][8] - distance)
                elif distance < -1e-3:
                    assert points[0][8] < 0
    # Both are distances of two points, so the smaller one is the better; Bullet stops earlier.
    assert len(further) > 600 and min(further) > -1e-7
    assert np.median(further) < 1e-8 and max(further) < 5e-5
    env.set_scene(EMPTY)


# --- By hand


def outermost(hulls):
    """The vertex that is farthest to the front, and its link's index in `LINKS`."""
    link = int(np.argmax([hull[:, 0].max() for hull in hulls]))
    return link, hulls[link][hulls[link][:, 0].argmax()]


@pytest.mark.parametrize("gap", [0.0001, -0.0005, 0.2])
def test_distance_normal_and_witness_of_a_sphere_in_front(hulls, gap):
    link, tip = outermost(hulls)
    radius = 0.05
    centre = tip + [BULLET_MARGIN + gap + radius, 0, 0]
    checker = CollisionChecker(Scene((Sphere(tuple(centre), radius),), table=None, floor=None))
    near = checker.signed_distances(STATE, self_collisions=False)
    assert near.geometry[link] == 0
    assert near.distance[link] == pytest.approx(gap, abs=2e-6)
    np.testing.assert_allclose(near.normal[link], [-1, 0, 0], atol=1e-4)
    np.testing.assert_allclose(near.witness[link], tip, atol=1e-5)
    assert checker.is_free(STATE) == (gap > 0)
    assert checker.is_free(STATE, margin=0.0005) == (gap > 0.0005)
    assert checker.is_free(STATE, clearance=0.0005) == (gap > 0.0005)


@pytest.mark.parametrize("kind", ["box", "cylinder"])
def test_depth_is_the_way_to_the_nearest_face(hulls, kind):
    """The whole arm is inside of a large obstacle."""
    size = 4.0
    obstacle = Box((0.1, 0.0, 0.2), (size, size, size))
    if kind == "cylinder":
        obstacle = Cylinder((0.0, 0.0, 0.2), 30.0, size)  # its bases are much nearer
    checker = CollisionChecker(Scene((obstacle,), table=None, floor=None))
    near = checker.signed_distances(STATE, self_collisions=False)
    assert not checker.is_free(STATE)
    for hull, distance, normal in zip(hulls, near.distance, near.normal, strict=True):
        low, high = hull.min(0) - obstacle.position, hull.max(0) - obstacle.position
        ways = np.concatenate([size / 2 - low, size / 2 + high])  # out by +x +y +z, -x -y -z
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        if kind == "cylinder":
            ways, axes = ways[[2, 5]], axes[[2, 5]]
        assert distance == pytest.approx(-ways.min() - BULLET_MARGIN, abs=1e-5)
        np.testing.assert_allclose(normal, axes[ways.argmin()], atol=1e-3)


def test_geometry_is_the_nearest_obstacle_table_floor_or_arm():
    scene = Scene((Sphere((5.0, 0, 0), 0.1), Sphere((0.9, 0, 0.5), 0.1)))
    states = np.zeros((3, 7))
    states[0] = PANDA.normalise([1.0, 1.1, 0.0, -1.6, 0.0, 2.0, 0.0])  # low over the table
    states[1] = PANDA.normalise([0.0, 0.5, 0.0, -1.2, 0.0, 1.5, 0.0])  # to the sphere
    states[2] = PANDA.normalise([1.0, -0.5, 0.0, -2.6, 0.0, 0.3, 0.0])  # folded together
    geometry = CollisionChecker(scene).signed_distances(states).geometry
    assert (geometry[0] == TABLE).any() and (geometry[1] == 1).any()
    assert (geometry[2] == ARM).any() and not (geometry == 0).any()
    without = CollisionChecker(scene).signed_distances(states, self_collisions=False)
    assert not (without.geometry == ARM).any()
    floor = CollisionChecker(Scene(table=None, floor=0.0)).signed_distances(
        states, self_collisions=False
    )
    assert (floor.geometry == FLOOR).all()


def test_self_distances_agree_with_pybullet(env):
    """Distances of both links of a pair."""
    rng, seen = np.random.default_rng(11), 0
    checker = CollisionChecker(EMPTY)
    for state in rng.uniform(-1, 1, (40, 7)):
        near = checker.signed_distances(state)
        env.world.arm.set_configuration(PANDA.denormalise(state))
        expected = dict.fromkeys(LINKS, 10.0)
        for a, b in PANDA.self_collision_pairs:
            points = p.getClosestPoints(env.body, env.body, 3.0, a, b, physicsClientId=env.client)
            for link in (a, b):
                if link in expected:
                    expected[link] = min(expected[link], points[0][8])
        for link, distance in zip(LINKS, near.distance, strict=True):
            if expected[link] > 1e-4 and expected[link] < 10:
                assert distance == pytest.approx(expected[link], abs=1e-5)
                seen += 1
            elif expected[link] == 10.0:
                assert distance == math.inf
    assert seen > 130


# --- Margins


def test_margin_counts_from_scene_and_links_and_clearance_from_the_scene():
    checker = CollisionChecker(envs.TASKS["wall"].scene)
    states = np.random.default_rng(0).uniform(-1, 1, (2000, 7))
    scene = checker.signed_distances(states, self_collisions=False).distance.min(-1)
    all_ = checker.signed_distances(states).distance.min(-1)
    np.testing.assert_array_equal(checker.is_free(states, margin=0.01), all_ >= 0.01)
    both = checker.is_free(states, margin=0.01, clearance=0.02)
    np.testing.assert_array_equal(both, (all_ >= 0.01) & (scene >= 0.03))
    assert both.sum() < (all_ >= 0.01).sum() < (all_ >= 0).sum()


def test_margins_shrink_near_endpoints():
    checker = CollisionChecker(envs.TASKS["wall"].scene)
    states = np.random.default_rng(1).uniform(-1, 1, (4000, 7))
    distance = checker.signed_distances(states).distance.min(-1)
    near = states[(distance > 0.002) & (distance < 0.01)][:2]
    distances, growth, margin = checker.signed_distances(near).distance.min(-1), 0.01, 0.02
    endpoint_margins = (near, distances - 1e-9, growth)
    assert checker.is_free(near, margin, endpoint_margins=endpoint_margins).all()
    assert not checker.is_free(near, margin).any()
    around = np.clip(near[0] + np.random.default_rng(2).normal(0, 0.03, (3000, 7)), -1, 1)
    away = np.linalg.norm(around[:, None] - near, axis=-1)
    required = np.minimum(margin, (distances - 1e-9 + growth * away).min(-1))
    actual = checker.signed_distances(around).distance.min(-1)
    np.testing.assert_array_equal(
        checker.is_free(around, margin, endpoint_margins=endpoint_margins), actual >= required
    )
    assert 0.1 < (actual >= required).mean() < 0.9


def test_each_motion_may_have_its_own_endpoint_margins():
    scene = envs.get_task("boxes").scene
    checker, rng = CollisionChecker(scene), np.random.default_rng(6)
    states = rng.uniform(-1, 1, (4000, 7))
    ends = states[checker.is_free(states)][:200].reshape(100, 2, 7)
    distances = checker.signed_distances(ends).distance.min(-1) - 1e-6
    starts, stops = ends[:, 0], ends[:, 0] + 0.05 * (ends[:, 1] - ends[:, 0])
    free = checker.is_motion_free(starts, stops, 0.015, endpoint_margins=(ends, distances, 0.1))
    alone = [
        checker.is_motion_free(
            starts[i], stops[i], 0.015, endpoint_margins=(ends[i], distances[i], 0.1)
        )
        for i in range(100)
    ]
    np.testing.assert_array_equal(free, alone)
    assert (free & ~checker.is_motion_free(starts, stops, 0.015)).sum() > 0
    assert (~free).sum() > 0
    single = checker.is_free(starts, 0.015, endpoint_margins=(ends, distances, 0.1))
    assert single.all()
    with pytest.raises(ValueError, match="endpoint_margins"):
        checker.is_free(starts, 0.015, endpoint_margins=(ends[:50], distances[:50], 0.1))


# --- Motions

# The first joint turns from one side of a thin board, which stands upright, to the other.
BOARD = Scene((Box((0.6, 0.0, 0.5), (0.4, 0.004, 0.9)),))
LEFT, RIGHT = (PANDA.normalise([s * 0.7, 0.4, 0, -1.6, 0, 2.0, 0]) for s in (1, -1))


def test_motion_through_a_thin_board_is_not_free():
    checker = CollisionChecker(BOARD)
    assert checker.is_free([LEFT, RIGHT]).all()
    assert not checker.is_motion_free(LEFT, RIGHT)
    assert not checker.is_motion_free(RIGHT, LEFT)
    assert checker.is_motion_free(LEFT, LEFT)
    assert CollisionChecker(Scene()).is_motion_free(LEFT, RIGHT)
    assert checker.is_motion_free(LEFT, [LEFT, RIGHT, LEFT + 0.01]).tolist() == [True, False, True]


def test_continuous_check_finds_what_lies_between_states(wall):
    checker = CollisionChecker(BOARD)
    assert checker.is_motion_free(LEFT, RIGHT, resolution=10.0)  # of its ends alone
    assert not checker.is_motion_free(LEFT, RIGHT, continuous=True)
    assert checker.is_motion_free(LEFT, [LEFT, LEFT + 0.01], continuous=True).all()
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.6, -0.6, 0.1), (0.7, 0.6, 0.9), (20, 3))
    for checker in (wall, CollisionChecker.from_points(points, 0.01)):
        starts = rng.uniform(-1.0, 1.0, (400, 7))
        starts = starts[checker.is_free(starts)]
        ends = (starts + rng.normal(0.0, 0.1, starts.shape)).clip(-1.0, 1.0)
        for margin in (0.0, 0.02):
            clear = checker.is_motion_free(starts, ends, margin, continuous=True)
            fine = checker.is_motion_free(starts, ends, margin, resolution=0.001)
            assert 0.01 < clear.mean() < 0.95
            assert not (clear & ~fine).any() and (fine & ~clear).sum() <= 2


def test_spheres_cover_hulls_and_lie_in_them():
    rng, (_, _, _, vertices, _) = np.random.default_rng(0), arm_hulls(PANDA)
    first = 0
    for number in vertex_counts(PANDA):
        mesh = vertices[first : first + number]
        first += number
        outer, inner = hull_spheres(mesh)
        points = np.concatenate([mesh, rng.dirichlet(np.full(number, 0.05), 3000) @ mesh])
        assert (cdist(points, outer[:, :3]) <= outer[:, 3]).any(1).all()
        planes = ConvexHull(mesh).equations
        depths = -(inner[:, :3] @ planes[:, :3].T + planes[:, 3]).max(1)
        assert (inner[:, 3] > 0.0).all() and (inner[:, 3] <= depths).all()


def test_known_ends_are_not_checked():
    checker = CollisionChecker(BOARD)
    assert checker.motion_checks(LEFT, RIGHT, ends_known=True) < 0  # the board is in the middle
    into = (LEFT + RIGHT) / 2
    pieces = math.ceil(np.linalg.norm(into - LEFT) / collision.RESOLUTION)
    steps = LEFT + (into - LEFT) * np.arange(pieces + 1)[:, None] / pieces
    inside = np.flatnonzero(~checker.is_free(steps))
    before = steps[inside[0] - 1], steps[inside[0]]
    assert not checker.is_motion_free(*before)
    assert checker.is_motion_free(*before, ends_known=True)


@pytest.mark.parametrize("robot", ["panda", "iiwa"])
def test_motion_is_free_where_all_its_states_are(robot):
    """What is remembered along a motion does not change an answer, of any length of motion."""
    file = "" if robot == "panda" else f"@{ROOT / 'examples' / 'robots' / 'iiwa.yaml'}"
    rng = np.random.default_rng(5)
    for _ in range(2):
        scene = envs.get_task(f"random_boxes_hard{file}").scene.sample(rng)
        points = rng.uniform(0.3, 0.9, (20, 3)) * rng.choice([-1.0, 1.0], (20, 3)) * [1, 1, 0.5]
        checker = CollisionChecker(scene, points, 0.01)
        starts = rng.uniform(-1.0, 1.0, (2000, 7))
        starts = starts[checker.is_free(starts, 0.003, 0.005)][:60]
        lengths = rng.choice([0.05, 0.3, 1.5], (len(starts), 1))
        moves = lengths * rng.standard_normal(starts.shape) / math.sqrt(7)
        ends = np.clip(starts + moves, -1.0, 1.0)
        near = ends[:2], np.array([0.001, -0.002]), 0.03
        options = {"margin": 0.003, "clearance": 0.005, "endpoint_margins": near}
        free = checker.is_motion_free(starts, ends, **options)
        assert 0.1 < free.mean() < 0.95
        one = checker.motion_checker(**options)
        for start, end, is_free in zip(starts, ends, free, strict=True):
            assert (one(tuple(start), tuple(end)) > 0) == is_free
            pieces = max(math.ceil(np.linalg.norm(end - start) / RESOLUTION), 1)
            states = start + np.arange(pieces + 1)[:, None] / pieces * (end - start)
            assert checker.is_free(states.clip(-1.0, 1.0), **options).all() == is_free


# --- The same answer whatever the batch


def test_importing_envs_imports_no_numba():
    code = "import sys, roboarm_nmp as r; r.make('wall').reset(); print('numba' in sys.modules)"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout
    assert output == "False\n"


# --- Invalid input


@pytest.fixture(scope="module")
def wall():
    return CollisionChecker(envs.TASKS["wall"].scene)


@pytest.mark.parametrize(
    ("states", "message"),
    [
        (np.full((3, 7), np.nan), "finite"),
        (np.full(7, 1.001), r"in \[-1, 1\]"),
        (np.zeros((3, 6)), r"shape \(..., 7\), got float64 of shape \(3, 6\)"),
        ([[0.0] * 7, [0.0] * 6], "must be numbers"),
    ],
)
def test_bad_states_are_rejected(wall, states, message):
    calls = [wall.is_free, wall.signed_distances, lambda s: wall.is_motion_free(s, np.zeros(7))]
    calls += [lambda s: wall.is_motion_free(np.zeros(7), s)]
    for call in calls:
        with pytest.raises(ValueError, match=message):
            call(states)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": np.nan}, "resolution must be positive"),
        ({"clearance": 0.5}, "clearance must be in"),
        ({"endpoint_margins": (np.zeros((2, 7)), np.zeros(3), 0.1)}, "endpoint_margins"),
        ({"endpoint_margins": (np.zeros((2, 7)), np.zeros(2), -1.0)}, "growth"),
    ],
)
def test_bad_margins_and_resolutions_are_rejected(wall, options, message):
    with pytest.raises(ValueError, match=message):
        wall.is_motion_free(np.zeros(7), np.zeros(7), **options)


def test_empty_scene_has_only_the_arm():
    checker = CollisionChecker(EMPTY)
    near = checker.signed_distances(STATE, self_collisions=False)
    assert (near.distance == np.inf).all() and (near.geometry == NOTHING).all()
    assert not near.normal.any() and not near.witness.any()
    # Clearance counts from obstacles only, a margin from the other links, too.
    assert checker.is_free(STATE, clearance=0.4) and not checker.is_free(STATE, margin=0.4)
    folded = PANDA.normalise([1.0, -0.5, 0.0, -1.8, 0.0, -0.08, 0.0])
    assert checker.is_free([STATE, folded]).tolist() == [True, False]  # the arm itself


def test_empty_batches_have_empty_answers(wall):
    assert wall.is_free(np.empty((0, 7))).shape == (0,)
    assert wall.is_free(np.empty((2, 0, 7))).shape == (2, 0)
    assert wall.is_motion_free(np.empty((0, 7)), np.empty((0, 7))).shape == (0,)
    assert wall.signed_distances(np.empty((0, 7))).normal.shape == (0, len(LINKS), 3)
    assert wall.link_distances(np.empty((2, 0, 7))).shape == (2, 0, len(LINKS), 8)


@pytest.mark.parametrize("self_collisions", [False, True])
def test_link_distances_are_clipped_signed_distances(wall, self_collisions):
    states = np.random.default_rng(3).uniform(-1.1, 1.1, (4, 25, 7)).astype(np.float32)
    states[0, 0, 0] = np.inf
    rows = wall.link_distances(states, self_collisions, within=0.2)
    near = wall.signed_distances(np.clip(states, -1.0, 1.0), self_collisions, within=0.2)
    distances = np.minimum(near.distance, 0.2)[..., None]
    assert 0.1 < (distances < 0.2).mean() < 0.9
    expected = np.concatenate([distances, near.gradient], axis=-1).astype(np.float32)
    assert rows.dtype == np.float32 and (rows == expected).all()
    for bad in (np.full(7, np.nan), np.zeros(6), "near"):
        with pytest.raises(ValueError, match="states must"):
            wall.link_distances(bad)
