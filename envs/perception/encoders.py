"""Scene encoders: a `Scene` -> z_E, the latent code that a policy receives of the scene.

    encoder = make_encoder("vae")                        # pretrained, by name
    encoder = make_encoder("runs/.../encoder.pt")        # trained by a script of your own
    encoder = make_encoder("oracle")                     # ground-truth obstacles (privileged)
    encoder = make_encoder("point_cloud", num_points=32) # points observed by four sensors
    env = SceneEncodingWrapper(roboarm_nmp.make("random_boxes_hard"), encoder)

Paper: sections 5.1 and 5.3. `SceneEncodingWrapper` is in `envs.wrappers`.
"""

import contextlib
import functools
import hashlib
import io
import sys
import zipfile
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from roboarm_nmp.envs.networks.exported_networks import NetworkError, load_network
from roboarm_nmp.envs.perception.point_clouds import (
    NUM_POINTS,
    POINT_CLOUD,
    farthest_points,
    observed_points,
    remember_points,
)
from roboarm_nmp.envs.perception.sensors import POSE, PointCloud, SensorWorld, sensors_from_json
from roboarm_nmp.envs.scenes.primitives import ROW, padded_rows
from roboarm_nmp.envs.utils.files import write_atomically

ORACLE = "oracle"
PRETRAINED = Path(__file__).parent / "pretrained"
# A decoder's file is named like its encoder's, with this ending.
DECODER = ".decoder.pt"
# Obstacles that the oracle has room for: `narrow_shelves` has 28.
MAX_OBSTACLES = 32
CACHED_SCENES, CACHED_DECODED = 500, 1_000
DECODED_CELL, DECODED_REACH = 0.025, 0.015  # m
# The grid of decoded points: the arm's workspace above the table, m.
DECODED_LOW, DECODED_HIGH = (-0.9, -0.9, 0.0), (0.9, 0.9, 1.5)


def pretrained_encoders():
    """Names of the encoders in `PRETRAINED`."""
    return sorted(path.stem for path in PRETRAINED.glob("*.pt") if not path.match(f"*{DECODER}"))


@functools.lru_cache
def make_encoder(name, num_points=NUM_POINTS, geometry_source=None):
    """The encoder of a name, one per process and set of arguments.

    Args:
        name: `oracle`, `point_cloud`, the name of a pretrained encoder, or a network's path.
        num_points: of `point_cloud`.
        geometry_source: of `point_cloud`: None for observed points, or the name or path of an
            encoder whose decoder gives them.

    Raises:
        NetworkError: a file cannot be used, or has no decoder.
        ValueError: `num_points` is out of range.
    """
    if str(name) == ORACLE:
        return OracleEncoder()
    if str(name) == POINT_CLOUD:
        return PointCloudEncoder(num_points, geometry_source)
    return NetworkEncoder(name)


class SceneEncoder:
    """Base class: caches z_E, so an equal scene is encoded once.

    Attributes:
        name: string.
        size: of z_E.
        token_size: numbers of z_E that belong together: those of one obstacle or point, or all.
        geometry_source: the geometry source (`envs.perception.geometry_source`) with the same
            information about a scene; `point_cloud` where the latent code cannot be decoded.
    """

    geometry_source = POINT_CLOUD

    def __init__(self, name, size, token_size):
        self.name, self.size, self.token_size = str(name), size, token_size
        self._of_demos = {}  # scene -> z_E
        self._cached = functools.lru_cache(CACHED_SCENES)(self._encode)

    def __reduce__(self):  # copies, and other processes, use their process's own
        return make_encoder, (self.name,)

    def __call__(self, scene):
        """z_E of a `Scene`, float32 (size,); not to be changed."""
        z = self._of_demos.get(scene)
        return self._cached(scene) if z is None else z

    def _encode(self, scene):
        raise NotImplementedError

    def encode_demos(self, demos):
        """z_E of all scenes of `envs.datasets.demonstrations.Demos`: float32 (n, size).

        Later calls of the encoder with these scenes return what was computed here.
        """
        scenes = [demos.scenes[i] for i in range(len(demos))]
        self._of_demos |= {scene: self._encode(scene) for scene in dict.fromkeys(scenes)}
        return np.stack([self._of_demos[scene] for scene in scenes])

    @property
    def decoder(self):
        """The network from z_E and points to distances. Raises NetworkError: there is none."""
        raise NetworkError(f"{self.name} has no decoder: no distances can be decoded from z_E")

    def close(self):
        """Close the simulated world it observes, if it has one."""


