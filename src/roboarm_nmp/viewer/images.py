"""Images of queries and configurations, and animations of them.

    image = render_query(env, query)
    frames = render_configurations(env, query, trajectory.configurations)
    save_motions("motion.gif", env, query, [trajectory.configurations])

The arm is white, and the goal position of the end effector is a green ball. Where the goal is a
configuration, a transparent green ghost of the arm shows it. Points of an `ObservedScene` are
orange. The command is `viewer.show`.
"""

import io
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np
from PIL import Image, ImageDraw

from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.point_images import (
    LEFT_OUT_COLOUR,
    OBSERVED_COLOUR,
    PointImage,
    point_image,
)
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.robots.rotations import matrix
from roboarm_nmp.envs.scenes.primitives import Box, ConvexHull, ObservedScene, Sphere
from roboarm_nmp.envs.world import image_array
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.utils.files import write_atomically
from roboarm_nmp.utils.progress import progress_bar

SIZE = (640, 480)
OVERSAMPLING = 2  # the software renderer has jagged edges
FIELD_OF_VIEW = 40.0  # degrees
BORDER = 0.05  # share of the image that stays free at each side
# Yaw and pitch of the camera in degrees, as PyBullet counts them. The first corner is the usual
# one; the others are for scenes whose obstacles hide the arm from there.
PITCH = -28.0
CORNERS = (55.0, 125.0, -55.0, -125.0)
# Points around the arm that should be visible, and the distance to look at them from. In m, for the
# Panda; for other arms in proportion to their reach.
AROUND_THE_ARM = [
    [x, y, z] for x in (-0.3, 0, 0.3) for y in (-0.3, 0, 0.3) for z in (0.2, 0.5, 0.8)
]
EYE_DISTANCE = 4.0
# Obstacles that reach beyond this box are cut off.
LOWEST, HIGHEST = (-2.0, -2.0, -1.0), (2.0, 2.0, 2.0)
SAME_DEPTH = 1e-4  # about a centimetre: where arm and ghost coincide, the arm is visible
GHOST_COLOUR, GHOST_OPACITY = (0.25, 1.0, 0.4), 0.6
ANIMATION_COLOURS = 128
MAX_FRAMES = 60  # of an animation: at the default size, a file has about 0.3 MB
PAUSE = 1.5  # s, at the end of an animation
LEFT_OUT_RADIUS, TRACE_RADIUS = 0.002, 0.006  # m
TRACE_COLOUR = (30, 90, 220)
SWEPT_ARMS, SWEPT_OPACITY = 6, 0.3  # of an image of a motion
BOX_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))


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


def render_query(
    env: gymnasium.Env,
    query: Query,
    size: tuple[int, int] = SIZE,
    points: Sequence | np.ndarray = (),
    camera: tuple[float, float] | None = None,
) -> np.ndarray:
    """An image of a query: the arm at the start, and a transparent ghost of it at the goal.

    With the goal type `ee` the goal is a position, and there is no ghost. It moves the arm: reset
    the environment afterwards.

    Args:
        env: a `RoboArmEnv`, possibly wrapped.
        query: an `datasets.queries.Query`.
        size: (width, height) in pixels.
        points: (n, 3), m: further positions that must be in the image.
        camera: (yaw, pitch) in degrees, as for `--camera`. By default, it looks from a corner from
            which obstacles do not hide the arm.

    Returns:
        uint8 (height, width, 3).
    """
    return next(render_configurations(env, query, [query.start], size, points, camera))


