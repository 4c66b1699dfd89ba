"""Show a task in PyBullet's window, as an image, or as an animation of a policy.

    roboarm show double_walls
    roboarm show double_walls --output image.png
    roboarm show my_scene.yaml --output images.png --draws 9
    roboarm show wall --output episode.gif --policy runs/my_run
    roboarm show double_walls --output episode.gif --policy planner
    roboarm show random_boxes_hard --robot ur5.yaml --output image.png
    roboarm show wall --output image.png --camera top
    roboarm show wall --output episode.gif --camera 2.5 90 -20
    roboarm show wall --policy planner --save-trajectory episode.csv
    roboarm show wall --output episode.gif --trajectory episode.csv
    roboarm show --problems problems.h5 --query 3 --output image.png

The arm is white. The green ball is the goal position of the end effector. Where the goal is a
configuration, the arm at the goal is shown in transparent green; the goal type `ee` has no such
configuration. An image shows the start. The window shows the policy's episodes one after another,
in real time, until it is closed, or Escape or Ctrl-C is pressed.
"""

import io
import itertools
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import tyro
from PIL import Image

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import demo_path, load_demos
from roboarm_nmp.datasets.format import OutOfDateError
from roboarm_nmp.datasets.problems import load_problems
from roboarm_nmp.datasets.queries import Query, load_queries, query_path
from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.robots.rotations import matrix
from roboarm_nmp.envs.scenes.primitives import ConvexHull, Scene, to_array
from roboarm_nmp.envs.tasks import task_with_robot
from roboarm_nmp.envs.world import image_array, why_no_window
from roboarm_nmp.evaluation.rollout import rollout
from roboarm_nmp.motions.trajectories import (
    STEP_SECONDS,
    check_ending,
    load_trajectory,
    save_trajectory,
)
from roboarm_nmp.policies.registry import find_policy, make_policy
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.utils.files import check_writable, write_atomically
from roboarm_nmp.utils.flags import NonNegativeInt, Pixels, PositiveInt, Seed
from roboarm_nmp.utils.progress import progress_bar
from roboarm_nmp.utils.signals import end_with_one_line

SIZE = (640, 480)
OVERSAMPLING = 2  # the software renderer has jagged edges
FIELD_OF_VIEW, PITCH, MARGIN = 40.0, -28.0, 0.05  # degrees, degrees, share of the image
# Yaw and pitch in degrees, as PyBullet counts them.
VIEWS = {"front": (90.0, -15.0), "side": (0.0, -15.0), "top": (-90.0, -90.0)}
MAX_DISTANCE = 15.0  # m, of the camera
MAX_SECONDS = 3600  # of a trajectory from a file
# From the front right, as long as the obstacles do not hide more of the arm's surroundings from
# there than from one of the other corners.
YAWS = (55.0, 125.0, -55.0, -125.0)
# In m, for the Panda; for other arms in proportion to their reach.
AROUND_THE_ARM = [
    [x, y, z] for x in (-0.3, 0, 0.3) for y in (-0.3, 0, 0.3) for z in (0.2, 0.5, 0.8)
]
# Obstacles that reach beyond this box are cut off.
LOWEST, HIGHEST = (-2.0, -2.0, -1.0), (2.0, 2.0, 2.0)
EYE_DISTANCE = 4.0
SAME_DEPTH = 1e-4  # about a centimetre: where arm and ghost coincide, the arm is visible
GHOST_COLOUR, GHOST_OPACITY = (0.25, 1.0, 0.4), 0.6
# Of an animation. At the default size a file has about 0.3 MB.
MAX_FRAMES, COLOURS = 60, 128
PAUSE = 1.5  # s, at the end of an episode