class OracleEncoder(SceneEncoder):
    """The obstacles' parameters, padded: float32 (`MAX_OBSTACLES` * 12,). Privileged.

    Of each obstacle 1 and its row of `envs.scenes.primitives.to_array`; zeros where there is none.
    A scene with more than `MAX_OBSTACLES` raises ValueError.
    """

    geometry_source = "ground_truth"

    def __init__(self):
        super().__init__(ORACLE, MAX_OBSTACLES * (1 + ROW), 1 + ROW)

    def _encode(self, scene):
        count = len(scene.obstacles)
        if count > MAX_OBSTACLES:
            raise ValueError(f"the oracle has room for {MAX_OBSTACLES} obstacles, not for {count}")
        return padded_rows(scene.obstacles, MAX_OBSTACLES).ravel()


class PointCloudEncoder(SceneEncoder):
    """Points of a scene's obstacles, as far apart as possible: float32 (`num_points` * 3,), m.

    In the base's frame, see `envs.perception.point_clouds.farthest_points`.

    Args:
        num_points: 1 to 9,999.
        geometry_source: None for the points that four sensors observe, or the name or path of an
            encoder whose decoder gives them.
    """

    def __init__(self, num_points=NUM_POINTS, geometry_source=None):
        if not 1 <= num_points < 10_000:
            raise ValueError(f"num_points must be 1 to 9,999, got {num_points}")
        super().__init__(POINT_CLOUD, 3 * num_points, 3)
        self.num_points, self._decoded_by = num_points, None
        if geometry_source is not None:
            self._decoded_by = make_encoder(geometry_source)
            self._decoded_by.decoder  # noqa: B018 (or it raises)
            self.geometry_source = str(geometry_source)

    def __reduce__(self):
        source = None if self._decoded_by is None else self.geometry_source
        return make_encoder, (POINT_CLOUD, self.num_points, source)

    def _encode(self, scene):
        source = observed_points if self._decoded_by is None else self._decoded_by.decoded_points
        return farthest_points(source(scene), self.num_points).ravel()

    def encode_demos(self, demos):
        """As `SceneEncoder.encode_demos`; the observed points are remembered, too."""
        if self._decoded_by is None:
            scenes = dict.fromkeys(demos.scenes[i] for i in range(len(demos)))
            for scene in _progress(list(scenes), f"observing {demos.task}"):
                remember_points(scene)
        return super().encode_demos(demos)