def render_configurations(
    env: gymnasium.Env,
    query: Query,
    configurations: Sequence[np.ndarray] | np.ndarray,
    size: tuple[int, int] = SIZE,
    points: Sequence | np.ndarray = (),
    camera: tuple[float, float] | None = None,
    times: Iterable[float] | None = None,
    left_out: np.ndarray | None = None,
    swept: bool = False,
) -> Iterator[np.ndarray]:
    """Images as of `render_query`, from one point of view, with the arm in each configuration.

    Args:
        times: s, (k,), of each configuration, for moving obstacles; by default 0.
        left_out: m, (n, 3), points that are drawn in grey.
        swept: yield one image: the arm in the first configuration, transparent in some of the
            others, and the path of its end effector (blue).
        configurations: (k, n), joint angles in rad, e.g. of a `Trajectory`.
        env, query, size, points, camera: see `render_query`.

    Yields:
        k images, or one, uint8 (height, width, 3).
    """
    arm_env = env.unwrapped
    assert isinstance(arm_env, RoboArmEnv)
    world, robot = arm_env.world, arm_env.robot
    has_ghost = arm_env.goal_type != "ee"
    times = [0.0] * len(configurations) if times is None else list(times)
    world.draw()
    arm_env.set_scene(query.scene)
    goal_position = robot.forward_kinematics(query.goal)
    world.mark_goal(goal_position, arm_env.ee_tolerance)
    poses = [*configurations, query.goal] if has_ghost else configurations
    visible = np.concatenate(
        [_extent(arm_env, poses, times), [goal_position], np.reshape(points, (-1, 3))]
    )
    view = _camera(arm_env, visible, size, camera)
    clouds = []
    if left_out is not None:
        clouds.append((left_out, LEFT_OUT_RADIUS, LEFT_OUT_COLOUR))
    if isinstance(query.scene, ObservedScene):
        clouds.append((query.scene.points, query.scene.point_radius, OBSERVED_COLOUR))
    cloud = _points_seen(clouds, view, size) if clouds else None
    ghost = trace = None
    others = []
    if swept:
        path = _path_points(robot, configurations), TRACE_RADIUS, TRACE_COLOUR
        trace, others = _points_seen([path], view, size), configurations[1:]
        configurations, times = configurations[:1], times[:1]
    for configuration, seconds in zip(configurations, times, strict=True):
        world.set_time(seconds)
        if has_ghost and (ghost is None or not query.scene.is_static):
            world.arm.set_configuration(query.goal)
            ghost = _shoot(arm_env, view, size)
        world.arm.set_configuration(configuration)
        shot = _with_points(_shoot(arm_env, view, size), cloud)
        for number in np.linspace(0, len(others) - 1, min(SWEPT_ARMS, len(others)), dtype=int):
            world.arm.set_configuration(others[number])
            colours = _with_ghost(shot, _shoot(arm_env, view, size), (1, 1, 1), SWEPT_OPACITY)
            shot = shot._replace(colour=colours)
        pixels = shot.colour if ghost is None else _with_ghost(shot, ghost)
        if trace is not None:  # over the transparent arms, which would pale it
            pixels, _ = trace.over(pixels, shot.depth)
        yield np.asarray(Image.fromarray(pixels.astype(np.uint8)).reduce(OVERSAMPLING))


def _path_points(robot, configurations) -> np.ndarray:
    """Points (n, 3), m, along the end effector's path, no two of which are far apart."""
    path = robot.forward_kinematics(np.asarray(configurations))
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], steps.cumsum()])
    places = np.linspace(0.0, along[-1], 2 + int(along[-1] / TRACE_RADIUS))
    return np.stack([np.interp(places, along, axis) for axis in path.T], axis=1)


def _with_points(shot: _Shot, cloud: PointImage | None) -> _Shot:
    """A shot with points in front of what they hide."""
    if cloud is None:
        return shot
    colour, depth = cloud.over(shot.colour, shot.depth)
    return shot._replace(colour=colour, depth=depth)


def _with_ghost(
    shot: _Shot, ghost: _Shot, colour=GHOST_COLOUR, opacity: float = GHOST_OPACITY
) -> np.ndarray:
    """The colours of a shot, with the arm of another one as a transparent ghost."""
    tinted = ghost.colour.mean(-1, keepdims=True) * colour
    mixed = (1 - opacity) * shot.colour + opacity * tinted
    in_front = ghost.arm & (ghost.depth < shot.depth - SAME_DEPTH)
    return np.where(in_front[..., None], mixed, shot.colour)


