"""How an arm is driven: the physics step, and the position controllers' gains."""

from collections.abc import Sequence

import numpy as np

from roboarm_nmp.envs.robots.body import Body
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.utils.bullet import pybullet as p

# One environment step is SUBSTEPS physics steps of TIME_STEP seconds under PyBullet's position
# controller; docs/guide/environment.md has the measured tracking error.
TIME_STEP = 1.0 / 120.0
SUBSTEPS = 4
STEP_SECONDS = SUBSTEPS * TIME_STEP
"""The MDP's clock: an environment step is 1/30 s."""
# Gains that `calibrate` tries, the Panda's among them.
GAINS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
NUM_POSES, NUM_STEPS, STEP = 16, 12, 0.03  # of a calibration; length of a step (normalised)


def calibrate(robot: Robot, gains: Sequence[float] = GAINS, seed: int = 0) -> tuple[float, float]:
    """The gain, one for all joints, with which an arm executes commanded steps best.

    From random configurations, without contacts, the arm is commanded steps of 0.03 (normalised)
    in random directions, as in an environment.

    Returns:
        gain, and the share of the commanded displacement that was executed with it (1: all of it).
    """
    client = p.connect(p.DIRECT)
    try:
        p.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP, deterministicOverlappingPairs=1, physicsClientId=client
        )
        p.setGravity(0, 0, -9.81, physicsClientId=client)
        body = Body(robot, client, drawn=False)  # once: large meshes take a second
        for link in range(-1, p.getNumJoints(body.id, physicsClientId=client)):
            p.setCollisionFilterGroupMask(body.id, link, 0, 0, physicsClientId=client)
        shares = []
        for gain in gains:
            body.gains = [gain] * len(body.gains)
            shares.append(_executed(body, np.random.default_rng(seed)))
    finally:
        p.disconnect(client)
    best = int(np.argmin(np.abs(np.array(shares) - 1.0)))
    return gains[best], shares[best]


def _executed(body, rng):
    """The share of the commanded displacement that is executed with the body's gains."""
    robot, client = body.robot, body.client
    commanded = executed = 0.0
    for _ in range(NUM_POSES):
        state = rng.uniform(-0.7, 0.7, robot.num_joints)
        direction = rng.normal(size=robot.num_joints)
        direction *= STEP / np.linalg.norm(direction)
        body.set_configuration(robot.denormalise(state))
        for step in range(NUM_STEPS):
            body.command(robot.denormalise(state + direction).tolist())
            for _ in range(SUBSTEPS):
                p.stepSimulation(physicsClientId=client)
            joints = p.getJointStates(body.id, robot.joint_indices, physicsClientId=client)
            after = robot.normalise([joint[0] for joint in joints])
            if step >= NUM_STEPS // 2:  # at speed
                executed += (after - state) @ direction / STEP
                commanded += STEP
            state = after
    return executed / commanded
