"""Scene encoders as something to call: a `Scene` -> z_E, the numbers a policy sees of it.

    encoder = SceneEncoder("vae")                     # of `envs/perception/pretrained`
    encoder = SceneEncoder("runs/.../encoder.pt")     # trained by a script of scene_embedding_train
    encoder = SceneEncoder("oracle")                  # the obstacles themselves
    encoder = SceneEncoder("points")                  # points of them that four sensors see
    encoder = SceneEncoder("points:32:field")         # points that z_E of the encoder `field` tells
    env = SceneEncodingWrapper(envs.make("random_boxes_hard"), encoder)

Paper: sections 5.1 and 5.3. `SceneEncodingWrapper` is in `envs.wrappers`.
"""

import contextlib
import functools
import hashlib
import io
import re
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.datasets.observations import sensors_from_json
from roboarm_nmp.envs.networks.exported_networks import load_network
from roboarm_nmp.envs.networks.operations import NetworkError
from roboarm_nmp.envs.perception.point_clouds import farthest_points, keep_points, seen_points
from roboarm_nmp.envs.perception.sensors import POSE, PointCloud, SensorWorld
from roboarm_nmp.envs.scenes.primitives import ROW, padded_rows
from roboarm_nmp.envs.utils.files import write_atomically

ORACLE, POINTS = "oracle", "points"
NUM_POINTS = 64
"""Of `points`; `points:32` has 32."""
PACKAGED = Path(__file__).parent / "pretrained"
# The end of a decoder's name, beside its encoder's.
DECODER = ".decoder.pt"
# Obstacles that the oracle has room for: `narrow_shelves` has 28.
MAX_OBSTACLES = 32
CACHED_SCENES, CACHED_TOLD, CACHED_CHECKERS = 500, 1_000, 64
TOLD_CELL, TOLD_REACH, TOLD_RADIUS = 0.025, 0.015, 0.0  # m
# The grid: wherever the arm can be, above the table.
TOLD_LOW, TOLD_HIGH = (-0.9, -0.9, 0.0), (0.9, 0.9, 1.5)


def oracle(scene):
    """The obstacles' true parameters, padded: float32 (MAX_OBSTACLES * 12,).

    Of each obstacle 1 and its row of `envs.scenes.primitives.to_array`; zeros where there is none. Raises
    ValueError if there are more than `MAX_OBSTACLES`.
    """
    count = len(scene.obstacles)
    if count > MAX_OBSTACLES:
        raise ValueError(f"the oracle has room for {MAX_OBSTACLES} obstacles, not for {count}")
    return padded_rows(scene.obstacles, MAX_OBSTACLES).ravel()


def points(scene, number=NUM_POINTS, encoder=None):
    """Points of a scene's obstacles that four sensors see, as far apart as can be: (number * 3,).

    float32, m, in the base's frame, see `envs.perception.point_clouds.farthest_points`. With the name of an encoder,
    those that it tells of.
    """
    there = seen_points(scene) if encoder is None else told_points(scene, encoder)
    return farthest_points(there, number).ravel()


def with_told(encoder, arguments):
    """Arguments of `envs.make`, a dict, with what an encoder tells in the place of seen points.

    Those are the points in `encoder`, and `proximity` of points.
    """
    told = dict(arguments)
    if told.get("proximity") == POINTS:
        told["proximity"] = encoder
    if match := re.fullmatch(rf"{POINTS}(?::(\d+))?", str(told.get("encoder"))):
        told["encoder"] = f"{POINTS}:{match[1] or NUM_POINTS}:{encoder}"
    return told


@functools.lru_cache(CACHED_TOLD)
def told_points(scene, name):
    """Points of a scene's obstacles as an encoder with a decoder tells them: float32 (n, 3), m.

    Of a grid of `TOLD_CELL` those that the decoder says are nearer than `TOLD_REACH` to an
    obstacle. They come from z_E alone. The last scenes are remembered.

    Raises NetworkError: there is no decoder, or it cannot be used.
    """
    encoder, coarse = scene_encoder(name), 3 * TOLD_CELL
    middles = _grid(coarse)
    # Where it may be that near somewhere in a coarse cell, all 27 of its cells are asked about.
    near = encoder.distances(scene, middles) < TOLD_REACH + coarse * 3**0.5 / 2
    around = TOLD_CELL * (np.stack(np.indices((3, 3, 3)), axis=-1).reshape(-1, 3) - 1)
    points = (middles[near][:, None] + around.astype(np.float32)).reshape(-1, 3)
    return points[encoder.distances(scene, points) < TOLD_REACH] if len(points) else points


