"""Describe a robot, and verify its description against PyBullet.

    roboarm robot check ur5.yaml
    roboarm robot check ur5.yaml --image ur5.png

Prints joints, limits, links and the pairs of links that may collide. Then it compares forward
kinematics and compiled collision checks with PyBullet, and measures how well the arm follows
commands and holds configurations. The exit code is 1 if one of them is out of its tolerance.

The image has three random feasible configurations, end-effector positions behind the arm (orange),
and the table of the pairs of links that may collide.
"""

import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont

from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.robots.control import calibrate
from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.tasks import get_task, with_robot
from roboarm_nmp.envs.world import World
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.utils.files import check_writable
from roboarm_nmp.utils.flags import PositiveInt, Seed, check
from roboarm_nmp.utils.signals import error_line
from roboarm_nmp.viewer.images import render_configurations

SCENES_TASK = "random_boxes_hard"  # of the collision checks that are compared
PER_SCENE = 100
HELD_POSES = 200
# Tolerances.
MAX_POSITION_ERROR = 1e-4  # m
BULLET_PRECISION = 5e-5  # m: Bullet's GJK stops that far from the distance of round shapes
MIN_EXECUTED, MIN_HELD = 0.7, 0.9  # shares
# Of the image: pixels, poses, and positions of the workspace.
POSE_SIZE, WORKSPACE_SIZE = (360, 300), (540, 450)
NUM_POSES, NUM_POSITIONS = 3, 6_000
SIDE = (0.0, -15.0)  # yaw and pitch, degrees
BEAD = 0.006  # share of the reach: half the edge of a position's cube
MOTION_LIMITS = {"velocity": 10, "acceleration": 14, "jerk": 10}  # columns and their widths
MAY_COLLIDE, NEVER = (235, 120, 40), (232, 232, 232)


@dataclass
class Args:
    robot: tyro.conf.Positional[str]
    """`panda`, or a robot's file (.urdf, .yaml)"""
    configurations: PositiveInt = 10_000
    """configurations at which collision checks are compared"""
    image: Path | None = None
    """file of the image (.png); by default the name of the robot's file and _check.png"""
    seed: Seed = 0
    """of the configurations"""


class Agreement(NamedTuple):
    """Compiled collision checks beside PyBullet's.

    number: of configurations. free: share that is free. differences: what is near, in words, where
    the answers differ, and its distance (m), those within `BULLET_PRECISION` of contact left out.
    """

    number: int
    free: float
    differences: list[tuple[str, float]]


def position_error(robot: Robot, rng: np.random.Generator, number: int = 500) -> float:
    """Largest distance (m) of forward kinematics from PyBullet's end effector."""
    world = World(Scene(table=None, floor=None, robot=robot), drawn=False)
    worst = 0.0
    for configuration in rng.uniform(robot.lower, robot.upper, (number, robot.num_joints)):
        world.arm.set_configuration(configuration.tolist())
        error = world.read_arm()[2] - robot.forward_kinematics(configuration)
        worst = max(worst, float(np.linalg.norm(error)))
    world.close()
    return worst


def compare_checks(robot: Robot, rng: np.random.Generator, number: int, scenes=None) -> Agreement:
    """The `Agreement` at random configurations in random scenes.

    Args:
        robot: the `Robot`.
        rng: a NumPy Generator.
        number: of configurations, `PER_SCENE` in each scene.
        scenes: a distribution of scenes with this robot; by default random boxes.
    """
    from roboarm_nmp.envs.collision.checker import CollisionChecker  # Numba takes long to import

    scenes = scenes or with_robot(get_task(SCENES_TASK).scene, robot)
    assert not isinstance(scenes, Scene)
    world = World(scenes.base, drawn=False)
    checked, free = 0, 0
    differences = []
    while checked < number:
        scene = scenes.sample(rng)
        world.set_scene(scene)
        checker = CollisionChecker(scene)
        states = rng.uniform(-1.0, 1.0, (min(PER_SCENE, number - checked), robot.num_joints))
        for state, is_free in zip(states, checker.is_free(states), strict=True):
            expected = not world.in_collision(robot.denormalise(state).tolist())
            free += expected
            if expected != is_free:
                near = checker.signed_distances(state)
                distance = float(near.distance.min())
                if abs(distance) > BULLET_PRECISION:
                    differences.append((_nearest(near, scene), distance))
        checked += len(states)
    world.close()
    return Agreement(checked, free / checked, differences)