@dataclass
class Args:
    task: tyro.conf.Positional[str | None] = None
    """The task's name, or the path of a scene file (.yaml). Not needed with --problems."""
    problems: Path | None = None
    """A file or folder of problems, as of `roboarm import`; --query is the number of a problem."""
    robot: Path | None = None
    """Another arm: a robot's file (.urdf, .yaml; docs/customise/robot.md); same as TASK@FILE."""
    output: Path | None = None
    """Write this file instead of opening a window: an image (.png) or an animation (.gif)."""
    policy: str = "go-to-goal"
    """The policy in the window and in an animation: `go-to-goal` (straight to the goal
    configuration), `random`, `via-points`, `planner` (as in clean_rl_scripts/evaluate.py), a policy
    network, a run's folder with a `policy.pt` in it, or the name of a pretrained policy
    (docs/benchmark/results.md). `demo` replays the task's demonstrations; --query is then the
    number of a demonstration."""
    goal_type: Literal["ee", "config", "combined", "pose"] | None = None
    """What the goal is; by default the policy's own, otherwise `combined`. For `ee`, the goal is a
    position: there is no ghost of the arm."""
    query: NonNegativeInt = 0
    """Number of the (first) query to show, from 0."""
    split: Literal["test", "validation", "original"] = "test"
    """Which of the task's queries. Without a query file, random queries are shown."""
    draws: PositiveInt = 1
    """Images in a .png: this many queries, from --query on, side by side. Where scenes vary, each
    query has its own."""
    size: tuple[Pixels, Pixels] = SIZE
    """Width and height of one image in pixels."""
    camera: Literal["front", "side", "top"] | tuple[float, float, float] | None = None
    """Point of view: `front`, `side` (from the arm's right) or `top`, as near as the whole scene
    allows; or DISTANCE YAW PITCH: m from the middle of the scene, degrees, degrees. Yaw 0 is the
    arm's right, 90 its front, 180 its left; pitch -90 looks straight down, 0 horizontally. By
    default from a corner that obstacles do not hide."""
    trajectory: Path | None = None
    """Play this file (.csv, .npz, .json, .yaml) instead of a policy's episode: one of `roboarm
    retime`, of --save-trajectory, or of one's own. A .csv needs columns `q1` to `q7` (rad; as many
    as joints), and may have `time` (s); a .npz an array `configurations` (k, n), and perhaps
    `times`; a .yaml is ROS's trajectory_msgs/JointTrajectory. The arm is moved without physics, in
    the scene of --query; the ghost is the end."""
    save_trajectory: Path | None = None
    """Write the shown episode to this file (.csv, .npz, .json): configurations, actions, contacts,
    times; or its configurations to a .yaml for ROS. Without --output there is no window then."""
    seed: Seed = 0
    """Of random queries, and of `random`, `via-points` and `planner`."""


class ShowError(ValueError):
    """Something that cannot be shown; the message says why."""


# --- Images


class _Camera(NamedTuple):
    """Where PyBullet's camera is: `distance` m from `target`, a point (3,), m."""

    yaw: float
    pitch: float
    distance: float
    target: np.ndarray


class _Shot(NamedTuple):
    """Colours (h, w, 3), depths (h, w), and which pixels show the arm (h, w)."""

    colour: np.ndarray
    depth: np.ndarray
    arm: np.ndarray


def render_query(env, query, size=SIZE, points=(), camera=None):
    """An image of a query: the arm at the start, and a transparent ghost of it at the goal.

    With the goal type `ee` the goal is a position, and there is no ghost. It moves the arm: reset
    the environment afterwards.

    Args:
        env: a `RoboArmEnv`, with `render_mode="rgb_array"` to have the goal marked by a ball.
        query: an `datasets.queries.Query`.
        size: (width, height) in pixels.
        points: (n, 3), m: further positions that must be in the image.
        camera: one of `VIEWS`, or (distance, yaw, pitch) in m and degrees, as for `--camera`. By
            default, it stands where the whole scene and the arm are visible.

    Returns:
        uint8 (height, width, 3).

    Raises:
        ValueError: the environment refuses the query.
    """
    return next(render_configurations(env, query, [query.start], size, points, camera))


