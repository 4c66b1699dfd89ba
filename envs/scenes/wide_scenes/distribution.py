"""The distribution of wide scenes, and scenes that know their places.

    scene = WideScenes(TRAINING).sample(rng)
    scene.places                          # where hands go

One or two sites stand around the arm, each at any distance and height, mirrored, scaled and turned.
Three arms of ten do not stand upright: they lean, or hang from a wall or a ceiling, so the whole
site is turned around them.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.robots.rotations import matrix
from roboarm_nmp.envs.scenes.places import Place
from roboarm_nmp.envs.scenes.primitives import (
    Box,
    ConvexHull,
    Cylinder,
    Obstacle,
    Scene,
    Sphere,
    hull_faces,
)
from roboarm_nmp.envs.scenes.random_boxes import FRICTION, Rng
from roboarm_nmp.envs.scenes.wide_scenes import homes, industry, outdoors
from roboarm_nmp.envs.scenes.wide_scenes.names import FAMILIES, TRAINING
from roboarm_nmp.envs.scenes.wide_scenes.site import Site, along, turned

SITES = {
    name: function
    for module in (homes, industry, outdoors)
    for name, function in vars(module).items()
    if name in FAMILIES
}
"""The function that builds a site of each family."""
# A place of the site is so far (m) from the shoulder, and so high above or below it (rad).
SHOULDER = np.array([0.0, 0.0, 0.33])
DISTANCE = (0.38, 0.75)
ELEVATION = (-0.9, 0.6)
FACING = 0.7  # rad: a site's front is turned by at most this from facing the arm
SCALE = (0.85, 1.2)
SECOND = 0.3  # share of the scenes with two sites
BETWEEN = (2.0, 4.3)  # rad, between the two
GROUND = 0.7  # share of the scenes with the ground the site stands on
# How the arm is mounted: share of the arms, and the angles (rad) from upright.
LEANING, ON_WALL, HANGING = (0.12, (0.15, 0.6)), (0.09, (1.45, 1.7)), (0.09, (2.9, math.pi))
# The least distance (m) of obstacles from the part of the robot's axis between these heights (m).
CLEAR, COLUMN = 0.13, np.linspace(0.12, 0.45, 8)
TRIES = 100
MOST = 100  # obstacles


@dataclass(frozen=True)
class WideScene(Scene):
    """A `Scene` with the `Place`s for the hand among its obstacles; equal by its obstacles."""

    places: tuple[Place, ...] = field(default=(), compare=False, repr=False)

    __hash__ = Scene.__hash__


@dataclass(frozen=True)
class WideScenes:
    """Scenes of several families, equally likely.

    Attributes:
        families: names among `names.FAMILIES`.
        base: the `Scene` without obstacles.
    """

    families: tuple[str, ...] = TRAINING
    base: WideScene = WideScene(friction=FRICTION, table=None, floor=None)

    def sample(self, rng: Rng) -> WideScene:
        """A scene drawn with a NumPy Generator."""
        scale = scale_of(self.base.robot)
        up = _mounted(rng)
        azimuth = rng.uniform(-math.pi, math.pi)
        obstacles, places = self._site(rng, up, azimuth, rng.random() < GROUND, scale)
        if rng.random() < SECOND:
            more = self._site(rng, up, azimuth + rng.uniform(*BETWEEN), False, scale)
            if len(obstacles) + len(more[0]) <= MOST:
                obstacles, places = obstacles + more[0], places + more[1]
        return replace(self.base, obstacles=tuple(obstacles), places=tuple(places))

    def sample_with_places(self, rng: Rng) -> tuple[Scene, list[Place]]:
        """The same, and a list of its `Place`s."""
        scene = self.sample(rng)
        return scene, list(scene.places)

    def _site(
        self, rng: Rng, up: np.ndarray, azimuth: float, ground: bool, scale: float
    ) -> tuple[list[Obstacle], list[Place]]:
        """A site in the direction of an azimuth, clear of the robot's column."""
        level = along(up)  # its columns: two level directions, and up
        for _ in range(TRIES):
            site = Site(rng)
            SITES[self.families[int(rng.integers(len(self.families)))]](site)
            if ground:
                site.box((0.5, 0.0, -0.03), (3.0, 3.0, 0.05))
            grown = scale * rng.uniform(*SCALE)
            focus = site.places[int(rng.integers(len(site.places)))].centre
            elevation = rng.uniform(*ELEVATION)
            outwards = level @ (math.cos(azimuth), math.sin(azimuth), 0.0)
            towards = math.cos(elevation) * outwards + math.sin(elevation) * up
            target = scale * (SHOULDER + rng.uniform(*DISTANCE) * towards)
            sideways = np.cross(up, outwards)
            facing = np.stack([outwards, sideways, up], axis=1)
            rotation = facing @ turned(rng.uniform(-FACING, FACING))
            offset = target - grown * rotation @ focus
            mirrored = rng.random() < 0.5
            if mirrored:  # about the place that is the focus
                offset = target - grown * rotation @ (focus * (1.0, -1.0, 1.0))
            obstacles, places = site.placed(rotation, offset, grown, mirrored)
            if all(_is_clear(obstacle, scale) for obstacle in obstacles):
                return obstacles, places
        raise RuntimeError(f"no site of {', '.join(self.families)} stands clear of the robot")


def _mounted(rng: Rng) -> np.ndarray:
    """The direction that is up, a unit vector (3,), in the frame of the robot's base."""
    drawn = rng.random()
    for share, angles in (LEANING, ON_WALL, HANGING):
        if drawn < share:
            tilt, azimuth = rng.uniform(*angles), rng.uniform(-math.pi, math.pi)
            side = math.sin(tilt)
            return np.array([side * math.cos(azimuth), side * math.sin(azimuth), math.cos(tilt)])
        drawn -= share
    return np.array([0.0, 0.0, 1.0])


def _is_clear(obstacle: Obstacle, scale: float) -> bool:
    """Whether an obstacle leaves room for the robot's column. (Distances are lower bounds.)"""
    column = np.zeros((len(COLUMN), 3))
    column[:, 2] = scale * COLUMN
    local = column - obstacle.position
    if isinstance(obstacle, Sphere):
        return bool((np.linalg.norm(local, axis=1) > obstacle.radius + scale * CLEAR).all())
    local = local @ matrix(obstacle.orientation)
    if isinstance(obstacle, ConvexHull):
        corners = np.array(obstacle.vertices)[hull_faces(obstacle.vertices)]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        beyond = local @ normals.T - (corners[:, 0] * normals).sum(1)
        return bool((beyond.max(axis=1) > scale * CLEAR).all())
    if isinstance(obstacle, Box):
        beyond = np.abs(local) - np.divide(obstacle.size, 2)
    else:
        assert isinstance(obstacle, Cylinder)
        across = np.linalg.norm(local[:, :2], axis=1) - obstacle.radius
        beyond = np.stack([across, np.abs(local[:, 2]) - obstacle.length / 2], axis=1)
    return bool((np.linalg.norm(np.maximum(beyond, 0.0), axis=1) > scale * CLEAR).all())
