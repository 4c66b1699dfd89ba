"""Scene encoders: from a `Scene` to z_E, the latent code that a policy receives of the scene.

    encoder = make_encoder("vae")                         # pretrained, by name
    encoder = make_encoder("runs/RUN/encoder.onnx")       # a network file
    encoder = make_encoder("oracle")                      # ground-truth obstacles (privileged)
    encoder = make_encoder("point_cloud", num_points=32)  # points that four sensors observe
    encoder = make_encoder("point_cloud", geometry_source="field")  # points decoded from z_E
    z = encoder(scene)                                    # float32 (encoder.size,)

Paper: sections 5.1 and 5.3. `envs.wrappers.SceneEncodingWrapper` appends z_E to observations.
"""

import abc
import functools
import hashlib
import io
import os
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roboarm_nmp.envs.perception.point_clouds import (
    NUM_POINTS,
    POINT_CLOUD,
    farthest_points,
    observed_points,
    remember_points,
)
from roboarm_nmp.envs.perception.sensors import PointCloud, observe_scene, sensors_from_json
from roboarm_nmp.envs.robots.metadata import check_robot
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import ROW, Scene, padded_rows
from roboarm_nmp.networks.network_file import Network, load_network
from roboarm_nmp.networks.untrusted import NetworkError
from roboarm_nmp.utils.files import cache_folder, write_atomically
from roboarm_nmp.utils.names import suggest
from roboarm_nmp.utils.progress import progress_bar, write_line

ORACLE = "oracle"
PRETRAINED = Path(__file__).parent / "pretrained"
# A decoder's file is named like its encoder's, with this ending.
DECODER = ".decoder.onnx"
# Obstacles that the oracle has room for: `narrow_shelves` has 28.
MAX_OBSTACLES = 32
MAX_POINTS = 9_999
CACHED_SCENES = 500
CACHED_DECODED = 1_000
# The grid of decoded points, m: its cells, how close to obstacles its points are, and its corners,
# those of the arm's workspace above the table.
DECODED_CELL = 0.025
DECODED_REACH = 0.015
DECODED_LOW = (-0.9, -0.9, 0.0)
DECODED_HIGH = (0.9, 0.9, 1.5)


def pretrained_encoders() -> list[str]:
    """Names of the encoders in `PRETRAINED`."""
    return sorted(path.stem for path in PRETRAINED.glob("*.onnx") if not path.match(f"*{DECODER}"))


def make_encoder(
    name: str | Path, num_points: int = NUM_POINTS, geometry_source: str | Path | None = None
) -> "SceneEncoder":
    """The encoder of a name, one per process and set of arguments.

    Args:
        name: `oracle`, `point_cloud`, the name of a pretrained encoder, or the path of an encoder's
            network file.
        num_points: of `point_cloud`.
        geometry_source: of `point_cloud`: None or `point_cloud` for observed points, or the name or
            path of an encoder with a decoder for points decoded from its latent code.

    Raises:
        NetworkError: there is no such encoder, its file cannot be used, or it has no decoder.
        ValueError: `num_points` is out of range.
    """
    name = str(name)
    if name == ORACLE:
        return _shared(OracleEncoder)
    if name == POINT_CLOUD:
        encoder = None
        if geometry_source is not None and str(geometry_source) != POINT_CLOUD:
            encoder = encoder_with_decoder(geometry_source)
        return _shared(PointCloudEncoder, num_points, encoder)
    if name in pretrained_encoders():
        return _shared(NetworkEncoder, PRETRAINED / f"{name}.onnx", name)
    path = Path(name).absolute()  # a relative path is another file in another folder
    if not os.path.exists(path):
        known = [ORACLE, POINT_CLOUD, *pretrained_encoders()]
        raise NetworkError(
            f"no such encoder: {name}: {suggest(name, known)} (or the path of an encoder's network "
            f"file)"
        )
    return _shared(NetworkEncoder, path, name)


def encoder_with_decoder(name: str | Path) -> "NetworkEncoder":
    """`make_encoder(name)`. Raises NetworkError, too, if it has no decoder."""
    encoder = make_encoder(name)
    if not isinstance(encoder, NetworkEncoder) or encoder.decoder is None:
        raise _no_decoder(name)
    return encoder


def _no_decoder(name: str | Path) -> NetworkError:
    return NetworkError(f"{name} has no decoder: no obstacles can be decoded from its z_E")


@functools.lru_cache
def _shared(kind: type["SceneEncoder"], *args: Any) -> "SceneEncoder":
    """The encoder of a class and its arguments, one per process."""
    return kind(*args)


