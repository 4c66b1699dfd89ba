"""What an arm is: `PANDA`, and any arm that a URDF describes."""
