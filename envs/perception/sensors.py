"""Sensors: cameras and point clouds (paper, section 4).

A sensor is plain data: its place, its viewing direction, its outputs. It observes a `SensorWorld`,
a scene with the arm at joint angles. So observing never changes an episode, and the goal's marker
is invisible. `envs.wrappers.SensorWrapper` adds sensors to an environment.

Depth, classes and points come from compiled ray casting (`envs.perception.ray_casting`), colours
from PyBullet. Noise: `envs.perception.noise`.
"""

import functools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import gymnasium as gym
import numpy as np

from roboarm_nmp.envs.perception.noise import NO_NOISE, NoiseOfEpisode, SensorNoise
from roboarm_nmp.envs.perception.ray_casting import NOTHING, OBSTACLE, ROBOT, STATIC, RayCaster  # noqa: F401
from roboarm_nmp.envs.perception.ray_kernels import AXES, EYE, VIEW, points_of_pixels
from roboarm_nmp.envs.robots.body import Body
from roboarm_nmp.envs.robots.panda import PANDA, scale_of
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.numbers import MAX_LENGTH, Vector, is_number
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.world import MAX_EDGE, World, image_array
from roboarm_nmp.utils.bullet import pybullet as p

ROBOT_COLOUR = (0.90, 0.45, 0.15, 1)
OUTPUTS = ("rgb", "depth", "segmentation")
MIN_NEAR = 0.001  # m, of `near`: far below it, depths have no resolution left
# Cardinal directions as seen by the robot: x is forward, y left.
CARDINAL = {"front": (1, 0), "left": (0, 1), "back": (-1, 0), "right": (0, -1)}
# Of the default sensors around the Panda, m. For another arm they are scaled with its reach.
DISTANCE = 1.6
HEIGHT = 0.8
TARGET = 0.4  # the height they look at
FAR = 5.0  # the farthest visible distance


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        eye: its position (x, y, z), m, in the frame of the robot's base.
        target: the point in the middle of its image.
        up: the direction that points up in its image.
        field_of_view: angle from the image's lower to its upper edge, degrees.
        size: (width, height) in pixels (paper: 224 by 224).
        near, far: nearest and farthest visible distance, m, along the viewing direction.
        outputs: one or more of `rgb`, uint8 (height, width, 3); `depth`, float32 (height, width), m
            along the viewing direction, `far` where there is nothing; `segmentation`, uint8
            (height, width), the class of each pixel: `ROBOT`, `STATIC`, `OBSTACLE` or `NOTHING`.

    Raises:
        ValueError: an attribute is out of its range.
    """

    eye: Vector
    target: Vector = (0.0, 0.0, 0.4)
    up: Vector = (0.0, 0.0, 1.0)
    field_of_view: float = 60.0
    size: tuple[int, int] = (224, 224)
    near: float = 0.1
    far: float = 5.0
    outputs: tuple[str, ...] = ("rgb",)

    def __post_init__(self):
        _check_view(self)
        if not (
            isinstance(self.outputs, (tuple, list))
            and self.outputs
            and all(isinstance(name, str) and name in OUTPUTS for name in self.outputs)
        ):
            raise ValueError(
                f"outputs must be one or more of {', '.join(OUTPUTS)}, got {self.outputs!r}"
            )
        if (
            len(self.size) != 2
            or not all(isinstance(edge, (int, np.integer)) for edge in self.size)
            or not 1 <= min(self.size) <= max(self.size) <= MAX_EDGE
        ):
            raise ValueError(f"size must be two numbers from 1 to {MAX_EDGE}, got {self.size!r}")

    @property
    def space(self) -> gym.spaces.Dict:
        """Gymnasium space of an observation, a dict of the outputs."""
        width, height = self.size
        spaces = {
            "rgb": gym.spaces.Box(0, 255, (height, width, 3), np.uint8),
            "depth": gym.spaces.Box(0.0, self.far, (height, width), np.float32),
            "segmentation": gym.spaces.Box(0, NOTHING, (height, width), np.uint8),
        }
        return gym.spaces.Dict({name: spaces[name] for name in self.outputs})

    def observe(self, world: "SensorWorld") -> dict[str, np.ndarray]:
        """Its observation of a `SensorWorld`: a dict of the outputs."""
        observed = {}
        if "rgb" in self.outputs:
            observed["rgb"] = world.render(self, self.size)
        if "depth" in self.outputs or "segmentation" in self.outputs:
            observed["depth"], observed["segmentation"] = world.cast(self, self.size)
        return {name: observed[name] for name in self.outputs}


@dataclass(frozen=True)
class PointCloud:
    """A depth sensor that returns points: a square grid of rays through a pinhole.

    Attributes:
        eye, target, up, field_of_view, near, far: as of a `Camera`.
        num_samples: number of rays, a square number (paper: 10,000).

    Raises:
        ValueError: an attribute is out of its range.
    """

    eye: Vector
    target: Vector = (0.0, 0.0, 0.4)
    up: Vector = (0.0, 0.0, 1.0)
    field_of_view: float = 60.0
    num_samples: int = 10_000
    near: float = 0.1
    far: float = 5.0

    def __post_init__(self):
        _check_view(self)
        number = self.num_samples
        if (
            not (isinstance(number, (int, np.integer)) and not isinstance(number, bool))
            or not 1 <= number <= MAX_EDGE**2
            or math.isqrt(number) ** 2 != number
        ):
            raise ValueError(f"num_samples must be a square number to {MAX_EDGE}², got {number!r}")

    @property
    def space(self) -> gym.spaces.Dict:
        """Gymnasium space of an observation: a dict of `points` and `labels`."""
        shape = (self.num_samples, 3)
        return gym.spaces.Dict(
            {
                "points": gym.spaces.Box(-np.inf, np.inf, shape, np.float32),
                "labels": gym.spaces.Box(0, NOTHING, shape[:1], np.uint8),
            }
        )

    @property
    def camera(self) -> Camera:
        """The camera whose pixels are the rays."""
        return Camera(
            self.eye,
            self.target,
            self.up,
            self.field_of_view,
            self.size,
            self.near,
            self.far,
            outputs=("depth", "segmentation"),
        )

    def points(self, depth: np.ndarray, segmentation: np.ndarray) -> dict[str, np.ndarray]:
        """An observation, from the camera's `depth` (m) and `segmentation`: a dict of

        - `points`: float32 (num_samples, 3), m, in the frame of the robot's base: where rays hit
          something, row by row of the grid from its upper left; then zeros;
        - `labels`: uint8 (num_samples,): the class of each hit, `ROBOT`, `STATIC` or `OBSTACLE`;
          then `NOTHING`.
        """
        points = np.zeros((self.num_samples, 3), np.float32)
        labels = np.full(self.num_samples, NOTHING, np.uint8)
        depth = np.ascontiguousarray(depth, np.float32)
        points_of_pixels(self._view, depth, segmentation, -1, NOTHING, points, labels)
        return {"points": points, "labels": labels}

    def points_of_class(
        self, depth: np.ndarray, segmentation: np.ndarray, label: int
    ) -> np.ndarray:
        """As `points`, those of one class alone, without zeros: float32 (n, 3), m."""
        points = np.empty((self.num_samples, 3), np.float32)
        labels = np.empty(self.num_samples, np.uint8)
        number = points_of_pixels(self._view, depth, segmentation, label, NOTHING, points, labels)
        return points[:number]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the grid of rays."""
        edge = math.isqrt(self.num_samples)
        return edge, edge

    @property
    def _view(self) -> np.ndarray:
        return view_of(self, self.size)

    def observe(self, world: "SensorWorld") -> dict[str, np.ndarray]:
        """Its observation of a `SensorWorld`: a dict of `points` and `labels`, see `points`."""
        return self.points(*world.cast(self, self.size))