@functools.lru_cache(CACHED_CHECKERS)
def told_checker(scene, name):
    """A `CollisionChecker` of table, floor, and what z_E tells of a `Scene`'s obstacles."""
    return CollisionChecker(replace(scene, obstacles=()), told_points(scene, name), TOLD_RADIUS)


def _read_latents(path, key):
    """What `SceneEncoder.encode_demos` kept; None if it is not there, damaged or out of date."""
    try:
        with np.load(path) as file:
            return file["latents"] if file["key"] == key else None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def packaged_encoders():
    """Names of the encoders in `PACKAGED`."""
    return sorted(path.stem for path in PACKAGED.glob("*.pt") if not path.match(f"*{DECODER}"))


@functools.lru_cache
def scene_encoder(name):
    """The `SceneEncoder` of a name, one for the whole process."""
    return SceneEncoder(name)


class SceneEncoder:
    """Encodes scenes; an equal scene is encoded once.

    Args:
        name: `oracle`, `points`, the name of an encoder in `PACKAGED`, or the path of a network
            (encoder.pt).

    Attributes:
        name: as given, a string.
        path: of the network; None for `oracle` and `points`.
        size: of z_E.
        row_size: numbers of it that belong together: those of one obstacle or point, or all.

    Raises:
        NetworkError: the file cannot be used.
    """

    def __init__(self, name):
        self.name = str(name)
        self.path = self._world = self._told_by = None
        self._of_demos = {}  # scene -> z_E
        if self.name == ORACLE:
            self._encode, self.size, self.row_size = oracle, MAX_OBSTACLES * (1 + ROW), 1 + ROW
        elif match := re.fullmatch(rf"{POINTS}(?::([1-9]\d{{0,3}})(?::(.+))?)?", self.name):
            number, self._told_by = int(match[1] or NUM_POINTS), match[2]
            if self._told_by is not None:
                scene_encoder(self._told_by).decoder  # noqa: B018 (or it raises)
            self._encode = functools.partial(points, number=number, encoder=self._told_by)
            self.size, self.row_size = 3 * number, 3
        else:
            packaged = PACKAGED / f"{name}.pt"
            self.path = packaged if packaged.exists() else Path(name)
            self._network = load_network(self.path)
            if self._network.metadata.get("kind") != "encoder":
                raise NetworkError(f"{name}: not an encoder, but {self._network.metadata!r}")
            try:
                self.sensors = sensors_from_json(self._network.metadata["sensors"])
            except (KeyError, TypeError, ValueError) as error:
                raise NetworkError(f"{name}: its sensors make no sense: {error!r}") from error
            self._world = SensorWorld()
            self._encode = lambda scene: self.encode(self.look(scene))
            self.size = self.row_size = len(self(self._world.scene))

    @functools.cached_property
    def _cached(self):
        return functools.lru_cache(CACHED_SCENES)(self._encode)

    def __call__(self, scene):
        """z_E of a `Scene`, float32 (size,); not to be changed."""
        z = self._of_demos.get(scene)
        return self._cached(scene) if z is None else z

    def encode_demos(self, demos):
        """z_E of the scenes of `envs.datasets.Demos`: float32 (n, size). Later calls know them.

        So do those who ask for their points (`envs.perception.point_clouds`), with `points`.

        A trained encoder looks at them once, with a progress bar: z_E is kept in a file beside it,
        `<encoder>.<task>.npz`, which is made anew when the encoder or the scenes are others; where
        that cannot be written, it is not.
        """
        seen = [demos.scenes[i] for i in range(len(demos))]
        different = list(dict.fromkeys(seen))
        quiet = 0.2 if sys.stderr.isatty() else 30  # seconds

        def encode():
            bar = tqdm(seen, desc=f"encoding {demos.task}", unit="scene", mininterval=quiet)
            return np.stack([self(scene) for scene in bar])

        if self.path is None:
            if self.name.startswith(POINTS) and self._told_by is None:
                for scene in tqdm(
                    different, f"looking at {demos.task}", unit="scene", mininterval=quiet
                ):
                    keep_points(scene)
            self._of_demos |= {scene: self._encode(scene) for scene in different}
            return np.stack([self._of_demos[scene] for scene in seen])
        path = self.path.with_suffix(f".{demos.task}.npz")
        key = hashlib.sha256(self.path.read_bytes() + repr(seen).encode()).hexdigest()
        latents = _read_latents(path, key)
        if latents is None:
            latents = encode()
            file = io.BytesIO()
            np.savez(file, key=key, latents=latents)
            with contextlib.suppress(OSError):  # where nothing can be written, it is not kept
                write_atomically(path, file.getvalue())
        self._of_demos |= zip(seen, latents, strict=True)
        return latents

    def look(self, scene):
        """Its network's inputs, a batch of 1: what the sensors see of a `Scene`."""
        self._world.show(scene, POSE)
        inputs = {}
        for name, sensor in self.sensors.items():
            seen = sensor.observe(self._world)
            if isinstance(sensor, PointCloud):
                inputs |= {f"{name}_{output}": array for output, array in seen.items()}
            else:
                inputs[name] = seen["rgb"]
        return {name: torch.from_numpy(inputs[name])[None] for name in self._network.inputs}

    def encode(self, seen):
        """z_E, float32 (size,), of what `look` returned. Raises NetworkError: it is none."""
        return self._network.row(seen)

    @property
    def proximity(self):
        """Distances for `envs.make(proximity=...)` that know what z_E knows.

        Where z_E cannot tell of distances, those from the `points` that four sensors see.
        """
        if self.name == ORACLE:
            return "obstacles"
        return self.name if self.has_decoder else self._told_by or "points"

    @property
    def has_decoder(self):
        """Whether it can tell how far obstacles are."""
        return self.path is not None and self.path.with_suffix(DECODER).exists()

    @functools.cached_property
    def decoder(self):
        """The network from z_E and points to distances from obstacles (m), beside the encoder's.

        Raises NetworkError: there is none.
        """
        if not self.has_decoder:
            raise NetworkError(f"{self.name} has no decoder: it cannot tell how far obstacles are")
        return load_network(self.path.with_suffix(DECODER))

    def distances(self, scene, points):
        """How far points (n, 3), m, are from the nearest obstacle as z_E tells: float32 (n,), m.

        Raises NetworkError: there is no decoder, or it cannot be used.
        """
        inputs = {"latent": self(scene), "points": np.float32(points)}
        inputs = {name: torch.from_numpy(array)[None] for name, array in inputs.items()}
        return self.decoder.row(inputs, len(points))

    def close(self):
        """Close the world it looks into."""
        if self._world is not None:
            self._world.close()


class LatentTable:
    """Latents of scenes, each stored once: `rows` (n, size) has them, in the order they came."""

    def __init__(self, size):
        self.size, self._row_of = size, {}  # the latent's bytes -> its row
        self._latents = np.zeros((1, size), np.float32)

    @property
    def rows(self):
        return self._latents[: len(self._row_of)]

    def row_of(self, latent):
        """The row of a latent (size,), which is added if it is new."""
        latent = np.float32(latent)
        row = self._row_of.setdefault(latent.tobytes(), len(self._row_of))
        if row == len(self._latents):
            self._latents = np.concatenate([self._latents, np.zeros_like(self._latents)])
        self._latents[row] = latent
        return row


@functools.cache
def _grid(cell):
    """The middles of cells between `TOLD_LOW` and `TOLD_HIGH`: float32 (n, 3), m."""
    axes = [np.arange(a + cell / 2, b, cell) for a, b in zip(TOLD_LOW, TOLD_HIGH, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