class SceneEncoder(abc.ABC):
    """Base class. It caches z_E, so that an equal scene is encoded once by the class's `_encode`.

    Copies, and unpickled encoders in other processes, are the one of `make_encoder`.

    Attributes:
        name: string.
        size: of z_E.
        token_size: numbers of z_E that belong together: those of one obstacle or point, or all.
        decoder: the network from z_E and points to distances from obstacles (m); None: there is
            none.
        geometry_source: the geometry source (`envs.perception.geometry_source`) with the same
            information about a scene; `point_cloud` where z_E cannot be decoded.
    """

    decoder: Network | None = None
    geometry_source: str = POINT_CLOUD

    def __init__(self, name: str, size: int, token_size: int):
        self.name = name
        self.size = size
        self.token_size = token_size
        self._of_demos = {}  # scene -> z_E
        self._cached = functools.lru_cache(CACHED_SCENES)(self._encode)

    def __call__(self, scene: Scene) -> np.ndarray:
        """z_E of a `Scene`, float32 (size,); not to be changed."""
        z = self._of_demos.get(scene)
        return self._cached(scene) if z is None else z

    @abc.abstractmethod
    def _encode(self, scene: Scene) -> np.ndarray:
        """z_E of a `Scene`, float32 (size,)."""

    def check_robot(self, robot: Robot) -> None:  # noqa: B027
        """Raise NetworkError if the encoder was trained for another `Robot`."""

    def encode_demos(self, demos: Any) -> np.ndarray:
        """z_E of all scenes of `datasets.demonstrations.Demos`: float32 (n, size).

        Later calls of the encoder with these scenes return the same numbers.

        Raises ValueError: obstacles move.
        """
        scenes = [demos.scenes[i] for i in range(len(demos))]
        if not all(scene.is_static for scene in scenes):
            raise ValueError("demonstrations among moving obstacles cannot be encoded")
        if any(scene not in self._of_demos for scene in scenes):  # each environment asks for them
            latents = self._encode_all(scenes, demos.task)
            self._of_demos.update(zip(scenes, latents, strict=True))
        return np.stack([self._of_demos[scene] for scene in scenes])

    def _encode_all(self, scenes: Sequence[Scene], task: str) -> np.ndarray:
        latents = {scene: self._encode(scene) for scene in _progress(scenes, f"encoding {task}")}
        return np.stack([latents[scene] for scene in scenes])


class OracleEncoder(SceneEncoder):
    """The obstacles' parameters, padded: float32 (`MAX_OBSTACLES` * 12,). Privileged.

    Of each obstacle 1 and its row of `envs.scenes.primitives.to_array`; zeros where there is none.
    A scene with more than `MAX_OBSTACLES` raises ValueError.
    """

    geometry_source = "ground_truth"

    def __init__(self):
        super().__init__(ORACLE, MAX_OBSTACLES * (1 + ROW), 1 + ROW)

    def __reduce__(self):
        return make_encoder, (ORACLE,)

    def _encode(self, scene: Scene) -> np.ndarray:
        count = len(scene.obstacles)
        if count > MAX_OBSTACLES:
            raise ValueError(f"the oracle has room for {MAX_OBSTACLES} obstacles, not for {count}")
        return padded_rows(scene.obstacles, MAX_OBSTACLES).ravel()


class PointCloudEncoder(SceneEncoder):
    """Points of a scene's obstacles, as far apart as possible: float32 (`num_points` * 3,), m.

    In the base's frame, chosen by `envs.perception.point_clouds.farthest_points`.

    Args:
        num_points: 1 to `MAX_POINTS`.
        encoder: None for points that four sensors observe; a `NetworkEncoder` with a decoder for
            points decoded from its z_E.

    Raises:
        ValueError: `num_points` is out of range.
    """

    def __init__(self, num_points: int = NUM_POINTS, encoder: "NetworkEncoder | None" = None):
        if type(num_points) is not int or not 1 <= num_points <= MAX_POINTS:
            raise ValueError(f"num_points must be 1 to {MAX_POINTS:,}, got {num_points!r}")
        super().__init__(POINT_CLOUD, 3 * num_points, 3)
        self.num_points = num_points
        self._encoder = encoder
        if encoder is not None:
            self.geometry_source = encoder.name

    def check_robot(self, robot: Robot) -> None:
        """As `SceneEncoder.check_robot`."""
        if self._encoder is not None:
            self._encoder.check_robot(robot)

    def __reduce__(self):
        return _shared, (PointCloudEncoder, self.num_points, self._encoder)

    def _encode(self, scene: Scene) -> np.ndarray:
        points = observed_points if self._encoder is None else self._encoder.decoded_points
        return farthest_points(points(scene), self.num_points).ravel()

    def _encode_all(self, scenes: Sequence[Scene], task: str) -> np.ndarray:
        if self._encoder is None:  # link distances may need all of them, too
            for scene in _progress(scenes, f"observing {task}"):
                remember_points(scene)
        return super()._encode_all(scenes, task)