def render_configurations(
    env, query, configurations, size=SIZE, points=(), camera=None, times=None
):
    """Images as of `render_query`, from one point of view, with the arm in each configuration.

    Args:
        times: s, (k,), of each configuration, for moving obstacles; by default 0.
        configurations: (k, n), joint angles in rad, e.g. of a `Trajectory`.
        env, query, size, points, camera: see `render_query`.

    Yields:
        k images, uint8 (height, width, 3).
    """
    env.world.draw()
    env.reset_specific(*query)
    yield from _render(env, query.goal, configurations, size, points, camera, times)


def _render(env, goal, configurations, size, points, view, times):
    """`render_configurations` in the present scene, whose goal is marked."""
    has_ghost = env.goal_type != "ee"
    times = np.zeros(len(configurations)) if times is None else times
    visible = _visible(env, goal, configurations, times)
    points = np.concatenate([visible, np.reshape(points, (-1, 3))])
    slope = math.tan(math.radians(FIELD_OF_VIEW / 2))
    camera, ghost = _camera(env, points, (slope * size[0] / size[1], slope), view), None
    for configuration, seconds in zip(configurations, times, strict=True):
        env.world.set_time(seconds)
        if has_ghost and (ghost is None or not env.scene.is_static):
            env.world.arm.set_configuration(goal)
            ghost = _shoot(env, camera, size)
            tinted = ghost.colour.mean(-1, keepdims=True) * GHOST_COLOUR
        env.world.arm.set_configuration(configuration)
        shot = _shoot(env, camera, size)
        pixels = shot.colour
        if has_ghost:
            visible = ghost.arm & (ghost.depth < shot.depth - SAME_DEPTH)
            mixed = (1 - GHOST_OPACITY) * pixels + GHOST_OPACITY * tinted
            pixels = np.where(visible[..., None], mixed, pixels)
        yield np.asarray(Image.fromarray(pixels.astype(np.uint8)).reduce(OVERSAMPLING))


def _visible(env, goal, configurations, times=(0.0,)):
    """Points (n, 3), m, that must be visible: as `_extent`, and at the goal the arm or a point."""
    if env.goal_type != "ee":
        return _extent(env, [*configurations, goal], times)
    if len(goal) == env.robot.num_joints:
        goal = env.robot.forward_kinematics(goal)
    return np.concatenate([_extent(env, configurations, times), [goal]])


def _extent(env, configurations, times=(0.0,)):
    """Corners (n, 3), m, of boxes around the obstacles, the table, and the arm in all its poses."""
    scenes = [env.scene] if env.scene.is_static else [env.scene.at(seconds) for seconds in times]
    solids = [obstacle for scene in scenes for obstacle in scene.obstacles]
    solids += [env.scene.table] * (env.scene.table is not None)
    hulls = [solid for solid in solids if isinstance(solid, ConvexHull)]
    rows = to_array([solid for solid in solids if not isinstance(solid, ConvexHull)])
    # From the sizes in a row to half edges, for each kind: box, cylinder, sphere.
    scale = np.array([[0.5, 0.5, 0.5], [1, 1, 0.5], [1, 1, 1]])[rows[:, 0].astype(int)]
    turns = np.array([p.getMatrixFromQuaternion(row[4:8]) for row in rows]).reshape(-1, 3, 3)
    halves = np.einsum("nij,nj->ni", np.abs(turns), rows[:, 8:] * scale)
    boxes = [*np.stack([rows[:, 1:4] - halves, rows[:, 1:4] + halves], axis=1)]
    for hull in hulls:
        corners = np.array(hull.vertices) @ matrix(hull.orientation).T + hull.position
        boxes.append(np.stack([corners.min(0), corners.max(0)]))
    boxes = np.reshape(boxes, (-1, 2, 3))
    boxes = [*np.clip(boxes, *_around(env.robot, [LOWEST, HIGHEST]))]
    for configuration in configurations:
        env.world.arm.set_configuration(configuration)
        for link in range(-1, p.getNumJoints(env.body, physicsClientId=env.client)):
            boxes.append(p.getAABB(env.body, link, physicsClientId=env.client))
    choices = np.array(list(itertools.product((0, 1), repeat=3)))
    return np.concatenate([np.asarray(box)[choices, [0, 1, 2]] for box in boxes])


