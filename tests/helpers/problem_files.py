"""Small files of problems in other programs' formats, written by hand."""

import json

OPENING = 0.065
GOALS = [[0.5, -0.3, 0.0, -2.0, 0.0, 1.7, 0.8], [0.6, -0.3, 0.0, -2.0, 0.0, 1.7, 0.8]]
START = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]

MOVEIT_SCENE = """\
name: ""
robot_model_name: panda
fixed_frame_transforms:
  - child_frame_id: world
    transform: {translation: [0, 0, 0], rotation: [0, 0, 0, 1]}
robot_state:
  joint_state: {name: [panda_joint1], position: [0]}
  multi_dof_joint_state:
    joint_names: [virtual_joint]
    transforms: [{translation: [0, 0, 0], rotation: [0, 0, 0, 1]}]
world:
  collision_objects:
    - id: can
      primitives:
        - type: cylinder
          dimensions: [0.14, 0.03]
      primitive_poses:
        - position: [0.6, 0.5, 0.07]
          orientation: [0, 0, 0, 1]
    - id: shelf
      pose:
        position: [0.5, -0.5, 0.2]
        orientation: [0, 0, 0.7071067811865476, 0.7071067811865476]
      primitive_poses:
        - {position: [0.1, 0, 0], orientation: [0, 0, 0, 1]}
        - {position: [0, 0, 0.3], orientation: [0, 0, 0, 1]}
      primitives:
        - {dimensions: [0.3, 0.04, 0.5], type: box}
        - {type: sphere, dimensions: [0.05]}
"""
MOVEIT_REQUEST = """\
group_name: panda_arm
goal_constraints:
  - joint_constraints:
      - {joint_name: panda_joint7, position: 0.8}
      - {position: 0.5, joint_name: panda_joint1}
      - {joint_name: panda_joint2, position: -0.3}
      - {joint_name: panda_joint4, position: -2.0}
      - {joint_name: panda_joint3, position: 0.0}
      - {joint_name: panda_joint5, position: 0}
      - {joint_name: panda_joint6, position: 1.7}
start_state:
  joint_state:
    name: [panda_finger_joint1, panda_joint1, panda_joint2, panda_joint3, panda_joint4,
           panda_joint5, panda_joint6, panda_joint7, panda_finger_joint2]
    position: [0.065, 0, -0.785, 0, -2.356, 0, 1.571, 0.785, 0.065]
"""
# The scene with a box in the hand, and with entries for the can and the box among the links.
MOVEIT_TOUCHING = (
    MOVEIT_SCENE.replace(
        "  joint_state: {name",
        """\
  attached_collision_objects:
    - link_name: panda_hand
      touch_links: [panda_link6]
      object:
        header: {frame_id: panda_hand}
        id: tool
        pose: {position: [0, 0, 0.1], orientation: [0, 0, 0, 1]}
        primitives: [{type: box, dimensions: [0.04, 0.05, 0.1]}]
        primitive_poses: [{position: [0, 0, 0.05], orientation: [0, 0, 0, 1]}]
        operation: 0
  joint_state: {name""",
    )
    + """\
allowed_collision_matrix:
  entry_names: [can, panda_hand, panda_link5, tool]
  entry_values:
    - [false, true, false, true]
    - {enabled: [true, false, true, false]}
    - [false, true, false, true]
    - [true, false, true, false]
  default_entry_names: [shelf]
  default_entry_values: [false]
"""
)
# The hand's pose at GOALS[0], as the test of it computes with PyBullet.
ROBOMETRICS = """\
shelf:
- goal_ik:
  - [0.5, -0.3, 0.0, -2.0, 0.0, 1.7, 0.8]
  - [0.6, -0.3, 0.0, -2.0, 0.0, 1.7, 0.8]
  goal_pose:
    frame: panda_hand
    position_xyz: [0.4, 0.2, 0.5]
    quaternion_wxyz: [0.0, 0.6, 0.8, 0.0]
  obstacles:
    cuboid:
      board:
        dims: [0.3, 0.04, 0.5]
        pose: [0.5, -0.5, 0.2, 0.8, 0.0, 0.0, 0.6]
    cylinder:
      can:
        height: 0.14
        radius: 0.03
        pose: [0.6, 0.5, 0.07, 1, 0, 0, 0]
  start: [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
  world_frame: panda_link0
"""
VAMP = {
    "robot": "panda",
    "problems": {
        "box": [
            {
                "index": 7,
                "valid": True,
                "start": START,
                "goals": GOALS,
                "sphere": [{"name": "ball", "position": [0, 0.6, 0.5], "radius": 0.1}],
                "box": [
                    {
                        "name": "board",
                        "position": [0.5, -0.5, 0.2],
                        "orientation_euler_xyz": [0.1, 0.2, 0.3],
                        "half_extents": [0.15, 0.02, 0.25],
                    }
                ],
                "cylinder": [
                    {
                        "name": "can",
                        "position": [0.6, 0.5, 0.07],
                        "orientation_quat_xyzw": [0, 0, 0, 1],
                        "radius": 0.03,
                        "length": 0.14,
                    }
                ],
            }
        ]
    },
}
CUROBO = """\
cuboid:
  table:
    dims: [2.0, 1.5, 0.2]
    pose: [0.4, 0.0, -0.1, 1, 0, 0, 0]
sphere:
  ball: {radius: 0.1, position: [0, 0.6, 0.5]}
mesh: {}
"""
SCENE_TEXT = """\
(noname)+
* shelf
0.5 -0.5 0.2
0 0 0.7071067811865476 0.7071067811865476
2
box
0.3 0.04 0.5
0.1 0 0
0 0 0 1
0 0 0 0
cylinder
0.03 0.14
0 0 0.3
0 0 0 1
0 0 0 0
1
edge
0 0 0
0 0 0 1
.
"""
OLD_SCENE_TEXT = """\
(noname)
* shelf
1
box
0.3 0.04 0.5
0.5 -0.4 0.2
0 0 0.7071067811865476 0.7071067811865476
0 0 0 0
* ball
1
sphere
0.05
0.5 -0.5 0.5
0 0 0 1
0.2 0.3 0.4 1
.
"""
# A wedge as a mesh: its corners, and its triangles.
CORNERS = [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.2]]
TRIANGLES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
VERTICES = "[" + ", ".join(f"{{x: {x}, y: {y}, z: {z}}}" for x, y, z in CORNERS) + "]"
INDICES = "[" + ", ".join(f"{{vertex_indices: {triangle}}}" for triangle in TRIANGLES) + "]"
MOVEIT_MESH = f"""\
collision_objects:
- id: wedge
  meshes:
  - vertices: {VERTICES}
    triangles: {INDICES}
  mesh_poses: [{{position: [0.5, 0.1, 0.3], orientation: [0, 0, 0.6, 0.8]}}]
"""
CUROBO_MESH = "mesh: {w: {file_path: part.stl, pose: [0.5, 0.1, 0.3, 0.8, 0, 0, 0.6]}}\n"
CUROBO_TRIANGLES = (
    f"mesh: {{w: {{vertices: {CORNERS}, faces: {TRIANGLES}, scale: [1, 1, 1], "
    "pose: [0.5, 0.1, 0.3, 0.8, 0, 0, 0.6]}}\n"
)
SCENE_MESH = "(noname)+\n* w\n0.5 0.1 0.3\n0 0 0.6 0.8\n1\nmesh\n4 4\n"
SCENE_MESH += "".join(f"{a} {b} {c}\n" for a, b, c in [*CORNERS, *TRIANGLES])
SCENE_MESH += "0 0 0\n0 0 0 1\n0 0 0 0\n0\n.\n"


def write_folder(folder, digits="0001", scene=MOVEIT_SCENE, request=MOVEIT_REQUEST):
    """Write a problem of MotionBenchMaker's form; returns the folder."""
    folder.mkdir(exist_ok=True)
    (folder / f"scene{digits}.yaml").write_text(scene)
    (folder / f"request{digits}.yaml").write_text(request)
    return folder


def write_file(path, content):
    """Write text, or JSON of anything else; returns the path."""
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path
