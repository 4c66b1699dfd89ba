"""Problems of MotionBenchMaker (Chamzas et al., RA-L 7(2), 2022) as queries with scenes.

The files are the JSON form of the problem set that VAMP distributes: `problems`, each with
`start` (7, rad), `goals` (one or more, 7, rad) and `obstacles`: `box` (`position`, `quat_xyzw`,
`size`), `cylinder` (`position`, `quat_xyzw`, `radius`, `length`), in m, in the base's frame.
"""

import json
from pathlib import Path

import numpy as np

from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene


def read_problems(path):
    """The problems in a JSON file: start and goal, float32 (n, 7), rad, and a list of n `Scene`s.

    The scenes have neither table nor floor, as published. The first of several goals is used.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is not of this form.
    """
    try:
        problems = json.loads(Path(path).read_text())["problems"]
        start = np.array([problem["start"] for problem in problems], np.float32)
        goal = np.array([problem["goals"][0] for problem in problems], np.float32)
        scenes = [_scene(problem["obstacles"]) for problem in problems]
    except (KeyError, TypeError, UnicodeDecodeError, json.JSONDecodeError, IndexError) as error:
        raise ValueError(f"{path}: not a file of MotionBenchMaker problems ({error!r})") from error
    return start, goal, scenes


def _scene(obstacles):
    for kind in sorted(set(obstacles) - {"box", "cylinder"}):
        if obstacles[kind]:
            raise KeyError(kind)
    boxes = [
        Box(tuple(box["position"]), tuple(box["size"]), tuple(box["quat_xyzw"]))
        for box in obstacles["box"]
    ]
    cylinders = [
        Cylinder(tuple(can["position"]), can["radius"], can["length"], tuple(can["quat_xyzw"]))
        for can in obstacles["cylinder"]
    ]
    return Scene((*boxes, *cylinders), table=None, floor=None)