Sensor = Camera | PointCloud


def cardinal(kind: type[Any] = Camera, robot: Robot = PANDA, **options: Any) -> dict[str, Any]:
    """Four sensors of a kind around a `Robot`, looking at it: a dict of name -> sensor.

    (Paper, section 4: "four sensors located in cardinal directions".) `options` go to each.
    """
    scale = scale_of(robot)
    options = {"target": (0.0, 0.0, scale * TARGET), "far": scale * FAR} | options
    return {
        name: kind(eye=(scale * DISTANCE * x, scale * DISTANCE * y, scale * HEIGHT), **options)
        for name, (x, y) in CARDINAL.items()
    }


def deproject(sensor: Sensor, depth: np.ndarray) -> np.ndarray:
    """The points (height, width, 3), m, in the frame of the robot's base, of a depth image.

    Args:
        sensor: a `Camera` or `PointCloud`.
        depth: (height, width), m along the viewing direction.
    """
    height, width = depth.shape
    right, up, forward = view_of(sensor, (width, height))[AXES : AXES + 9].reshape(3, 3)
    half = math.tan(math.radians(sensor.field_of_view) / 2)
    # At distance 1. PyBullet's TinyRenderer looks through the lower left corners of the pixels.
    across = (2 * np.arange(width) / width - 1) * half * width / height
    upward = (1 - 2 * (np.arange(height) + 1) / height) * half
    rays = across[None, :, None] * right + upward[:, None, None] * up + forward
    return np.array(sensor.eye) + depth[..., None] * rays


