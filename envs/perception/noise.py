"""Noise of sensors: what a real depth camera adds to the ideal one.

    noise = SensorNoise(gaussian=0.002, dropout=0.1, missing_cameras=1, latency=2)
    env = roboarm_nmp.make(
        "random_boxes_hard", link_distances=True, geometry_source="point_cloud", sensor_noise=noise
    )

Noise acts on depth images, before points are computed. A `SensorNoise` has a seed; the same seed
and query give the same noise, in any order of the episodes.
"""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from roboarm_nmp.envs.perception.ray_casting import NOTHING
from roboarm_nmp.envs.perception.ray_kernels import AXES, EYE, edge_pixels, pixels_with_neighbours
from roboarm_nmp.envs.scenes.primitives import is_number
from roboarm_nmp.utils.names import suggest
from roboarm_nmp.utils.random_streams import Stream

EDGE = 0.05
"""m. Neighbouring pixels whose depths differ by more are at an edge, where pixels may fly."""
EDGE_NEIGHBOURS = 3
"""Neighbours that a pixel needs for `edge_filter`: as many as a face's pixel in a corner has."""
_WHOLE = ("missing_cameras", "latency", "seed")
# The largest values of attributes; of all others 1000.
_MOST = {"dropout": 1, "flying_pixels": 1, "seed": 2**32 - 1}


@dataclass(frozen=True)
class SensorNoise:
    """What depth cameras get wrong, and how their drivers filter it. All of it is off by default.

    Attributes:
        gaussian: m, standard deviation of each depth.
        per_metre: m per m of depth: standard deviation that grows with the depth, in addition.
        quantisation: m: depths are rounded to multiples of this.
        dropout: share of the pixels, chosen at random in each image, that have no depth.
        flying_pixels: share of the pixels at edges (depths more than `EDGE` apart) that get a depth
            between that of the front and that of the back.
        missing_cameras: how many cameras observe nothing in an episode; which, is drawn.
        calibration_mm, calibration_degrees: standard deviation of the error of each camera's
            assumed position along each axis (mm), and orientation about each axis (degrees), drawn
            once an episode.
        latency: steps from an observation to the step in which it is received. The first one of an
            episode is received at once.
        edge_filter: m: a pixel with fewer than `EDGE_NEIGHBOURS` of its eight neighbours within
            this depth of its own gets no depth, which removes most flying pixels, after all noise.
        seed: of all random numbers.

    Raises:
        ValueError: an attribute is out of its range.
    """

    gaussian: float = 0.0
    per_metre: float = 0.0
    quantisation: float = 0.0
    dropout: float = 0.0
    flying_pixels: float = 0.0
    missing_cameras: int = 0
    calibration_mm: float = 0.0
    calibration_degrees: float = 0.0
    latency: int = 0
    edge_filter: float = 0.0
    seed: int = 0

    def __post_init__(self):
        for field in fields(self):
            name = field.name
            value = getattr(self, name)
            kind = int if name in _WHOLE else float
            most = _MOST.get(name, 1000)
            is_valid = is_number(value) and not isinstance(value, bool)
            if not (is_valid and 0 <= value <= most and kind(value) == value):
                words = "a whole number" if kind is int else "a number"
                raise ValueError(f"{name} must be {words} from 0 to {most}, got {value!r}")
            object.__setattr__(self, name, kind(value))  # NumPy's numbers do not fit into JSON

    @classmethod
    def parse(cls, settings: Iterable[str]) -> "SensorNoise":
        """The noise of settings such as `("gaussian=0.005", "missing_cameras=1")`.

        Raises ValueError: an unknown name, one that is given twice, or no number in its range.
        """
        values = {}
        names = [field.name for field in fields(cls)]
        for setting in settings:
            name, equals, text = setting.partition("=")
            if name not in names or not equals:
                raise ValueError(
                    f"sensor noise is NAME=VALUE, got {setting!r}: {suggest(name, names)}"
                )
            if name in values:
                raise ValueError(f"sensor noise: {name} is given twice")
            try:
                values[name] = int(text) if name in _WHOLE else float(text)
            except ValueError as error:
                kind = "a whole number" if name in _WHOLE else "a number"
                raise ValueError(f"sensor noise: {name} needs {kind}, got {text!r}") from error
        return cls(**values)

    def to_metadata(self) -> dict[str, Any]:
        """The attributes that are not the defaults, as a dict."""
        return {name: value for name, value in asdict(self).items() if value}

    @property
    def changes_images(self) -> bool:
        """Whether there is more than latency."""
        return any(value for name, value in asdict(self).items() if name not in ("latency", "seed"))


