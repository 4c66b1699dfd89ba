"""The robot in the metadata of a network, and whether a network fits a robot."""

from pathlib import Path

from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.networks.untrusted import NetworkError


def robot_metadata(robot: Robot) -> dict:
    """The part of a network's metadata that names its `Robot`, a dict; empty for the Panda."""
    arm = robot.arm
    return {} if arm == PANDA else {"robot": [arm.name, arm.fingerprint]}


def check_robot(path: str | Path, metadata: dict, robot: Robot) -> None:
    """Raise NetworkError unless the network at `path`, with this metadata, is for a `Robot`."""
    trained = metadata.get("robot", [PANDA.name, PANDA.fingerprint])
    wanted = [robot.arm.name, robot.arm.fingerprint]
    if trained != wanted:
        raise NetworkError(
            f"{path}: it was trained for the robot {_words(trained)}, not for {_words(wanted)}"
        )


def _words(robot):
    name, fingerprint = robot if isinstance(robot, list) and len(robot) == 2 else (robot, "?")
    return f"{name!r} ({str(fingerprint)[:12]})"