def _around(robot, points):
    """Points (n, 3), m, around the Panda's base as points around that of a robot."""
    return np.array(robot.base_position) + scale_of(robot) * np.array(points)


def _camera(env, points, slopes, view=None):
    """The nearest camera with all points (n, 3), m, in its image. Moves the arm.

    `slopes` are those of the right and upper edge of its field of view; `view` is as `--camera`.
    """
    distance = None
    if view is None:
        # So that all queries of a scene are rendered from the same side, whatever the arm hides.
        env.world.arm.set_configuration(env.robot.contact_free)
        yaw, pitch = min(YAWS, key=lambda yaw: _hidden(env, yaw)), PITCH
    elif view in VIEWS:
        yaw, pitch = VIEWS[view]
    else:
        distance, yaw, pitch = view
    rotation = _rotation(yaw, pitch)
    points = points @ rotation.T  # right, up, towards the camera
    # A point is inside if |x - eye_x| <= slope * (eye_z - z). So eye_z is at least
    # (max(x + slope * z) + max(-x + slope * z)) / (2 * slope), and the same for y.
    eye, nearest = np.zeros(3), []
    for axis, slope in enumerate(slopes):
        slope *= 1 - 2 * MARGIN
        right = np.max(points[:, axis] + slope * points[:, 2])
        left = np.max(-points[:, axis] + slope * points[:, 2])
        eye[axis] = (right - left) / 2
        nearest.append((right + left) / (2 * slope))
    middle = points[:, 2].mean()
    distance = max(nearest) - middle if distance is None else distance
    eye[2] = middle
    return _Camera(yaw, pitch, distance, rotation.T @ eye)


def _rotation(yaw, pitch=PITCH):
    """The matrix (3, 3) from the world to the camera's axes: right, up, and towards it."""
    view = p.computeViewMatrixFromYawPitchRoll((0, 0, 0), 1.0, yaw, pitch, 0, 2)
    return np.reshape(view, (4, 4)).T[:3, :3]


def _hidden(env, yaw):
    """The share of points around the arm that obstacles hide, to a tenth."""
    points = _around(env.robot, AROUND_THE_ARM)
    eyes = points + EYE_DISTANCE * scale_of(env.robot) * _rotation(yaw)[2]
    hits = p.rayTestBatch(eyes.tolist(), points.tolist(), physicsClientId=env.client)
    return round(sum(hit[0] not in (-1, env.body) for hit in hits) / len(hits), 1)


def _shoot(env, camera, size):
    width, height = OVERSAMPLING * size[0], OVERSAMPLING * size[1]
    light = math.radians(camera.yaw - 10.0)  # from the right, behind the camera
    _, _, pixels, depth, bodies = p.getCameraImage(
        width,
        height,
        p.computeViewMatrixFromYawPitchRoll(
            camera.target.tolist(), camera.distance, camera.yaw, camera.pitch, 0, 2
        ),
        p.computeProjectionMatrixFOV(FIELD_OF_VIEW, width / height, 0.1, 20.0),
        lightDirection=(1.4 * math.cos(light), 1.4 * math.sin(light), 2.5),
        lightAmbientCoeff=0.7,
        lightSpecularCoeff=0.02,
        shadow=0,  # its shadows have steps, and make the image dark
        renderer=p.ER_TINY_RENDERER,
        physicsClientId=env.client,
    )
    return _Shot(
        image_array(pixels, width, height).astype(np.float32),
        np.reshape(depth, (height, width)),
        np.reshape(bodies, (height, width)) == env.body,
    )


# --- The command


@dataclass(frozen=True)
class _Queries:
    """The queries to choose from.

    Attributes:
        get: function from a number to a `Query`.
        count: the number of queries; None for random ones without end.
        name: of one of them, in messages.
        replay: function from a number to configurations (k, n), rad, one per `STEP_SECONDS`, to
            show instead of a policy's episode; or None.
    """

    get: Callable
    count: int | None
    name: str
    replay: Callable | None = None


