"""Show a task in PyBullet's window, as an image, or as an animation of a policy.

    roboarm show double_walls
    roboarm show double_walls --output image.png
    roboarm show my_scene.yaml --output images.png --draws 9
    roboarm show wall --output episode.gif --policy runs/my_run
    roboarm show double_walls --output episode.gif --policy planner

The arm is white; at the goal it is transparent green. The green ball is the goal position of the
end effector. An image shows the start. The window shows the policy's episodes one after another, in
real time, until it is closed, or Escape or Ctrl-C is pressed.
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
from roboarm_nmp.envs import panda
from roboarm_nmp.envs.datasets.demonstrations import Demos, demo_path, load_demos
from roboarm_nmp.envs.datasets.queries import Query, load_queries, query_path
from roboarm_nmp.envs.policies.registry import find_policy, make_policy
from roboarm_nmp.envs.policies.rollout import rollout
from roboarm_nmp.envs.scenes.primitives import to_array
from roboarm_nmp.envs.training import flags
from roboarm_nmp.envs.training.flags import NonNegativeInt, Pixels, PositiveInt, Seed
from roboarm_nmp.envs.utils.bullet import pybullet as p
from roboarm_nmp.envs.utils.files import check_writable, write_atomically
from roboarm_nmp.envs.utils.progress import progress_bar
from roboarm_nmp.envs.utils.signals import end_with_one_line
from roboarm_nmp.envs.world import image_array, why_no_window

SIZE = (640, 480)
OVERSAMPLING = 2  # the software renderer has jagged edges
FIELD_OF_VIEW, PITCH, MARGIN = 40.0, -28.0, 0.05  # degrees, degrees, share of the image
# From the front right, as long as the obstacles do not hide more of the arm's surroundings from
# there than from one of the other corners.
YAWS = (55.0, 125.0, -55.0, -125.0)
AROUND_THE_ARM = [
    [x, y, z] for x in (-0.3, 0, 0.3) for y in (-0.3, 0, 0.3) for z in (0.2, 0.5, 0.8)
]
# Obstacles that reach beyond this box (m) are cut off.
LOWEST, HIGHEST = (-2.0, -2.0, -1.0), (2.0, 2.0, 2.0)
SAME_DEPTH = 1e-4  # about a centimetre: where arm and ghost coincide, the arm is visible
GHOST_COLOUR, GHOST_OPACITY = (0.25, 1.0, 0.4), 0.6
# Of an animation. At the default size a file has about 0.3 MB.
MAX_FRAMES, COLOURS = 60, 128
PAUSE = 1.5  # s, at the end of an episode


@dataclass
class Args:
    task: tyro.conf.Positional[str]
    """The task's name, or the path of a scene file (.yaml)."""
    output: Path | None = None
    """Write this file instead of opening a window: an image (.png) or an animation (.gif)."""
    policy: str = "go-to-goal"
    """The policy in the window and in an animation: `go-to-goal` (straight to the goal
    configuration), `random`, `via-points`, `planner` (as in clean_rl_scripts/evaluate.py), a policy
    network, a run's folder with a `policy.pt` in it, or the name of a pretrained policy
    (docs/benchmark/results.md). `demo` replays the task's demonstrations; --query is then the
    number of a demonstration."""
    query: NonNegativeInt = 0
    """Number of the (first) query to show, from 0."""
    split: Literal["test", "validation", "original"] = "test"
    """Which of the task's queries. Without a query file, random queries are shown."""
    draws: PositiveInt = 1
    """Images in a .png: this many queries, from --query on, side by side. Where scenes vary, each
    query has its own."""
    size: tuple[Pixels, Pixels] = SIZE
    """Width and height of one image in pixels."""
    seed: Seed = 0
    """Of random queries, and of `random`, `via-points` and `planner`."""


class ShowError(ValueError):
    """Something that cannot be shown; the message says why."""


# --- Images