def _nearest(near, scene):
    """What is nearest by the `SignedDistances` of a configuration, in words."""
    from roboarm_nmp.envs.collision.checker import ARM, FLOOR, TABLE

    robot = scene.robot
    rows = np.flatnonzero(near.distance <= near.distance.min() + 1e-9)
    links = [robot.link_names[robot.collision_links[row]] for row in rows]
    kind = int(near.geometry[rows[0]])
    if kind == ARM:
        return " and ".join(links) if len(links) > 1 else f"{links[0]} and the base"
    other = {TABLE: "the table", FLOOR: "the floor"}.get(kind)
    return f"{links[0]} and {other or 'a ' + type(scene.obstacles[kind]).__name__}"


def held_share(robot: Robot, rng: np.random.Generator, number: int = HELD_POSES) -> float:
    """Share of the contact-free configurations, without obstacles, that the controller holds."""
    world = World(Scene(robot=robot), drawn=False)
    held, tried = 0, 0
    while tried < number:
        configuration = rng.uniform(robot.lower, robot.upper)
        if not world.in_collision(configuration.tolist()):
            tried += 1
            held += world.is_feasible(configuration)
    world.close()
    return held / number


def describe(robot: Robot) -> str:
    """The description of a robot: text of several lines."""
    lines = [
        f"{robot.name}: {robot.num_joints} joints, reach {robot.reach:.2f} m, {robot.urdf}",
        f"{'joint':<28}{'lower':>9}{'upper':>9}"
        + "".join(f"{name:>{width}}" for name, width in MOTION_LIMITS.items())
        + f"{'effort':>9}",
    ]
    for i, name in enumerate(robot.joint_names):
        line = f"{name:<28}{robot.lower[i]:>9.3f}{robot.upper[i]:>9.3f}"
        for limit, width in MOTION_LIMITS.items():
            values = getattr(robot, limit)
            line += f"{'unknown':>{width}}" if values is None else f"{values[i]:>{width}.2f}"
        lines.append(f"{line}{robot.effort[i]:>9.0f}")
    if robot.datasheet_lower is not None and robot.datasheet_upper is not None:
        pairs = zip(robot.datasheet_lower, robot.datasheet_upper, strict=True)
        lines.append(f"datasheet: {', '.join(f'{low:.3f} to {high:.3f}' for low, high in pairs)}")
    names = robot.link_names
    still = [names[link.index] for link in robot.links if link.frame < 0]
    offset = ", ".join(f"{x:g}" for x in robot.end_effector_offset)
    lines += [
        f"links that move and may collide: {', '.join(names[i] for i in robot.collision_links)}",
        f"links that do not move: {', '.join(still) or 'none'}",
        f"end effector: ({offset}) m in {names[robot.end_effector_link]}",
        f"pairs of links that may collide ({len(robot.self_collision_pairs)}):",
    ]
    for a in sorted({pair[0] for pair in robot.self_collision_pairs}):
        others = [names[pair[1]] for pair in robot.self_collision_pairs if pair[0] == a]
        lines.append(f"  {names[a]:<26}{', '.join(others)}")
    return "\n".join(lines)


def draw(robot: Robot, rng: np.random.Generator) -> Image.Image:
    """An image of the robot: configurations, workspace, and pairs of links that may collide."""
    scene = Scene(robot=robot)
    env = RoboArmEnv(scene)
    poses = [env.sample_feasible(rng) for _ in range(NUM_POSES)]
    query = Query(poses[0], poses[1], scene)
    images = list(render_configurations(env, query, poses, POSE_SIZE))
    behind = _behind(robot, rng)
    bead = p.createVisualShape(
        p.GEOM_BOX,
        halfExtents=[BEAD * robot.reach] * 3,
        rgbaColor=(0.9, 0.4, 0.1, 1),
        physicsClientId=env.client,
    )
    p.createMultiBody(
        baseVisualShapeIndex=bead, batchPositions=behind.tolist(), physicsClientId=env.client
    )
    images += render_configurations(env, query, poses[:1], WORKSPACE_SIZE, behind, SIDE)
    env.close()
    images.append(draw_pairs(robot, WORKSPACE_SIZE))
    top = np.concatenate(images[:NUM_POSES], axis=1)
    bottom = np.concatenate(images[NUM_POSES:], axis=1)
    return Image.fromarray(np.concatenate([top, bottom]))