def _extent(env: RoboArmEnv, configurations, times) -> np.ndarray:
    """Corners (n, 3), m, of boxes around the obstacles, the table, and the arm in all its poses."""
    scenes = [env.scene] if env.scene.is_static else [env.scene.at(seconds) for seconds in times]
    solids = [obstacle for scene in scenes for obstacle in scene.obstacles]
    if env.scene.table is not None:
        solids.append(env.scene.table)
    lowest, highest = _around_base(env.robot, [LOWEST, HIGHEST])
    boxes = [np.clip(_box_around(solid), lowest, highest) for solid in solids]
    if isinstance(env.scene, ObservedScene) and len(env.scene.points):
        points = np.clip(env.scene.points, lowest, highest)
        boxes.append(np.stack([points.min(0), points.max(0)]))
    for configuration in configurations:
        env.world.arm.set_configuration(configuration)
        for link in range(-1, p.getNumJoints(env.body, physicsClientId=env.client)):
            boxes.append(np.array(p.getAABB(env.body, link, physicsClientId=env.client)))
    return np.concatenate([box[BOX_CORNERS, [0, 1, 2]] for box in boxes])


def _box_around(solid) -> np.ndarray:
    """The lowest and the highest corner (2, 3), m, of the upright box around an obstacle."""
    if isinstance(solid, Sphere):
        return np.array(solid.position) + np.array([[-solid.radius], [solid.radius]])
    if isinstance(solid, ConvexHull):
        points = np.array(solid.vertices)
    elif isinstance(solid, Box):
        points = (BOX_CORNERS - 0.5) * solid.size
    else:
        points = (BOX_CORNERS - 0.5) * (2 * solid.radius, 2 * solid.radius, solid.length)
    points = points @ matrix(solid.orientation).T + solid.position
    return np.stack([points.min(0), points.max(0)])


def _around_base(robot: Robot, points) -> np.ndarray:
    """Points (n, 3), m, around the Panda's base as points around that of a robot."""
    return np.array(robot.base_position) + scale_of(robot) * np.array(points)


def _camera(env: RoboArmEnv, points, size, direction) -> _Camera:
    """The nearest camera with all points (n, 3), m, in its image. Moves the arm."""
    if direction is None:
        # So that all queries of a scene are rendered from the same side, whatever the arm hides.
        env.world.arm.set_configuration(env.robot.contact_free)
        yaw, pitch = min(CORNERS, key=lambda corner: _hidden(env, corner)), PITCH
    else:
        yaw, pitch = direction
    rotation = _rotation(yaw, pitch)
    points = points @ rotation.T  # right, up, towards the camera
    middle = points[:, 2].mean()
    # A point is inside if |x - eye_x| <= slope * (eye_z - z), where slope is that of the field of
    # view's edge. So eye_z is at least (max(x + slope * z) + max(-x + slope * z)) / (2 * slope),
    # and the same for y.
    upwards = math.tan(math.radians(FIELD_OF_VIEW / 2))
    eye, distances = np.zeros(3), []
    for axis, slope in enumerate((upwards * size[0] / size[1], upwards)):
        slope *= 1 - 2 * BORDER
        right = np.max(points[:, axis] + slope * points[:, 2])
        left = np.max(-points[:, axis] + slope * points[:, 2])
        eye[axis] = (right - left) / 2
        distances.append((right + left) / (2 * slope) - middle)
    eye[2] = middle
    return _Camera(yaw, pitch, max(distances), rotation.T @ eye)


def _rotation(yaw: float, pitch: float) -> np.ndarray:
    """The matrix (3, 3) from the world to the camera's axes: right, up, and towards it."""
    view = p.computeViewMatrixFromYawPitchRoll((0, 0, 0), 1.0, yaw, pitch, 0, 2)
    return np.reshape(view, (4, 4)).T[:3, :3]