class _Camera(NamedTuple):
    """Where PyBullet's camera is: `distance` m from `target`, a point (3,), m."""

    yaw: float
    distance: float
    target: np.ndarray


class _Shot(NamedTuple):
    """Colours (h, w, 3), depths (h, w), and which pixels show the arm (h, w)."""

    colour: np.ndarray
    depth: np.ndarray
    arm: np.ndarray


def render_query(env, query, size=SIZE, points=()):
    """An image of a query: the arm at the start, and a transparent ghost of it at the goal.

    The camera stands where the whole scene and the arm are visible, and with them bodies that were
    added to `env.client`. It moves the arm: reset the environment afterwards.

    Args:
        env: a `RoboArmEnv`, with `render_mode="rgb_array"` to have the goal marked by a ball.
        query: an `envs.datasets.queries.Query`; a goal that is a position (3,) has no ghost.
        size: (width, height) in pixels.
        points: (n, 3), m: further positions that must be in the image.

    Returns:
        uint8 (height, width, 3).

    Raises:
        ValueError: the environment refuses the query.
    """
    return next(render_configurations(env, query, [query.start], size, points))


def render_configurations(env, query, configurations, size=SIZE, points=()):
    """Images as of `render_query`, from one point of view, with the arm in each configuration.

    Args:
        configurations: (n, 7), joint angles in rad, e.g. of a `Trajectory`.
        env, query, size, points: see `render_query`.

    Yields:
        n images, uint8 (height, width, 3).
    """
    env.world.draw()
    env.reset_specific(*query)
    has_ghost = len(query.goal) == panda.NUM_JOINTS
    poses = [*configurations, *[query.goal] * has_ghost]
    points = np.concatenate([_extent(env, poses), np.reshape(points, (-1, 3))])
    slope = math.tan(math.radians(FIELD_OF_VIEW / 2))
    camera = _camera(env, points, (slope * size[0] / size[1], slope))
    if has_ghost:
        panda.set_configuration(env.client, env.robot, query.goal)
        ghost = _shoot(env, camera, size)
        tinted = ghost.colour.mean(-1, keepdims=True) * GHOST_COLOUR
    for configuration in configurations:
        panda.set_configuration(env.client, env.robot, configuration)
        shot = _shoot(env, camera, size)
        pixels = shot.colour
        if has_ghost:
            visible = ghost.arm & (ghost.depth < shot.depth - SAME_DEPTH)
            mixed = (1 - GHOST_OPACITY) * pixels + GHOST_OPACITY * tinted
            pixels = np.where(visible[..., None], mixed, pixels)
        yield np.asarray(Image.fromarray(pixels.astype(np.uint8)).reduce(OVERSAMPLING))


def _extent(env, configurations):
    """Corners (n, 3), m, of boxes around the obstacles, the table, and the arm in all its poses."""
    solids = [*env.scene.obstacles, *[env.scene.table] * (env.scene.table is not None)]
    rows = to_array(solids)
    # From the sizes in a row to half edges, for each kind: box, cylinder, sphere.
    scale = np.array([[0.5, 0.5, 0.5], [1, 1, 0.5], [1, 1, 1]])[rows[:, 0].astype(int)]
    turns = np.array([p.getMatrixFromQuaternion(row[4:8]) for row in rows]).reshape(-1, 3, 3)
    halves = np.einsum("nij,nj->ni", np.abs(turns), rows[:, 8:] * scale)
    boxes = np.stack([rows[:, 1:4] - halves, rows[:, 1:4] + halves], axis=1)
    boxes = [*np.clip(boxes, LOWEST, HIGHEST)]
    for configuration in configurations:
        panda.set_configuration(env.client, env.robot, configuration)
        for link in range(-1, panda.EE_LINK + 1):
            boxes.append(p.getAABB(env.robot, link, physicsClientId=env.client))
    choices = np.array(list(itertools.product((0, 1), repeat=3)))
    return np.concatenate([np.asarray(box)[choices, [0, 1, 2]] for box in boxes])