class NetworkEncoder(SceneEncoder):
    """A network's encoding of what its sensors observe of a scene.

    Args:
        name: of a pretrained encoder, or the path of a network (encoder.pt).

    Attributes:
        path: of the network.
        sensors: dict of name -> sensor.

    Raises:
        NetworkError: the file cannot be used.
    """

    def __init__(self, name):
        pretrained = PRETRAINED / f"{name}.pt"
        self.path = pretrained if pretrained.exists() else Path(name)
        self._network = load_network(self.path)
        if self._network.metadata.get("kind") != "encoder":
            raise NetworkError(f"{name}: not an encoder, but {self._network.metadata!r}")
        try:
            self.sensors = sensors_from_json(self._network.metadata["sensors"])
        except (KeyError, TypeError, ValueError) as error:
            raise NetworkError(f"{name}: its sensors make no sense: {error!r}") from error
        self._world = SensorWorld()
        size = len(self.encode(self.observe(self._world.scene)))
        super().__init__(name, size, size)
        self._decoded = functools.lru_cache(CACHED_DECODED)(self._decode_points)

    def _encode(self, scene):
        return self.encode(self.observe(scene))

    def observe(self, scene):
        """The network's inputs, a batch of 1: what the sensors observe of a `Scene`."""
        self._world.show(scene, POSE)
        inputs = {}
        for name, sensor in self.sensors.items():
            observed = sensor.observe(self._world)
            if isinstance(sensor, PointCloud):
                inputs |= {f"{name}_{output}": array for output, array in observed.items()}
            else:
                inputs[name] = observed["rgb"]
        return {name: torch.from_numpy(inputs[name])[None] for name in self._network.inputs}

    def encode(self, observed):
        """z_E, float32 (size,), of what `observe` returned. Raises NetworkError: it is none."""
        return self._network.predict_one(observed)

    def encode_demos(self, demos):
        """As `SceneEncoder.encode_demos`, with a progress bar.

        The result is kept in a file beside the network, `<encoder>.<task>.npz`, which is made anew
        when the encoder or the scenes change; where it cannot be written, it is not.
        """
        scenes = [demos.scenes[i] for i in range(len(demos))]
        path = self.path.with_suffix(f".{demos.task}.npz")
        key = hashlib.sha256(self.path.read_bytes() + repr(scenes).encode()).hexdigest()
        latents = _read_latents(path, key)
        if latents is None:
            bar = _progress(scenes, f"encoding {demos.task}")
            latents = np.stack([self(scene) for scene in bar])
            file = io.BytesIO()
            np.savez(file, key=key, latents=latents)
            with contextlib.suppress(OSError):
                write_atomically(path, file.getvalue())
        self._of_demos |= zip(scenes, latents, strict=True)
        return latents

    # --- The decoder: from the latent code back to geometry

    @property
    def geometry_source(self):
        """Its own name if it has a decoder, otherwise `point_cloud`."""
        return self.name if self.has_decoder else POINT_CLOUD

    @property
    def has_decoder(self):
        """Whether distances to obstacles can be decoded from z_E."""
        return self.path.with_suffix(DECODER).exists()

    @functools.cached_property
    def decoder(self):
        """The network from z_E and points to distances from obstacles (m), beside the encoder's.

        Raises NetworkError: there is none.
        """
        if not self.has_decoder:
            raise NetworkError(f"{self.name} has no decoder: no distances can be decoded from z_E")
        return load_network(self.path.with_suffix(DECODER))

    def distances(self, scene, points):
        """Decoded distances of points (n, 3), m, from the nearest obstacle: float32 (n,), m.

        Raises NetworkError: there is no decoder, or it cannot be used.
        """
        inputs = {"latent": self(scene), "points": np.float32(points)}
        inputs = {name: torch.from_numpy(array)[None] for name, array in inputs.items()}
        return self.decoder.predict_one(inputs, len(points))

    def decoded_points(self, scene):
        """Points of a scene's obstacles, decoded from z_E alone: float32 (n, 3), m.

        Those points of a grid of `DECODED_CELL` whose decoded distance from an obstacle is below
        `DECODED_REACH`. The last scenes are remembered. Raises NetworkError as `distances`.
        """
        return self._decoded(scene)

    def _decode_points(self, scene):
        coarse = 3 * DECODED_CELL
        middles = _grid(coarse)
        # Only where a coarse cell may contain such points, all 27 of its cells are decoded.
        near = self.distances(scene, middles) < DECODED_REACH + coarse * 3**0.5 / 2
        around = DECODED_CELL * (np.stack(np.indices((3, 3, 3)), axis=-1).reshape(-1, 3) - 1)
        points = (middles[near][:, None] + around.astype(np.float32)).reshape(-1, 3)
        return points[self.distances(scene, points) < DECODED_REACH] if len(points) else points

    def close(self):
        """Close the simulated world it observes."""
        self._world.close()


def _progress(scenes, description):
    quiet = 0.2 if sys.stderr.isatty() else 30  # seconds
    return tqdm(scenes, description, unit="scene", mininterval=quiet)


def _read_latents(path, key):
    """What `NetworkEncoder.encode_demos` kept; None if there is none, or damaged or out of date."""
    try:
        with np.load(path) as file:
            return file["latents"] if file["key"] == key else None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


@functools.cache
def _grid(cell):
    """The centres of cells between `DECODED_LOW` and `DECODED_HIGH`: float32 (n, 3), m."""
    axes = [
        np.arange(a + cell / 2, b, cell) for a, b in zip(DECODED_LOW, DECODED_HIGH, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