def _find_queries(args):
    if args.trajectory is not None:
        return _file_queries(args)
    if args.problems is not None:
        problems = load_problems(args.problems, envs.get_task(args.task).base_scene.robot)
        return _Queries(problems.query, len(problems), "problem")
    if args.policy == "demo":
        path = demo_path(args.task)
        if not path.exists():
            raise ShowError(f"{args.task} has no demonstrations: no file {path}")
        demos = load_demos(args.task)

        def get(number):
            demo = demos[number]
            return Query(demo.start, demo.goal, demo.scene)

        def replay(number):
            return demos[number].configurations

        return _Queries(get, len(demos), "demonstration", replay)
    return _task_queries(args)


def _task_queries(args):
    """The task's queries; random ones where it has none that fit its scene."""
    reason = "no query file"
    if query_path(args.task).exists():
        try:
            queries = load_queries(args.task, args.split)
            return _Queries(queries.__getitem__, len(queries), f"{args.split} query")
        except OutOfDateError:
            reason = "its queries are out of date and left out"
    print(f"{args.task}: {reason}: random queries of seed {args.seed}")
    env = envs.make(args.task)

    def draw(number):
        rng = np.random.default_rng([args.seed, number])
        env.sample_scene(rng)
        try:
            return Query(*env.sample_moving_query(rng), env.scene)
        except RuntimeError as error:
            raise ShowError(f"{args.task}: {error}") from error

    return _Queries(draw, None, "random query")


def _file_queries(args):
    """From the start to the end of --trajectory, in the scene of a query where scenes vary."""
    task = envs.get_task(args.task)
    trajectory = load_trajectory(args.trajectory, task.base_scene.robot)
    path = trajectory.positions
    if trajectory.duration > MAX_SECONDS:
        raise ShowError(f"{args.trajectory}: it is longer than {MAX_SECONDS} s")
    configurations = trajectory.frames()
    scene = task.scene
    scenes = None if isinstance(scene, Scene) else _task_queries(args)

    def get(number):
        return Query(path[0], path[-1], scenes.get(number).scene if scenes else scene)

    count, name = (scenes.count, scenes.name) if scenes else (None, "query")
    return _Queries(get, count, name, lambda number: configurations)


def _check(args):
    """Raises ValueError for arguments that cannot be used, before any work."""
    flags.check(args)
    if args.problems is not None:
        args.task = "no_obstacles" if args.task is None else args.task
        if args.trajectory is not None or args.policy == "demo":
            raise ShowError(
                "--problems goes with a policy, not with a trajectory or demonstrations"
            )
    if args.task is None:
        raise ShowError("name a task or a scene file, or give --problems FILE")
    args.task = task_with_robot(args.task, args.robot)
    envs.get_task(args.task)
    if args.output is not None:
        if args.output.suffix.lower() not in (".png", ".gif"):
            raise ShowError(f"--output must end in .png or .gif, got {args.output}")
        check_writable(args.output)
    if args.draws > 1 and (args.output is None or args.output.suffix.lower() != ".png"):
        raise ShowError("--draws goes with --output FILE.png")
    if isinstance(args.camera, tuple):
        distance, yaw, pitch = args.camera
        if not (0 < distance <= MAX_DISTANCE and math.isfinite(yaw) and -90 <= pitch <= 90):
            raise ShowError(
                f"--camera DISTANCE YAW PITCH: at most {MAX_DISTANCE:.0f} m, any angle, -90 to 90 "
                f"degrees, got {distance:g} {yaw:g} {pitch:g}"
            )
    if args.trajectory is not None:
        if args.policy != Args.policy:
            raise ShowError("--trajectory plays a file, --policy runs a policy: give one of them")
        if args.draws > 1:
            raise ShowError("--draws goes with queries, not with --trajectory")
    if args.save_trajectory is not None:
        check_ending(args.save_trajectory)
        check_writable(args.save_trajectory)
        if args.trajectory is not None or args.policy == "demo":
            raise ShowError("--save-trajectory goes with a policy: a file need not be saved again")
        if args.output is not None and args.output.suffix.lower() == ".png":
            raise ShowError("--save-trajectory goes with --output FILE.gif, or without --output")
    elif args.output is None and (problem := why_no_window()):
        raise ShowError(
            f"a window needs a display ({problem}); "
            f"--output FILE.png or --output FILE.gif writes a file instead"
        )


