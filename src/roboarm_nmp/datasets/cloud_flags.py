"""The flags of commands that take a point cloud, and the scene of its points."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import FLOOR, POINT_RADIUS, TABLE, ObservedScene
from roboarm_nmp.utils.flags import NonNegativeFloat, NonNegativeInt, PositiveFloat

ALMOST_ALL = 0.99  # of a cloud's points: its units or its frame are probably others


@dataclass(kw_only=True)
class CloudFlags:
    """A point cloud's file, and how it is prepared (docs/customise/point_cloud.md)."""

    cloud: Path | None = None
    """the point cloud: a .ply, .pcd, .npy or .npz file, or a depth image (with --intrinsics)"""
    units: Literal["m", "cm", "mm"] | None = None
    """of the lengths in the file; by default m, and mm for a .png"""
    frame: str | None = None
    """pose of the cloud's frame, or of the camera, in the frame of the robot's base: x y z (m) and
    a quaternion x y z w; by default the same frame"""
    intrinsics: str | None = None
    """of the depth image's camera: fx fy cx cy, pixels"""
    recorded_at: str | None = None
    """joint angles of the arm when the cloud was recorded, rad, whose points are left out; by
    default the start"""
    arm_distance: NonNegativeFloat | None = None
    """m: points nearer to the arm than this are its own; by default 0.02"""
    table: bool = True
    """the standard table and floor are there, and their points are left out; otherwise all that is
    there are points"""
    workspace: str | None = None
    """lower and upper corner, x y z x y z, m: points outside are left out; by default a cube that
    the arm cannot leave"""
    cell: PositiveFloat | None = None
    """m: one point stays per cube of this size; by default 0.025, scaled with the arm's reach"""
    min_points: NonNegativeInt | None = None
    """a cube is an outlier if it and the 26 around it have fewer points; by default 3"""
    allow_empty: bool = False
    """plan even if nearly all points of the cloud are left out as not finite or out of reach"""
    point_radius: NonNegativeFloat = POINT_RADIUS
    """m, of the ball around each point"""


def check_without_cloud(flags: CloudFlags) -> None:
    """Raise ValueError if a flag is given that goes with a cloud."""
    for field in dataclasses.fields(CloudFlags):
        if getattr(flags, field.name) != field.default:
            raise ValueError(f"--{field.name.replace('_', '-')} goes with --cloud FILE: add it")


def numbers_in(flag: str, text: str, number: int) -> np.ndarray:
    """So many finite numbers in the text of a flag, float64. Raises ValueError."""
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError as error:
        raise ValueError(f"{flag}: {error}") from error
    if len(values) != number or not np.isfinite(values).all():
        raise ValueError(f"{flag} must be {number} finite numbers, got {text!r}")
    return values


def configuration_in(flag: str, text: str, robot: Robot) -> np.ndarray:
    """A configuration (n,), rad, in the text of a flag. Raises ValueError: outside the limits."""
    configuration = numbers_in(flag, text, robot.num_joints)
    outside = np.abs(robot.normalise(configuration)) > 1.0 + 1e-6
    if outside.any():
        joint = int(outside.argmax())
        limits = f"{robot.lower[joint]:.4f} to {robot.upper[joint]:.4f}"
        raise ValueError(f"{flag}: joint {joint + 1} is outside its limits, {limits} rad")
    return configuration


def observed_scene(
    flags: CloudFlags, robot: Robot, start: np.ndarray, find_left_out: bool = False
) -> tuple[ObservedScene, np.ndarray]:
    """The scene of the cloud's points, and the points that were left out: float32 (n, 3), m.

    Points that were only thinned out are in neither. What was left out is printed; the points
    themselves are found if `find_left_out`.

    Args:
        flags: with a cloud.
        robot: the `Robot`.
        start: joint angles (n,), rad, of the arm at the recording, unless the flags name others.

    Raises ValueError: the cloud cannot be used, or next to nothing remains.
    """
    from roboarm_nmp.datasets.cloud_files import load_cloud
    from roboarm_nmp.envs.perception.point_clouds import prepare_cloud  # Numba takes a while

    path = flags.cloud
    assert path is not None
    recorded_at = start
    if flags.recorded_at is not None:
        recorded_at = configuration_in("--recorded-at", flags.recorded_at, robot)
    frame = None if flags.frame is None else numbers_in("--frame", flags.frame, 7)
    intrinsics = None
    if flags.intrinsics is not None:
        intrinsics = numbers_in("--intrinsics", flags.intrinsics, 4).tolist()
    table, floor = (TABLE, FLOOR) if flags.table else (None, None)
    options: dict[str, Any] = {"table": table, "floor": floor}
    for name in ("cell", "min_points", "arm_distance"):
        if getattr(flags, name) is not None:
            options[name] = getattr(flags, name)
    if flags.workspace is not None:
        options["workspace"] = numbers_in("--workspace", flags.workspace, 6).reshape(2, 3)
    cloud = load_cloud(path, flags.units, frame, intrinsics)
    prepare_cloud(cloud[:0], robot, recorded_at)  # what happens once per arm, outside of the time
    began = time.perf_counter()
    points, removed = prepare_cloud(cloud, robot, recorded_at, **options)
    seconds = time.perf_counter() - began
    numbers = [f"{number:,} {step}" for step, number in removed.items() if number]
    print(f"{path}: {len(cloud):,} points; left out: {', '.join(numbers) or 'none'}")
    print(f"{len(points):,} points remain, prepared in {1000 * seconds:.0f} ms")
    unusable = removed["not finite"] + removed["outside the workspace"]
    if unusable >= ALMOST_ALL * len(cloud) and not flags.allow_empty:
        raise ValueError(
            f"{path}: {unusable:,} of {len(cloud):,} points are not finite or out of reach, so "
            f"obstacles may be missing: check --units, --frame and --workspace, or plan without "
            f"them (--allow-empty)"
        )
    scene = ObservedScene(
        points=points, point_radius=flags.point_radius, robot=robot, table=table, floor=floor
    )
    if not find_left_out:
        return scene, np.zeros((0, 3), np.float32)
    options["cell"] = 1e-4  # m: nearly nothing is thinned out
    of_obstacles, _ = prepare_cloud(cloud, robot, recorded_at, **options)
    finite = cloud[np.isfinite(cloud).all(1)]
    one, other = (np.ascontiguousarray(part).view("V12").ravel() for part in (finite, of_obstacles))
    return scene, finite[~np.isin(one, other)]
