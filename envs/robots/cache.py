"""A cache on disk of what takes seconds to find out about an arm from a URDF.

It is in the user's cache folder (`utils.files.cache_folder`). A damaged file is written anew.
"""

import contextlib
import hashlib
import importlib.metadata
import json
import re
from collections.abc import Callable

from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.utils.files import cache_folder, write_atomically

VERSION = 2  # of the results: files of another one are not read


def cached(name: str, robot: Robot, settings: list, compute: Callable):
    """The result of `compute()`, from the cache where it has it.

    Args:
        name: of what is computed.
        robot: the `Robot` that it is computed from.
        settings: whatever else it depends on, for JSON.
        compute: a function without arguments; its result is lists and numbers. What it raises is
            not cached.
    """
    # Contents of meshes are in the robot's fingerprint; their paths do not matter.
    xml = re.sub(r'filename="[^"]*"', "", robot.xml)
    version = importlib.metadata.version("pybullet")
    key = json.dumps([VERSION, name, robot.fingerprint, xml, settings, version])
    file = f"{hashlib.sha256(key.encode()).hexdigest()}.json"
    with contextlib.suppress(OSError, ValueError):
        (result,) = json.loads((cache_folder() / "robots" / file).read_bytes())
        return result
    result = compute()
    with contextlib.suppress(OSError):  # without a folder to write to, it is computed each time
        (cache_folder() / "robots").mkdir(parents=True, exist_ok=True)
        write_atomically(cache_folder() / "robots" / file, json.dumps([result]).encode())
    return result