def _show(args):
    _check(args)
    if args.output is not None:
        kind = args.output.suffix.lower()
    else:
        kind = "window" if args.save_trajectory is None else "file"
    policy, arguments, begin = None, {}, None
    if args.policy != "demo" and args.trajectory is None:
        policy, arguments = find_policy(args.policy)
    own = arguments.get("goal_type")
    if None not in (own, args.goal_type) and own != args.goal_type:
        raise ShowError(
            f"{args.policy} was trained with the goal type {own!r}, it cannot be shown with "
            f"{args.goal_type!r}"
        )
    goal_type = own or args.goal_type or "combined"
    # An image of the start needs nothing else of the policy.
    arguments = {} if kind == ".png" else arguments
    queries = _find_queries(args)
    last = args.query + args.draws - 1
    if queries.count is not None and last >= queries.count:
        raise ShowError(f"no {queries.name} {last}: the numbers are 0 to {queries.count - 1}")
    try:
        mode = {"window": "human", "file": None}.get(kind, "rgb_array")
        env = envs.make(args.task, render_mode=mode, **arguments | {"goal_type": goal_type})
    except (TypeError, ValueError) as error:
        raise ShowError(f"{args.policy}: its environment cannot be made: {error}") from error
    try:
        if policy is not None and kind != ".png":
            begin = make_policy(policy, env, args.seed)
        command = {"window": _window, "file": _record, ".png": _draw, ".gif": _animate}[kind]
        command(args, env, queries, begin)
    finally:
        if p.isConnected(env.client):  # not after Escape
            env.close()


def _draw(args, env, queries, begin):
    bar = progress_bar(
        range(args.query, args.query + args.draws), "drawing", unit="image", transient=True
    )
    images = []
    for number in bar:
        query = queries.get(number)
        images += _images(args, env, queries, query, [query.start])
    columns = math.ceil(math.sqrt(args.draws))
    blank = [np.full_like(images[0], 255)] * (-args.draws % columns)
    grid = np.stack(images + blank)
    rows, (height, width) = len(grid) // columns, grid.shape[1:3]
    grid = grid.reshape(rows, columns, height, width, 3).swapaxes(1, 2)
    grid = Image.fromarray(grid.reshape(rows * height, columns * width, 3))
    _save(grid, args.output, "PNG", optimize=True)
    until = f" to {args.query + args.draws - 1}" if args.draws > 1 else ""
    print(f"{args.output}: written, {args.task}, {queries.name} {args.query}{until}")


def _images(args, env, queries, query, configurations, times=None):
    """Images of configurations (k, n), rad, in the scene of a query, with its goal."""
    options = args.size, (), args.camera, times
    if queries.replay is None:
        yield from render_configurations(env, query, configurations, *options)
        return
    _place(env, query)
    yield from _render(env, query.goal, configurations, *options)


def _place(env, query):
    """Show a query's scene and goal, without a reset: the ends of a file may be in collision."""
    env.world.draw()
    env.set_scene(query.scene)
    env.world.mark_goal(env.robot.forward_kinematics(query.goal), env.ee_tolerance)


def _animate(args, env, queries, begin):
    query, trajectory = queries.get(args.query), None
    if queries.replay is None:
        trajectory = rollout(env, query, begin(args.query, query).act)
        configurations = trajectory.configurations
    else:
        configurations = queries.replay(args.query)
    text = _outcome(args, env, queries, args.query, query, configurations, trajectory)
    last = len(configurations) - 1
    steps = [*range(0, last, max(1, math.ceil(last / MAX_FRAMES))), last]
    times = np.array(steps) * STEP_SECONDS
    frames = _images(args, env, queries, query, configurations[steps], times)
    bar = progress_bar(frames, "drawing", len(steps), unit="frame", transient=True)
    frames = [Image.fromarray(frame) for frame in bar]
    # One palette and no dithering: still parts of the scene have the same pixels in all frames.
    # This method keeps the green of the small ball.
    palette = frames[0].quantize(COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=3)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    seconds = [*np.diff(steps) / env.metadata["render_fps"], PAUSE]
    _save(
        frames[0],
        args.output,
        "GIF",
        save_all=True,
        append_images=frames[1:],
        duration=[round(1000 * one) for one in seconds],
        loop=0,
    )
    print(f"{args.output}: written, {args.task}, {text}")
    if args.save_trajectory is not None:
        save_trajectory(args.save_trajectory, trajectory)
        print(f"{args.save_trajectory}: written, the trajectory")