def _behind(robot, rng):
    """End-effector positions (m) of random configurations, those on the arm's left."""
    configurations = rng.uniform(robot.lower, robot.upper, (NUM_POSITIONS, robot.num_joints))
    positions = robot.forward_kinematics(configurations)
    return positions[positions[:, 1] > robot.base_position[1]]


def draw_pairs(robot: Robot, size: tuple[int, int]) -> np.ndarray:
    """An image of the links as rows and columns: uint8 (height, width, 3)."""
    names = robot.link_names
    links = sorted(link.index for link in robot.links)
    image = Image.new("RGB", size, "white")
    painter, font = ImageDraw.Draw(image), ImageFont.load_default(12)
    left = size[0] // 3
    cell = min((size[0] - left) // len(links), (size[1] - 40) // len(links))
    painter.text((10, 8), "pairs of links that may collide (orange)", "black", font)
    for row, a in enumerate(links):
        top = 32 + row * cell
        painter.text((left - 6, top + cell // 2), names[a][-30:], "black", font, anchor="rm")
        for column, b in enumerate(links):
            corner = left + column * cell, top
            pair = tuple(sorted((a, b)))
            colour = MAY_COLLIDE if pair in robot.self_collision_pairs else NEVER
            painter.rectangle((*corner, corner[0] + cell - 2, top + cell - 2), colour)
    return np.asarray(image)


def main(args: Args) -> bool:
    """Print the description and the verification. Returns whether all is within tolerance."""
    robot = load_robot(args.robot)
    image = args.image or Path(f"{Path(args.robot).stem}_check.png")
    if image.suffix.lower() != ".png":
        raise ValueError(f"--image must end in .png, got {image}")
    check_writable(image)
    print(describe(robot))
    rng = np.random.default_rng(args.seed)
    error = position_error(robot, rng)
    agreement = compare_checks(robot, rng, args.configurations)
    executed = calibrate(robot, gains=robot.gains[:1])[1]
    held = held_share(robot, rng)
    differences = agreement.differences
    checks = (
        f"collision checks: {len(differences)} of {agreement.number:,} differ from PyBullet's "
        f"({agreement.free:.0%} of the configurations are free)"
    )
    if differences:
        names = Counter(name for name, _ in differences).most_common(3)
        deepest = max(abs(distance) for _, distance in differences)
        checks += f", by up to {deepest * 1000:.2f} mm, most often of "
        checks += "; ".join(f"{name} ({number})" for name, number in names)
    results = [
        (
            error <= MAX_POSITION_ERROR,
            f"forward kinematics: at most {error * 1000:.4f} mm from PyBullet's",
            "A joint's axis or origin is read differently: look at the joints above, and report it",
        ),
        (
            not differences,
            checks,
            "Give these links meshes as collision shapes, or plan with a margin beyond that depth, "
            "and report it",
        ),
        (
            executed >= MIN_EXECUTED,
            f"controller: {executed:.2f} of a commanded step is executed (gain {robot.gains[0]:g})",
            "Masses may be too large for the joints' effort limits: correct these in the URDF",
        ),
        (
            held >= MIN_HELD,
            f"controller: {held:.1%} of contact-free configurations are held",
            "Raise the joints' effort limits in the URDF, or correct the links' masses",
        ),
    ]
    for is_good, text, advice in results:
        print(f"ok  {text}" if is_good else f"BAD {text}. {advice}.")
    draw(robot, rng).save(image)
    print(f"{image}: written, poses, workspace and pairs of links")
    return all(is_good for is_good, _, _ in results)


if __name__ == "__main__":
    if sys.argv[1:2] != ["check"]:
        print("usage: roboarm robot check FILE [--help]")
        sys.exit(0 if sys.argv[1:2] in (["-h"], ["--help"]) else 2)
    args = tyro.cli(Args, args=sys.argv[2:], prog="roboarm robot check", description=__doc__)
    try:
        check(args)
        sys.exit(0 if main(args) else 1)
    except (OSError, RuntimeError, ValueError) as error:
        print(error_line(error), file=sys.stderr)
        sys.exit(2)