def _axes_of(eye: Vector, target: Vector, up: Vector) -> tuple[np.ndarray, ...]:
    """Unit vectors (right, up, forward) of an image."""
    forward = np.subtract(target, eye).astype(np.float64)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward), forward


def _check_view(sensor: Sensor) -> None:
    for name in ("eye", "target", "up"):
        vector = getattr(sensor, name)
        if len(vector) != 3 or not all(is_number(x) and abs(x) <= MAX_LENGTH for x in vector):
            raise ValueError(
                f"{name} must be three numbers, up to {MAX_LENGTH:.0f} m, got {vector!r}"
            )
    forward = np.subtract(sensor.target, sensor.eye)
    if np.linalg.norm(np.cross(forward, sensor.up)) < 1e-9:
        raise ValueError("a sensor cannot look along its own up direction, or from its target")
    for name in ("field_of_view", "near", "far"):
        if not is_number(getattr(sensor, name)):
            raise ValueError(f"{name} must be a number, got {getattr(sensor, name)!r}")
    if not 0 < sensor.field_of_view < 180:
        raise ValueError(f"field_of_view must be between 0 and 180, got {sensor.field_of_view!r}")
    if not MIN_NEAR <= sensor.near < sensor.far <= MAX_LENGTH:
        raise ValueError(
            f"near and far must be {MIN_NEAR} <= near < far <= {MAX_LENGTH:.0f} m, "
            f"got {sensor.near!r}, {sensor.far!r}"
        )


def view_of(sensor: Sensor, size: tuple[int, int]) -> np.ndarray:
    """A sensor's place and directions as `ray_kernels.cast_rays` takes them: float64 (`VIEW`,).

    `size`: (width, height) in pixels. Not to be changed.
    """
    eye = tuple(map(float, sensor.eye))
    target = tuple(map(float, sensor.target))
    up = tuple(map(float, sensor.up))
    return _view(eye, target, up, sensor.field_of_view, *size, sensor.near, sensor.far)


@functools.lru_cache(maxsize=256)
def _view(eye, target, up, field_of_view, width, height, near, far) -> np.ndarray:
    half = math.tan(math.radians(field_of_view) / 2)
    view = np.empty(VIEW)
    view[EYE:AXES] = eye
    view[AXES : AXES + 9] = np.ravel(_axes_of(eye, target, up))
    view[AXES + 9 :] = (half * width / height, half, near, far)
    return view


