"""One step of a pretrained policy with ONNX Runtime alone, without roboarm_nmp.

roboarm policies bc-config-double_walls-s1 --export policy.onnx
python examples/08_policy_elsewhere.py policy.onnx
"""

import json
import sys

import numpy as np
import onnxruntime

policy = onnxruntime.InferenceSession(sys.argv[1])
properties = policy.get_modelmeta().custom_metadata_map
LOW, HIGH = np.array(json.loads(properties["joint_limits"]))  # rad
MAX_STEP = json.loads(properties["env"]).get("max_step", 0.03)


def next_joint_angles(angles, end_effector, goal):
    """Joint angles (7,), rad, and the end effector's position (3,), m -> joint angles to go to."""
    state = (2 * angles - HIGH - LOW) / (HIGH - LOW)
    inputs = {
        "observation": np.concatenate([state, end_effector]),
        "achieved_goal": state,
        "desired_goal": (2 * goal - HIGH - LOW) / (HIGH - LOW),
    }
    batch = {name: values[None].astype(np.float32) for name, values in inputs.items()}
    [action] = np.asarray(policy.run(["action"], batch)[0])
    action = action * min(1.0, MAX_STEP / np.linalg.norm(action))
    return angles + action * (HIGH - LOW) / 2


start = np.array([0.0, -0.4, 0.0, -2.2, 0.0, 1.8, 0.8])
goal = np.array([1.2, 0.1, 0.2, -1.9, 0.1, 2.0, 0.9])
print(*next_joint_angles(start, np.array([0.434, 0.0, 0.437]), goal).round(5))
