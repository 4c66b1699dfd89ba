"""Robots by name or file: `panda`, a URDF, or a YAML file that adds what the URDF doesn't say.

urdf: kuka_iiwa/model.urdf       # relative to this file, or package:pybullet_data/kuka_iiwa/…
name: iiwa                       # everything below may be left out
joints: [lbr_iiwa_joint_1, …]
end_effector: lbr_iiwa_link_7    # a link, and a position in its frame (m)
end_effector_position: [0, 0, 0.05]
fixed: {finger_joint: 0.04}      # where other joints are held (rad or m)
limits: {joint_1: [-3.0, 3.0]}   # position limits (rad or m)
srdf: iiwa.srdf
packages: {iiwa_description: ../iiwa_description}
base_position: [0, 0, 0]
base_orientation: [0, 0, 0, 1]
gain: 0.6
acceleration_steps: 5            # in which a plan's sub-goals reach full speed
velocity: 2.0                    # of trajectories, rad/s; or joint by joint, as with jerk
acceleration: 10                 # rad/s^2
jerk: {joint_1: 1000, …}         # rad/s^3
datasheet_limits: {joint_1: [-2.9, 2.9]}  # narrower position limits, for --limits datasheet
"""

import functools
import importlib.util
from dataclasses import replace
from pathlib import Path

from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.robots.untrusted import RobotError
from roboarm_nmp.envs.robots.urdf import check_options, robot_from_urdf
from roboarm_nmp.utils.documents import DocumentError, load_document, plain_data

ROBOT_FILES = (".urdf", ".yaml", ".yml")
MAX_FILE = 100_000  # bytes


def load_robot(name_or_path: str | Path) -> Robot:
    """Load the `Robot` called `panda`, or from a URDF or YAML file, once per process.

    Raises RobotError: there is no such robot, or the file cannot be used.
    """
    if str(name_or_path) == PANDA.name:
        return PANDA
    path = Path(name_or_path)
    if path.suffix.lower() not in ROBOT_FILES:
        raise RobotError(f"a robot is {PANDA.name!r} or a file (.urdf, .yaml), got {path}")
    try:
        path = path.resolve(strict=True)
        return replace(_load(path, path.stat().st_mtime_ns), source=str(path))
    except OSError as error:
        raise RobotError(f"{path}: {error.strerror}") from error


@functools.lru_cache(16)
def _load(path, _):
    if path.suffix.lower() == ".urdf":
        return robot_from_urdf(path)
    options = _read(path)
    if "urdf" not in options:
        raise RobotError(f"{path}: lacks `urdf`")
    urdf = _located(path, options.pop("urdf"))
    if "srdf" in options:
        options["srdf"] = _located(path, options["srdf"])
    if "packages" in options:
        folders = options["packages"].items()
        options["packages"] = {name: _located(path, folder) for name, folder in folders}
    options.setdefault("name", path.stem)
    return robot_from_urdf(urdf, **options)


def _read(path):
    if not path.is_file() or path.stat().st_size > MAX_FILE:
        raise RobotError(f"{path}: no file, or more than {MAX_FILE // 1000} kB")
    try:
        options = plain_data(load_document(path, allow_tags=False))
    except DocumentError as error:
        raise RobotError(str(error)) from error
    if not isinstance(options, dict):
        raise RobotError(f"{path}: must be a mapping with the key `urdf`")
    options = {name: value for name, value in options.items() if value is not None}
    check_options(path, options)
    return options


def _located(path, file):
    """The path of a file that a robot's file names."""
    if file.startswith("package:"):  # of an installed Python package
        package, _, rest = file.removeprefix("package:").partition("/")
        spec = importlib.util.find_spec(package) if package.isidentifier() else None
        if spec is None or not spec.submodule_search_locations:
            raise RobotError(f"{path}: the Python package {package!r} is not installed")
        return Path(spec.submodule_search_locations[0], rest)
    return path.parent / file