def _hidden(env: RoboArmEnv, yaw: float) -> float:
    """The share of points around the arm that obstacles hide, to a tenth."""
    points = _around_base(env.robot, AROUND_THE_ARM)
    eyes = points + EYE_DISTANCE * scale_of(env.robot) * _rotation(yaw, PITCH)[2]
    hits = p.rayTestBatch(eyes.tolist(), points.tolist(), physicsClientId=env.client)
    return round(sum(hit[0] not in (-1, env.body) for hit in hits) / len(hits), 1)


def _matrices(camera: _Camera, size):
    """PyBullet's view and projection matrix of a camera."""
    view = p.computeViewMatrixFromYawPitchRoll(
        camera.target.tolist(), camera.distance, camera.yaw, camera.pitch, 0, 2
    )
    return view, p.computeProjectionMatrixFOV(FIELD_OF_VIEW, size[0] / size[1], 0.1, 20.0)


def _points_seen(clouds, camera: _Camera, size) -> PointImage:
    """The points of clouds as of `point_image`, in the size of a shot."""
    width, height = OVERSAMPLING * size[0], OVERSAMPLING * size[1]
    return point_image(clouds, *_matrices(camera, size), (width, height))


def _shoot(env: RoboArmEnv, camera: _Camera, size) -> _Shot:
    width, height = OVERSAMPLING * size[0], OVERSAMPLING * size[1]
    light = math.radians(camera.yaw - 10.0)  # from the right, behind the camera
    _, _, pixels, depth, bodies = p.getCameraImage(
        width,
        height,
        *_matrices(camera, size),
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


def save_motions(
    path: Path,
    env: gymnasium.Env,
    query: Query,
    motions: Sequence[np.ndarray],
    names: Sequence[str] = (),
    size: tuple[int, int] = SIZE,
    camera: tuple[float, float] | None = None,
    left_out: np.ndarray | None = None,
):
    """Write an animation (.gif) of motions in the scene of a query, side by side.

    Args:
        motions: of each, joint angles (k, n), rad, one configuration per step of the environment.
        names: of the motions, written above them.
        env, query, size, camera, left_out: see `render_configurations`.
    """
    last = max(map(len, motions)) - 1
    steps = [*range(0, last, max(1, math.ceil(last / MAX_FRAMES))), last]
    shown = [np.minimum(steps, len(motion) - 1) for motion in motions]
    configurations = [motion[numbers] for motion, numbers in zip(motions, shown, strict=True)]
    images = render_configurations(
        env,
        query,
        np.concatenate(configurations),
        size,
        camera=camera,
        times=np.concatenate(shown) * STEP_SECONDS,
        left_out=left_out,
    )
    number = len(steps) * len(motions)
    images = list(progress_bar(images, "drawing", number, "frame", transient=True))
    columns = [images[i : i + len(steps)] for i in range(0, number, len(steps))]
    for name, column in zip(names, columns, strict=False):
        column[:] = [_with_name(image, name) for image in column]
    frames = [np.concatenate(row, axis=1) for row in zip(*columns, strict=True)]
    save_animation(path, frames, [*np.diff(steps) * STEP_SECONDS, PAUSE])


def _with_name(image: np.ndarray, name: str) -> np.ndarray:
    captioned = Image.fromarray(image)
    ImageDraw.Draw(captioned).text((10, 8), name, (0, 0, 0), font_size=16)
    return np.asarray(captioned)


def save_animation(path: Path, frames: Sequence[np.ndarray], seconds: Iterable[float]):
    """Write images (h, w, 3) as a .gif; each stays for so many seconds."""
    images = [Image.fromarray(frame) for frame in frames]
    # One palette and no dithering: still parts of the scene have the same pixels in all frames.
    # This method keeps the green of the small ball.
    palette = images[0].quantize(ANIMATION_COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=3)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    durations = [round(1000 * duration) for duration in seconds]
    contents = io.BytesIO()
    first.save(contents, "GIF", save_all=True, append_images=others, duration=durations, loop=0)
    write_atomically(path, contents.getbuffer())