NO_NOISE = SensorNoise()


class NoiseOfEpisode:
    """The noise of all cameras in an episode.

    Args:
        noise: a `SensorNoise`.
        key: int from 0 on, of the episode.
        number: of cameras.
    """

    def __init__(self, noise: SensorNoise, key: int, number: int):
        self._noise = noise
        self._key = key
        order = _rng(noise, key).permutation(number)
        self._missing = set(order[: noise.missing_cameras].tolist())
        self._sensors = {}

    def of_sensor(self, view: np.ndarray) -> "NoiseOfSensor":
        """The noise of the camera with a view: in the order in which they observe first."""
        place = view[: AXES + 9].tobytes()
        if place not in self._sensors:
            number = len(self._sensors)
            missing = number in self._missing
            self._sensors[place] = NoiseOfSensor(self._noise, (self._key, 1 + number), missing)
        return self._sensors[place]


class NoiseOfSensor:
    """The noise of one camera in an episode.

    Attributes:
        is_missing: whether it observes nothing.
    """

    def __init__(self, noise: SensorNoise, key: tuple[int, int], is_missing: bool):
        self._noise = noise
        self._key = key
        self.is_missing = is_missing
        rng = _rng(noise, *key)
        self._shift = 1e-3 * noise.calibration_mm * rng.standard_normal(3)
        self._turn = _rotation(math.radians(noise.calibration_degrees) * rng.standard_normal(3))

    def true_view(self, view: np.ndarray) -> np.ndarray:
        """Where the camera really is (`ray_kernels.VIEW`): its assumed view with the errors."""
        noise = self._noise
        if not (noise.calibration_mm or noise.calibration_degrees):
            return view
        view = view.copy()
        view[EYE:AXES] += self._shift
        view[AXES : AXES + 9] = (view[AXES : AXES + 9].reshape(3, 3) @ self._turn.T).ravel()
        return view

    def apply(
        self, depth: np.ndarray, classes: np.ndarray, far: float, number: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """A depth image (m) and its classes with noise.

        `number`: of the observation in its episode, from 0 on.
        """
        noise = self._noise
        rng = _rng(noise, *self._key, 1 + number)
        if self.is_missing:
            return np.full_like(depth, far), np.full_like(classes, NOTHING)
        hit = classes != NOTHING
        if noise.flying_pixels:
            front, back = edge_pixels(depth, classes, NOTHING, EDGE)
            flies = (back > 0) & (rng.random(depth.shape, np.float32) < noise.flying_pixels)
            share = rng.random(depth.shape, np.float32)
            depth = np.where(flies, front + share * (back - front), depth)
        if noise.gaussian or noise.per_metre:
            constant = np.float32(noise.gaussian)
            growing = np.float32(noise.per_metre)
            depth = depth + constant * rng.standard_normal(depth.shape, np.float32)
            depth = depth + growing * depth * rng.standard_normal(depth.shape, np.float32)
        if noise.quantisation:
            step = np.float32(noise.quantisation)
            depth = np.round(depth / step) * step
        if noise.dropout:
            hit &= rng.random(depth.shape, np.float32) >= noise.dropout
        hit &= (depth > 0) & (depth < far)
        if noise.edge_filter:
            hit = pixels_with_neighbours(depth, hit, np.float32(noise.edge_filter), EDGE_NEIGHBOURS)
        return np.where(hit, depth, np.float32(far)), np.where(hit, classes, np.uint8(NOTHING))


def _rng(noise: SensorNoise, *key: int) -> np.random.Generator:
    return np.random.default_rng([noise.seed, Stream.SENSOR_NOISE, *key])


def _rotation(vector: np.ndarray) -> np.ndarray:
    """The rotation matrix (3, 3) about a vector (3,), by its norm in rad (Rodrigues' formula)."""
    angle = np.linalg.norm(vector)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