class NetworkEncoder(SceneEncoder):
    """A network's encoding of what its sensors observe of a scene.

    Args:
        path: of the network file; its metadata hold `kind` ("encoder") and `sensors`
            (`envs.perception.sensors.sensors_to_json`). A decoder's file may be beside it.
        name: string; by default the path.

    Attributes:
        path: of the network file.
        sensors: dict of name -> sensor.

    Raises:
        NetworkError: the file cannot be used.
    """

    def __init__(self, path: str | Path, name: str | None = None):
        self.path = Path(path)
        self._network = load_network(path)
        if self._network.metadata.get("kind") != "encoder":
            raise NetworkError(f"{path}: not an encoder, but {self._network.metadata!r}")
        try:
            self.sensors = sensors_from_json(self._network.metadata["sensors"])
            observed = self.observe(Scene())
        except (KeyError, ValueError) as error:
            raise NetworkError(f"{path}: its sensors are invalid: {error!r}") from error
        size = len(self.encode(observed))
        super().__init__(str(path) if name is None else name, size, size)
        if self.path.with_suffix(DECODER).exists():
            self.decoder = load_network(self.path.with_suffix(DECODER))
            self.geometry_source = self.name
        self._decoded = functools.lru_cache(CACHED_DECODED)(self._decode_points)

    def __reduce__(self):
        if self.path == PRETRAINED / f"{self.name}.onnx":  # elsewhere on another machine
            return make_encoder, (self.name,)
        return _shared, (NetworkEncoder, self.path.absolute(), self.name)

    def check_robot(self, robot: Robot) -> None:
        """As `SceneEncoder.check_robot`: what sensors observe contains the robot."""
        check_robot(self.name, self._network.metadata, robot)

    def observe(self, scene: Scene) -> dict[str, np.ndarray]:
        """The network's inputs, without the axis of batches: what the sensors observe."""
        inputs = {}
        for name, outputs in observe_scene(scene, self.sensors).items():
            if isinstance(self.sensors[name], PointCloud):
                for output, array in outputs.items():
                    inputs[f"{name}_{output}"] = array
            else:
                inputs[name] = outputs["rgb"]
        return {name: inputs[name] for name in self._network.inputs}

    def encode(self, observed: dict[str, np.ndarray]) -> np.ndarray:
        """z_E, float32 (size,), of what `observe` returned. Raises NetworkError: it is none."""
        return self._network.predict_one(observed, None)[0]

    def _encode(self, scene: Scene) -> np.ndarray:
        self.check_robot(scene.robot)
        return self.encode(self.observe(scene))

    def _encode_all(self, scenes: Sequence[Scene], task: str) -> np.ndarray:
        """Latents are kept in the user's cache folder, where that is possible.

        A file there counts only for the same network and the same scenes.
        """
        key = hashlib.sha256(self.path.read_bytes() + repr(scenes).encode()).hexdigest()
        try:
            path = cache_folder() / "encodings" / f"{self.path.stem}.{key[:16]}.npz"
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            write_line(f"encoding {task} with {self.name}, not kept: {error}")
            return super()._encode_all(scenes, task)
        latents = _read_latents(path, key)
        if latents is None:
            write_line(f"encoding {task} with {self.name}, once; kept in {path}")
            latents = super()._encode_all(scenes, task)
            file = io.BytesIO()
            np.savez(file, key=key, latents=latents)
            try:
                write_atomically(path, file.getvalue())
            except OSError as error:
                write_line(f"not kept: {error}")
        return latents

    # --- The decoder: from z_E back to geometry

    def distances(self, scene: Scene, points: np.ndarray) -> np.ndarray:
        """Decoded distances of points (n, 3), m, from the nearest obstacle: float32 (n,), m.

        Raises NetworkError: there is no decoder, or it cannot be used.
        """
        if self.decoder is None:
            raise _no_decoder(self.name)
        inputs = {"latent": self(scene), "points": np.asarray(points, np.float32)}
        return self.decoder.predict_one(inputs, len(points))[0]

    def decoded_points(self, scene: Scene) -> np.ndarray:
        """Points of a scene's obstacles, decoded from z_E alone: float32 (n, 3), m.

        Those points of a grid of `DECODED_CELL` whose decoded distance from an obstacle is below
        `DECODED_REACH`. The last scenes are remembered. Raises NetworkError as `distances`.
        """
        return self._decoded(scene)

    def _decode_points(self, scene: Scene) -> np.ndarray:
        coarse = 3 * DECODED_CELL
        centres = _grid(coarse)
        # Only where a coarse cell may contain such points, all 27 of its cells are decoded.
        near = self.distances(scene, centres) < DECODED_REACH + coarse * 3**0.5 / 2
        offsets = DECODED_CELL * (np.moveaxis(np.indices((3, 3, 3)), 0, -1).reshape(-1, 3) - 1)
        points = (centres[near][:, None] + offsets.astype(np.float32)).reshape(-1, 3)
        return points[self.distances(scene, points) < DECODED_REACH] if len(points) else points


def _progress(scenes: Sequence[Scene], description: str) -> Iterable[Scene]:
    """The scenes, each of them once, with a progress bar."""
    return progress_bar(dict.fromkeys(scenes), description, unit="scene")


def _read_latents(path: Path, key: str) -> np.ndarray | None:
    """The latents in a file; None if there is none, or it is damaged or of another key."""
    try:
        with np.load(path) as file:
            return file["latents"] if file["key"] == key else None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


@functools.cache
def _grid(cell: float) -> np.ndarray:
    """The centres of cells between `DECODED_LOW` and `DECODED_HIGH`: float32 (n, 3), m."""
    corners = zip(DECODED_LOW, DECODED_HIGH, strict=True)
    axes = [np.arange(low + cell / 2, high, cell) for low, high in corners]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
