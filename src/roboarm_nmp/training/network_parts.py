"""Parts of policies' networks: averages, a layer, and inputs that ease learning."""

from typing import Any

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.goals import GOAL_TYPES
from roboarm_nmp.envs.robots.inverse_kinematics import kinematic_chain
from roboarm_nmp.envs.robots.kernels import JOINT, MIDDLE, POSITION, PRISMATIC, ROTATION, SCALE
from roboarm_nmp.envs.robots.robot import Robot

# With a row vector x, cos x ALONG + sin x ACROSS + x FIXED is x in a frame that is turned about z.
ALONG = np.diag([1.0, 1.0, 0.0])
FIXED = np.diag([0.0, 0.0, 1.0])
ACROSS = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def polyak_update(target: nn.Module, network: nn.Module, tau: float) -> None:
    """target <- (1 - tau) target + tau network, all parameters at once."""
    with torch.no_grad():
        torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage]
            list(target.parameters()), list(network.parameters()), tau
        )


class Bf16Linear(nn.Linear):
    """A linear layer whose product is computed in bfloat16 in training, if `bf16`.

    The result is of the input's type.
    """

    def __init__(self, num_inputs: int, num_outputs: int, bf16: bool):
        super().__init__(num_inputs, num_outputs)
        self.bf16 = bf16

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if not (self.bf16 and self.training):
            return super().forward(x)
        return F.linear(x.bfloat16(), self.weight.bfloat16(), self.bias.bfloat16()).to(x.dtype)