class SensorWorld:
    """A scene with the arm in it, for sensors.

    Depth and classes need no PyBullet: `cast`. For colours, `render` opens a world of PyBullet's at
    its first call, where the arm is drawn as its collision meshes, and spheres and cylinders as
    polyhedra, up to a tenth of their radius off the true surface.

    Args:
        noise: an `envs.perception.noise.SensorNoise`, from the first `begin_episode` on.

    Attributes:
        scene: the `Scene`; there is none before `show`.
        configuration: the arm's joint angles (n, rad).

    Raises:
        RuntimeError: of `cast` and `render`: it is closed.
    """

    scene: Scene
    configuration: np.ndarray | Sequence[float]

    def __init__(self, noise: SensorNoise = NO_NOISE):
        self.noise = noise
        self._caster: RayCaster | None = None
        self._drawn: _DrawnWorld | None = None
        self._noise_of_episode: NoiseOfEpisode | None = None
        self._number = 0
        self._is_closed = False

    @property
    def robot(self) -> Robot:
        """The scene's `Robot`."""
        return self.scene.robot

    @property
    def client(self) -> int | None:
        """PyBullet's number of a physics engine with the scene and the arm."""
        return self._draw().client

    def begin_episode(self, key: int, number: int) -> None:
        """Draw the noise that stays the same for an episode.

        Args:
            key: int from 0 on: equal keys give equal noise.
            number: of cameras, of which `SensorNoise.missing_cameras` are missing.
        """
        if self.noise.changes_images:
            self._noise_of_episode = NoiseOfEpisode(self.noise, key, number)

    def _check_open(self) -> None:
        if self._is_closed:
            raise RuntimeError("this sensor world is closed")

    def show(
        self, scene: Scene, configuration: np.ndarray | Sequence[float], number: int = 0
    ) -> None:
        """Change to a `Scene` with the arm at joint angles (n, rad).

        `number`: of the observation in its episode, for noise.

        Raises ValueError: an obstacle has a motion.
        """
        if not scene.is_static:
            raise ValueError("obstacles of this scene move: observe scene.at(t), at a time t")
        self.scene = scene
        self.configuration = configuration
        self._number = number
        self._caster = None

    def cast(self, sensor: Sensor, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """What rays from a sensor's place hit, with `size` (width, height) in pixels.

        Returns:
            `depth` and `segmentation`, as `Camera` describes them.
        """
        self._check_open()
        if self._caster is None:
            self._caster = RayCaster(self.scene, self.configuration)
        view = view_of(sensor, size)
        if self._noise_of_episode is None:
            return self._caster.image(view, size)
        noise = self._noise_of_episode.of_sensor(view)
        depth, classes = self._caster.image(noise.true_view(view), size)
        return noise.apply(depth, classes, sensor.far, self._number)

    def render(self, sensor: Sensor, size: tuple[int, int]) -> np.ndarray:
        """The colour image from a sensor's place, with `size` (width, height) in pixels.

        Returns:
            `rgb`, as `Camera` describes it.
        """
        client = self.client
        width, height = size
        eye, target, up = sensor.eye, sensor.target, sensor.up
        if self._noise_of_episode is not None:
            view = view_of(sensor, size)
            noise = self._noise_of_episode.of_sensor(view)
            if noise.is_missing:
                return np.zeros((height, width, 3), np.uint8)
            view = noise.true_view(view).tolist()
            eye = view[EYE:AXES]
            up = view[AXES + 3 : AXES + 6]
            forward = view[AXES + 6 : AXES + 9]
            target = np.add(eye, forward).tolist()
        image = p.getCameraImage(
            width,
            height,
            p.computeViewMatrix(eye, target, up),
            p.computeProjectionMatrixFOV(
                sensor.field_of_view, width / height, sensor.near, sensor.far
            ),
            shadow=0,
            renderer=p.ER_TINY_RENDERER,
            physicsClientId=client,
        )
        return image_array(image[2], width, height)

    def _draw(self) -> "_DrawnWorld":
        self._check_open()
        if self._drawn is None:
            self._drawn = _DrawnWorld(self.scene)
        self._drawn.set_scene(self.scene)
        self._drawn.arm.set_configuration(self.configuration)
        return self._drawn

    def close(self) -> None:
        """Close it, and PyBullet's world, if there is one. Closing twice is allowed."""
        self._is_closed = True
        if self._drawn is not None:
            self._drawn.close()
            self._drawn = None


class _DrawnWorld(World):
    def _load_arm(self) -> Body:
        assert self.client is not None  # it was just opened
        return Body.coarse(self.robot, self.client, ROBOT_COLOUR)


@dataclass(frozen=True)
class SceneObservation(Scene):
    """A `Scene` as sensors observe it at one time, with the arm where it is, and noise.

    In a plain `Scene`, they observe the arm in its `observed_pose`, without noise. Whatever takes a
    `Scene` also takes this: encoders, geometry sources, `observed_points`.

    Attributes:
        configuration: the arm's joint angles, n floats, rad.
        noise: an `envs.perception.noise.SensorNoise`.
        key: int from 0 on, of the episode: equal keys give equal noise.
        number: of the observation in its episode, from 0 on.
    """

    configuration: tuple[float, ...] = ()
    noise: SensorNoise = NO_NOISE
    key: int = 0
    number: int = 0

    @classmethod
    def of(
        cls,
        scene: Scene,
        configuration: np.ndarray | Sequence[float],
        noise: SensorNoise = NO_NOISE,
        key: int = 0,
        number: int = 0,
    ) -> "SceneObservation":
        """The observation of a static `Scene` with the arm at joint angles (n, rad)."""
        return cls(
            **{field.name: getattr(scene, field.name) for field in fields(Scene)},
            configuration=tuple(map(float, configuration)),
            noise=noise,
            key=key,
            number=number,
        )


@functools.lru_cache(maxsize=8)
def _shared_world(noise: SensorNoise) -> SensorWorld:
    return SensorWorld(noise)


def world_of(scene: Scene, number: int) -> SensorWorld:
    """A `SensorWorld` that shows a `Scene`, or a `SceneObservation`, for so many sensors."""
    if not isinstance(scene, SceneObservation):
        world = _shared_world(NO_NOISE)
        world.show(scene, scene.robot.observed_pose)
        return world
    world = _shared_world(scene.noise)
    world.begin_episode(scene.key, number)
    world.show(scene, scene.configuration, scene.number)
    return world


def observe_scene(scene: Scene, sensors: Mapping[str, Sensor]) -> dict[str, dict[str, np.ndarray]]:
    """Observations of a `Scene` with the arm in its robot's `observed_pose`.

    Args:
        scene: a `Scene`, or a `SceneObservation`, which has a configuration and noise.
        sensors: dict of name -> sensor.

    Returns:
        Dict of name -> the sensor's observation, a dict.
    """
    world = world_of(scene, len(sensors))
    return {name: sensor.observe(world) for name, sensor in sensors.items()}


_KINDS = {"camera": Camera, "point_cloud": PointCloud}


def sensors_to_json(sensors: Mapping[str, Sensor]) -> str:
    """A dict of name -> `Camera` or `PointCloud` as text."""
    kinds = {kind: name for name, kind in _KINDS.items()}
    return json.dumps(
        {name: {"kind": kinds[type(sensor)], **asdict(sensor)} for name, sensor in sensors.items()}
    )


def sensors_from_json(text: str) -> dict[str, Sensor]:
    """The inverse of `sensors_to_json`. Raises ValueError: it is no text of that function."""
    sensors = {}
    try:
        for name, fields in json.loads(text).items():
            kind = _KINDS[fields.pop("kind")]
            values = {k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()}
            sensors[name] = kind(**values)
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"not sensors: {error!r}") from error
    return sensors