def _camera(env, points, slopes):
    """The nearest camera with all points (n, 3), m, in its image. Moves the arm.

    `slopes` are those of the right and upper edge of its field of view.
    """
    # So that all queries of a scene are rendered from the same side, whatever the arm hides.
    panda.set_configuration(env.client, env.robot, (panda.LOWER + panda.UPPER) / 2)
    yaw = min(YAWS, key=lambda yaw: _hidden(env, yaw))
    rotation = _rotation(yaw)
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
    eye[2] = max(nearest)
    distance = eye[2] - points[:, 2].mean()
    return _Camera(yaw, distance, rotation.T @ (eye - [0, 0, distance]))


def _rotation(yaw):
    """The matrix (3, 3) from the world to the camera's axes: right, up, and towards it."""
    view = p.computeViewMatrixFromYawPitchRoll((0, 0, 0), 1.0, yaw, PITCH, 0, 2)
    return np.reshape(view, (4, 4)).T[:3, :3]


def _hidden(env, yaw):
    """The share of points around the arm that obstacles hide, to a tenth."""
    towards = 4.0 * _rotation(yaw)[2]
    eyes = (AROUND_THE_ARM + towards).tolist()
    hits = p.rayTestBatch(eyes, AROUND_THE_ARM, physicsClientId=env.client)
    return round(sum(hit[0] not in (-1, env.robot) for hit in hits) / len(hits), 1)