def _record(args, env, queries, begin):
    query = queries.get(args.query)
    trajectory = rollout(env, query, begin(args.query, query).act)
    save_trajectory(args.save_trajectory, trajectory)
    configurations = trajectory.configurations
    text = _outcome(args, env, queries, args.query, query, configurations, trajectory)
    print(f"{args.save_trajectory}: written, {args.task}, {text}")


def _window(args, env, queries, begin):
    print("Ctrl-C ends, and so does Escape in the window", flush=True)
    client = env.client
    p.configureDebugVisualizer(p.COV_ENABLE_GUI, 0, physicsClientId=client)  # no side panels
    if args.trajectory is not None:
        numbers = itertools.repeat(args.query)
    elif queries.count is None:
        numbers = itertools.count(args.query)
    else:
        numbers = itertools.islice(itertools.cycle(range(queries.count)), args.query, None)
    try:
        for number in numbers:
            query, trajectory = queries.get(number), None
            if queries.replay is None:
                env.reset_specific(*query)
            else:
                _place(env, query)
            projection = p.getDebugVisualizerCamera(physicsClientId=client)[3]
            slopes = (1 / projection[0], 1 / projection[5])
            visible = _visible(env, query.goal, [query.start])
            camera = _camera(env, visible, slopes, args.camera)
            p.resetDebugVisualizerCamera(
                camera.distance, camera.yaw, camera.pitch, camera.target, physicsClientId=client
            )
            if queries.replay is None:
                trajectory = rollout(env, query, begin(number, query).act)
                configurations = trajectory.configurations
            else:
                configurations = queries.replay(number)
                for step, configuration in enumerate(configurations):
                    env.world.set_time(step * STEP_SECONDS)
                    env.world.arm.set_configuration(configuration)
                    time.sleep(1 / env.metadata["render_fps"])
            text = _outcome(args, env, queries, number, query, configurations, trajectory)
            print(text, flush=True)
            time.sleep(PAUSE)
    except p.error:
        if p.isConnected(client):
            raise  # otherwise Escape was pressed


def _outcome(args, env, queries, number, query, configurations, trajectory):
    """The result of an episode in words; `trajectory` is None where none was simulated."""
    steps = len(configurations) - 1
    if args.trajectory is not None:
        env.set_scene(query.scene)
        times = np.arange(len(configurations)) * STEP_SECONDS
        colliding = sum(map(env.in_collision, configurations, times))
        contact = f"in collision in {colliding} of {steps + 1} configurations"
        contact = contact if colliding else "collision-free"
        return f"{args.trajectory}: {steps * STEP_SECONDS:.1f} s, {contact}"
    if trajectory is None:
        return f"{queries.name} {number}: {steps} steps"
    reached = "reached the goal" if trajectory.success else "did not reach the goal"
    contact = "with contact" if trajectory.collides else "collision-free"
    return f"{queries.name} {number}, {args.policy}: {reached} in {steps} steps, {contact}"


def _save(image, path, kind, **options):
    contents = io.BytesIO()
    image.save(contents, kind, **options)
    write_atomically(path, contents.getbuffer())


def main(arguments=None):
    """The command. Returns the exit code: 0, or 2 where nothing can be shown."""
    args = flags.parse(Args, arguments, others="image")
    try:
        _show(args)
    except (OSError, ValueError) as error:
        print(f"error: {error}".replace("\n", " "), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    end_with_one_line("nothing was written")
    sys.exit(main())
