"""Odd arguments of environments, scenes and sensors; odd actions and queries."""

import dataclasses
import functools
import random
import warnings

import numpy as np
import torch

from attacks.children import RAN, REFUSED
from roboarm_nmp import envs
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.goals import GOAL_TYPES
from roboarm_nmp.envs.perception import sensors
from roboarm_nmp.envs.perception.sensors import SensorWorld
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes import primitives as scenes
from roboarm_nmp.envs.world import World
from roboarm_nmp.utils.bullet import pybullet as p

NUMBERS = (0, 1, -1, 2, 0.5, -0.5, 1e-6, 20, 2**31, 2**63, 10**400, 1e300, 1e-320)
ODD = (*NUMBERS, float("nan"), float("inf"), True, None, "", "ee", "x", b"x", 1j, (), [], {})
ODD += ((1, 2), (-1, 5), (70_000, 70_000), [1, 2, 3], {"a": 1}, object(), range(3), slice(None))
ODD += (np.float32(3), np.array(2), np.arange(7), np.zeros((0, 7)), np.datetime64("2026-01-01"))
ODD += (torch.tensor(1.0), torch.zeros(7, dtype=torch.bfloat16), np.ma.masked)
GOOD_VALUES = {
    "episodes_per_scene": (1, 3),
    "goal_type": tuple(GOAL_TYPES),
    "action_mode": ("relative", "subgoal"),
    "horizon": (1, 50),
    "velocities": (False, True),
    "render_mode": (None, "rgb_array"),
    "encoder": (None, "oracle", "point_cloud"),
    "num_points": (1, 64),
    "geometry_source": (None, "ground_truth", "point_cloud"),
    "link_distances": (False, True),
    "append_link_distances": (False, True),
    "goal_link_distances": (False, True),
}
ARGUMENTS = [*GOOD_VALUES, "ee_tolerance", "config_tolerance", "max_step", "stop_on_collision"]
ARGUMENTS += ["reward", "sink_state", "render_size", "scene", "no_such_argument"]


def make_and_step(rng):
    """An environment with one to three odd arguments."""
    chosen = rng.sample(ARGUMENTS, rng.randint(1, 3))
    arguments = {
        name: rng.choice(GOOD_VALUES.get(name, ODD) if rng.random() < 0.5 else ODD)
        for name in chosen
    }
    task = rng.choice(["wall", "random_boxes_hard"]) if rng.random() < 0.95 else rng.choice(ODD)
    try:
        env = envs.make(task, **arguments)
    except TypeError as error:
        # Python itself may refuse an unknown name, or a value that is no text, scene or path.
        if {"no_such_argument", "scene"} & set(chosen) or not isinstance(task, str):
            return REFUSED
        raise error
    try:
        env.reset(seed=rng.randrange(2**32))
        env.action_space.seed(0)
        for _ in range(3):
            observation, reward, *_ = env.step(env.action_space.sample())
            assert np.isfinite(observation["observation"]).all() and np.isfinite(reward)
        if arguments.get("render_mode") == "rgb_array":
            env.render()
    finally:
        env.close()
    return RAN


def act_oddly(rng):
    """An odd action: it is rejected and nothing moves, or it is a step like any other."""
    env = _environment()
    numbers = [rng.choice(NUMBERS) for _ in range(7)]
    action = rng.choice(
        [
            rng.choice(ODD),
            numbers,
            np.array(numbers, object),
            np.zeros(rng.randint(0, 9)),
            np.zeros((1, 7)),
            np.zeros(7, complex),
            np.ma.masked_array(np.zeros(7), [True] * 7),
            torch.zeros(7).to_sparse(),
            np.full(7, rng.choice([np.nan, np.inf, 1e38, -1e30])),
            [None] * 7,
            [0.0] * 6 + [rng.choice(ODD)],
        ]
    )
    before = _joints(env)
    try:
        observation, *_ = env.step(action)
    except ValueError:
        assert _joints(env) == before, "it moved"
        return REFUSED
    assert np.isfinite(observation["observation"]).all()
    return RAN