def _shoot(env, camera, size):
    width, height = OVERSAMPLING * size[0], OVERSAMPLING * size[1]
    light = math.radians(camera.yaw - 10.0)  # from the right, behind the camera
    _, _, pixels, depth, bodies = p.getCameraImage(
        width,
        height,
        p.computeViewMatrixFromYawPitchRoll(
            camera.target.tolist(), camera.distance, camera.yaw, PITCH, 0, 2
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
        np.reshape(bodies, (height, width)) == env.robot,
    )


# --- The command


@dataclass(frozen=True)
class _Queries:
    """The queries to choose from.

    Attributes:
        get: function from a number to a `Query`.
        count: the number of queries; None for random ones without end.
        name: of one of them, in messages.
        demos: the `Demos` of these queries, or None.
    """

    get: Callable
    count: int | None
    name: str
    demos: Demos | None = None


def _find_queries(args):
    if args.policy == "demo":
        path = demo_path(args.task)
        if not path.exists():
            raise ShowError(f"{args.task} has no demonstrations: no file {path}")
        demos = load_demos(args.task)

        def get(number):
            demo = demos[number]
            return Query(demo.start, demo.goal, demo.scene)

        return _Queries(get, len(demos), "demonstration", demos)
    if query_path(args.task).exists():
        queries = load_queries(args.task, args.split)
        return _Queries(queries.__getitem__, len(queries), f"{args.split} query")
    print(f"{args.task} has no query file: random queries of seed {args.seed}")
    env = envs.make(args.task)

    def draw(number):
        rng = np.random.default_rng([args.seed, number])
        env.sample_scene(rng)
        try:
            return Query(*env.sample_query(rng), env.scene)
        except RuntimeError as error:
            raise ShowError(f"{args.task}: {error}") from error

    return _Queries(draw, None, "random query")


def _check(args):
    """Raises ValueError for arguments that cannot be used, before any work."""
    flags.check(args)
    envs.get_task(args.task)
    if args.output is not None:
        if args.output.suffix.lower() not in (".png", ".gif"):
            raise ShowError(f"--output must end in .png or .gif, got {args.output}")
        check_writable(args.output)
    if args.draws > 1 and (args.output is None or args.output.suffix.lower() != ".png"):
        raise ShowError("--draws goes with --output FILE.png")
    if args.output is None and (problem := why_no_window()):
        raise ShowError(
            f"a window needs a display ({problem}); "
            f"--output FILE.png or --output FILE.gif writes a file instead"
        )


def _show(args):
    _check(args)
    suffix = None if args.output is None else args.output.suffix.lower()
    arguments, policy, begin = {}, None, None
    if suffix != ".png" and args.policy != "demo":
        policy, arguments = find_policy(args.policy)
    queries = _find_queries(args)
    last = args.query + args.draws - 1
    if queries.count is not None and last >= queries.count:
        raise ShowError(f"no {queries.name} {last}: the numbers are 0 to {queries.count - 1}")
    try:
        mode = "human" if suffix is None else "rgb_array"
        env = envs.make(args.task, render_mode=mode, **arguments)
    except (TypeError, ValueError) as error:
        raise ShowError(f"{args.policy}: its environment cannot be made: {error}") from error
    try:
        if policy is not None:
            begin = make_policy(policy, env, args.seed)
        {None: _window, ".png": _draw, ".gif": _animate}[suffix](args, env, queries, begin)
    finally:
        if p.isConnected(env.client):  # not after Escape
            env.close()


def _draw(args, env, queries, begin):
    numbers = range(args.query, args.query + args.draws)
    bar = progress_bar(numbers, "drawing", unit="image", transient=True)
    images = [render_query(env, queries.get(number), args.size) for number in bar]
    columns = math.ceil(math.sqrt(args.draws))
    blank = [np.full_like(images[0], 255)] * (-args.draws % columns)
    grid = np.stack(images + blank)
    rows, (height, width) = len(grid) // columns, grid.shape[1:3]
    grid = grid.reshape(rows, columns, height, width, 3).swapaxes(1, 2)
    grid = Image.fromarray(grid.reshape(rows * height, columns * width, 3))
    _save(grid, args.output, "PNG", optimize=True)
    until = f" to {args.query + args.draws - 1}" if args.draws > 1 else ""
    print(f"{args.output}: written, {args.task}, {queries.name} {args.query}{until}")


def _animate(args, env, queries, begin):
    query, trajectory = queries.get(args.query), None
    if queries.demos is None:
        trajectory = rollout(env, query, begin(args.query, query).act)
        configurations = trajectory.configurations
    else:
        configurations = panda.denormalise(queries.demos[args.query].states)
    last = len(configurations) - 1
    steps = [*range(0, last, max(1, math.ceil(last / MAX_FRAMES))), last]
    frames = render_configurations(env, query, configurations[steps], args.size)
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
    text = _outcome(args, queries, args.query, last, trajectory)
    print(f"{args.output}: written, {args.task}, {text}")


def _window(args, env, queries, begin):
    print("Ctrl-C ends, and so does Escape in the window", flush=True)
    client = env.client
    p.configureDebugVisualizer(p.COV_ENABLE_GUI, 0, physicsClientId=client)  # no side panels
    numbers = itertools.count() if queries.count is None else itertools.cycle(range(queries.count))
    try:
        for number in itertools.islice(numbers, args.query, None):
            query, trajectory = queries.get(number), None
            env.reset_specific(*query)
            projection = p.getDebugVisualizerCamera(physicsClientId=client)[3]
            slopes = (1 / projection[0], 1 / projection[5])
            camera = _camera(env, _extent(env, [query.start, query.goal]), slopes)
            p.resetDebugVisualizerCamera(
                camera.distance, camera.yaw, PITCH, camera.target, physicsClientId=client
            )
            if queries.demos is None:
                trajectory = rollout(env, query, begin(number, query).act)
                configurations = trajectory.configurations
            else:
                configurations = panda.denormalise(queries.demos[number].states)
                for configuration in configurations:
                    panda.set_configuration(client, env.robot, configuration)
                    time.sleep(1 / env.metadata["render_fps"])
            text = _outcome(args, queries, number, len(configurations) - 1, trajectory)
            print(text, flush=True)
            time.sleep(PAUSE)
    except p.error:
        if p.isConnected(client):
            raise  # otherwise Escape was pressed


def _outcome(args, queries, number, steps, trajectory):
    """The result of an episode in words; `trajectory` is None for a demonstration."""
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
