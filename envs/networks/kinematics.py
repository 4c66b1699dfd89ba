"""An arm's kinematics as inputs of networks."""

import torch
import torch.nn as nn
import torch.nn.functional as F

from roboarm_nmp.envs.robots.inverse_kinematics import kinematic_chain
from roboarm_nmp.envs.robots.kernels import JOINT, MIDDLE, POSITION, PRISMATIC, ROTATION, SCALE


class JacobianTranspose(nn.Module):
    """The end effector's Jacobian, transposed, times a vector.

    That is the direction in which the joints move the end effector fastest along the vector.

    Position and vector are transformed from the base to the frame of one joint after the other. A
    turn about the joint, whose axis is z, is a sum of three constant matrices, of which two are
    multiplied by the cosine and the sine of its angle. So a joint is a layer of three parts.

    Args:
        robot: an `envs.robots.robot.Robot`.
        rotates: the vector has an angular part.
    """

    def __init__(self, robot, rotates=False):
        super().__init__()
        chain = torch.tensor(kinematic_chain(robot))
        moving = chain[chain[:, JOINT] >= 0]
        self.size = 9 if rotates else 6  # position, vector, angular part
        # With a row vector x, cosine x a + sine x b + x c is x in a frame that is turned about z.
        a, c = torch.diag(torch.tensor([1.0, 1.0, 0.0])), torch.diag(torch.tensor([0.0, 0.0, 1.0]))
        b = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        parts, pushed = torch.stack([torch.zeros(3, 3), torch.zeros(3, 3), torch.eye(3)]), False
        turn, origin, weights, biases = torch.eye(3).double(), torch.zeros(3).double(), [], []
        for row in chain:
            # The next frame has x turn - origin.
            rotation = row[ROTATION:].reshape(3, 3)
            turn, origin = turn @ rotation, (origin + row[POSITION:ROTATION]) @ rotation
            if row[JOINT] < 0:
                continue
            parts = [torch.block_diag(*[part @ turn] * (self.size // 3)) for part in parts.double()]
            bias = torch.zeros(3, self.size).double()
            bias[0, :3], bias[2, :3] = -turn[2] * pushed, -origin
            weights.append(torch.cat(parts, 1).T)
            biases.append(bias.ravel())
            # A prismatic joint, instead of turning, moves the frame along z.
            pushed = bool(row[PRISMATIC])
            parts = torch.stack([0 * a, 0 * b, a + c] if pushed else [a, b, c])
            turn, origin = torch.eye(3).double(), torch.zeros(3).double()
        per_state = moving[:, SCALE, None] * F.one_hot(moving[:, JOINT].long(), robot.num_joints)
        self.register_buffer("weights", torch.stack(weights).float())
        self.register_buffer("biases", torch.stack(biases).float())
        self.register_buffer("per_state", per_state.float())  # joints' values, mimicked ones too
        self.register_buffer("middle", moving[:, MIDDLE].float())
        self.register_buffer("is_prismatic", moving[:, PRISMATIC] > 0)

    def forward(self, state, position, vector):
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
            a, b, c = F.linear(x, self.weights[i], self.biases[i]).split(self.size, 1)
            x = first[i - 1] * a + (second[i - 1] * b + c)
            frames.append(x)
        frames = torch.stack(frames, 1)
        px, py, _, vx, vy, vz = frames[:, :, :6].unbind(2)
        turning = px * vy - py * vx
        if self.size == 9:
            turning = turning + frames[:, :, 8]
        return torch.where(self.is_prismatic, vz, turning) @ self.per_state