def begin_oddly(rng):
    """Odd starts, goals and scenes."""
    env = _environment()
    good = np.array([0.0, -0.5, 0.0, -1.5, 0.0, 1.0, 0.8])
    query = [good, good, rng.choice([None, scenes.Scene()])]
    for _ in range(rng.randint(1, 2)):
        place = rng.randrange(3)
        query[place] = rng.choice(ODD)
        if place < 2 and rng.random() < 0.5:
            query[place] = good.astype(object)
            query[place][rng.randrange(7)] = rng.choice(NUMBERS)
    try:
        if rng.random() < 0.5:
            observation, _ = env.reset_specific(*query)
        else:
            options = dict(zip(("start", "goal", "scene"), query, strict=True))
            if rng.random() < 0.3:
                options[rng.choice([*ODD[:8], "Start", "seed", "start "])] = good
            observation, _ = env.reset(options=rng.choice([options] * 9 + [rng.choice(ODD)]))
    except ValueError:
        return REFUSED
    except TypeError:
        if isinstance(query[2], (scenes.Scene, type(None))):
            raise
        return REFUSED
    assert np.isfinite(observation["observation"]).all()
    return RAN


def build(rng):
    """A scene of odd obstacles, in the engine and in the compiled checks."""
    kind = rng.choice([scenes.Box, scenes.Cylinder, scenes.Sphere])
    good = {"position": (0.5, 0.1, 0.3), "size": (0.1, 0.1, 0.2), "radius": 0.1, "length": 0.2}
    fields = {f.name: good.get(f.name, scenes.IDENTITY) for f in dataclasses.fields(kind)}
    arguments = {}
    if rng.random() < 0.7:
        name = rng.choice(list(fields))
        fields[name] = rng.choice(ODD)
        if isinstance(good.get(name, scenes.IDENTITY), tuple) and rng.random() < 0.7:
            size = len(good.get(name, scenes.IDENTITY))
            fields[name] = tuple(rng.choice((*NUMBERS, 0.3)) for _ in range(size))
    else:
        arguments[rng.choice(["table", "floor", "friction", "obstacles"])] = rng.choice(ODD)
    try:
        scene = scenes.Scene(**{"obstacles": (kind(**fields),)} | arguments)
    except (TypeError, ValueError):
        return REFUSED
    world = World(scene)
    world.in_collision(PANDA.denormalise(np.zeros(7)))
    world.close()
    checker = CollisionChecker(scene)
    assert np.isfinite(checker.signed_distances(np.zeros((1, 7))).distance).all()
    return RAN


def look(rng):
    """An odd sensor."""
    kind = rng.choice([sensors.Camera, sensors.PointCloud])
    fields = {"eye": (1.6, 0.0, 0.8)}
    fields |= {"size": (8, 8)} if kind is sensors.Camera else {"num_samples": 64}
    names = [field.name for field in dataclasses.fields(kind)]
    for name in rng.sample(names, rng.randint(1, 2)):
        fields[name] = rng.choice(ODD)
        if name in ("eye", "target", "up") and rng.random() < 0.7:
            fields[name] = tuple(rng.choice(NUMBERS) for _ in range(3))
    try:
        sensor = kind(**fields)
    except (TypeError, ValueError):
        return REFUSED
    pixels = np.prod(getattr(sensor, "size", None) or sensor.num_samples)
    if pixels > 10**6:  # allowed, and slow
        return RAN
    world = SensorWorld()
    world.show(scenes.Scene(), PANDA.observed_pose)
    for output, space in sensor.space.spaces.items():
        assert space.contains(sensor.observe(world)[output]), output
    world.close()
    return RAN


@functools.cache
def _shared_environment():
    """The same for all attempts of a process."""
    return envs.make("wall")


def _environment():
    env = _shared_environment()
    env.reset(seed=0)
    return env


def _joints(env):
    return [state[:2] for state in p.getJointStates(env.body, range(7), physicsClientId=env.client)]


KINDS = (make_and_step, act_oddly, begin_oddly, build, look)


def attempts(seed, folder):
    """The attempt: a function from a number to the outcome of odd arguments."""

    def attempt(number):
        warnings.simplefilter("ignore")  # NumPy's
        rng = random.Random(f"{seed} {number}")
        try:
            return KINDS[number % len(KINDS)](rng)
        except ValueError:
            return REFUSED

    return attempt