class JacobianTranspose(nn.Module):
    """The end effector's Jacobian, transposed, times a vector.

    That is the direction in which the joints move the end effector fastest along the vector.

    Position and vector are transformed from the base to the frame of one joint after the other,
    whose axis is z. The turn of a joint is a sum of three constant matrices, two of them times the
    cosine and the sine of its angle. So from joint to joint there is a layer of three parts.

    Args:
        robot: an `envs.robots.robot.Robot`.
        rotates: the vector has an angular part.
    """

    def __init__(self, robot: Robot, rotates: bool = False):
        super().__init__()
        self.size = 9 if rotates else 6  # position, vector, angular part
        chain = kinematic_chain(robot)
        moving = chain[chain[:, JOINT] >= 0]
        of_sliding_joint = (0 * ALONG, 0 * ACROSS, ALONG + FIXED)
        parts = of_sliding_joint  # of the turn of the joint before
        slides = False
        weights = []
        biases = []
        turn = np.eye(3)
        origin = np.zeros(3)
        for row in chain:
            # x in the frame of the joint before is x turn - origin in this one.
            rotation = row[ROTATION:].reshape(3, 3)
            turn = turn @ rotation
            origin = (origin + row[POSITION:ROTATION]) @ rotation
            if row[JOINT] < 0:
                continue
            bias = np.zeros((3, self.size))
            bias[0, :3] = -turn[2] * slides  # times the value of the joint before
            bias[2, :3] = -origin
            vectors = np.eye(self.size // 3)
            weights.append(np.hstack([np.kron(vectors, part @ turn) for part in parts]).T)
            biases.append(bias.ravel())
            slides = row[PRISMATIC] > 0
            parts = of_sliding_joint if slides else (ALONG, ACROSS, FIXED)
            turn = np.eye(3)
            origin = np.zeros(3)
        per_state = moving[:, SCALE, None] * (moving[:, JOINT, None] == np.arange(robot.num_joints))
        self.weights = nn.Buffer(torch.tensor(np.array(weights)).float())
        self.biases = nn.Buffer(torch.tensor(np.array(biases)).float())
        self.middle = nn.Buffer(torch.tensor(moving[:, MIDDLE]).float())
        self.per_state = nn.Buffer(torch.tensor(per_state).float())  # also of mimicking joints
        self.is_prismatic = nn.Buffer(torch.tensor(moving[:, PRISMATIC] > 0))

    def forward(
        self, state: torch.Tensor, position: torch.Tensor, vector: torch.Tensor
    ) -> torch.Tensor:
        """(N, n), (N, 3), (N, 3 or 6) -> (N, n): per unit of the normalised configuration.

        Position (m) and vector are in the world's axes.
        """
        values = F.linear(state, self.per_state, self.middle)
        first = torch.where(self.is_prismatic, values, torch.cos(values)).split(1, 1)
        second = torch.sin(values).split(1, 1)
        x = torch.cat([position, vector], 1)
        x = F.linear(x, self.weights[0], self.biases[0])[:, 2 * self.size :]
        frames = [x]
        for i in range(1, len(self.weights)):
            along, across, fixed = F.linear(x, self.weights[i], self.biases[i]).split(self.size, 1)
            x = first[i - 1] * along + (second[i - 1] * across + fixed)
            frames.append(x)
        frames = torch.stack(frames, 1)
        px, py, _, vx, vy, vz = frames[:, :, :6].unbind(2)
        turning = px * vy - py * vx
        if self.size == 9:
            turning = turning + frames[:, :, 8]
        return torch.where(self.is_prismatic, vz, turning) @ self.per_state


def pose_difference(pose: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """Differences from poses to goals: (N, 7), (N, 7) -> (N, 6).

    Poses are positions (m) and quaternions (xyzw) of norm 1. A difference consists of the
    difference of positions (m) and the vector part of the rotation between the two, in the world's
    axes: the axis times the sine of half the angle. A quaternion and its negative give the same.
    """
    here = pose[:, 3:]
    there = goal[:, 3:]
    x, y, z, w = here.split(1, dim=1)
    a, b, c, d = there.split(1, dim=1)
    vector = torch.cat(
        [
            w * a - d * x + c * y - b * z,
            w * b - d * y + a * z - c * x,
            w * c - d * z + b * x - a * y,
        ],
        dim=1,
    )
    over_half_a_turn = (here * there).sum(dim=1, keepdim=True) < 0.0
    vector = torch.where(over_half_a_turn, -vector, vector)
    return torch.cat([goal[:, :3] - pose[:, :3], vector], dim=1)


class GoalFeatures(nn.Module):
    """Network inputs: observation, goal and, unless `plain`, functions of them that ease learning.

    Those are sine and cosine of the joint angles, the differences to the goal, and, with
    `jacobian`, how the joints move the end effector straight to it. They have no parameters.

    Args:
        env: the environment; its goal type, velocities and link distances are the inputs'.
        plain: observation and goal as they are.
        jacobian: without effect where the goal is a configuration.

    Attributes:
        size: number of inputs.
        num_joints: n of the arm.
    """

    def __init__(self, env: RoboArmEnv, plain: bool = False, jacobian: bool = True):
        super().__init__()
        bare = env.unwrapped
        observation_space: Any = env.observation_space
        bare_space: Any = bare.observation_space
        robot = bare.robot
        self.plain = plain
        self.num_joints = robot.num_joints
        goal_type = GOAL_TYPES[bare.goal_type]
        self.to_configuration = goal_type.has_configuration
        self.to_position = goal_type.has_position and not goal_type.has_rotation
        self.to_pose = goal_type.has_rotation
        self.jacobian = None
        if jacobian and not plain and goal_type.has_position:
            self.jacobian = JacobianTranspose(robot, rotates=goal_type.has_rotation)
        low, high = torch.tensor(robot.lower), torch.tensor(robot.upper)
        self.middle = nn.Buffer(((high + low) / 2).float())
        self.half_range = nn.Buffer(((high - low) / 2).float())
        # The configuration, velocities (or not) and the end effector's position or pose.
        end = bare_space["observation"].shape[0]
        self.ee = slice(end - goal_type.end_effector_size, end)
        # Link distances follow; the first number of each link is the distance.
        links, numbers = robot.link_distances_shape
        near = slice(end, end + links * numbers, numbers)
        self.distances = near if getattr(env, "appends_link_distances", False) else None
        observation = torch.zeros(1, *observation_space["observation"].shape)
        goal = torch.zeros(1, *observation_space["desired_goal"].shape)
        self.size = self(observation, goal).shape[1]

    def forward(self, observation: torch.Tensor, desired_goal: torch.Tensor) -> torch.Tensor:
        """(N, o), (N, g) -> (N, size)."""
        inputs = [observation, desired_goal]
        if not self.plain:
            joints = self.num_joints
            angles = observation[:, :joints] * self.half_range + self.middle
            inputs += [torch.sin(angles), torch.cos(angles)]
            if self.to_pose:
                inputs.append(5.0 * pose_difference(observation[:, self.ee], desired_goal))
            if self.to_position:
                inputs.append(5.0 * (desired_goal[:, -3:] - observation[:, self.ee]))
            if self.jacobian is not None:
                position = observation[:, self.ee][:, :3]
                towards = self.jacobian(observation[:, :joints], position, inputs[-1])
                inputs += [towards, towards / (towards.norm(dim=1, keepdim=True) + 1e-6)]
            if self.to_configuration:
                inputs.append(5.0 * (desired_goal[:, :joints] - observation[:, :joints]))
        if self.distances is not None:
            inputs.append(10.0 * observation[:, self.distances])  # they are small numbers
        return torch.cat(inputs, dim=1)
