"""Drawing a `Simulation` with viser: arms side by side, scene, goal, points, distances, contacts.

Every arm has its own copy of the scene, `SPACING` beside the last one. The arm's links are nested
frames, of which only the joints move.
"""

import textwrap
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from roboarm_nmp.envs.perception.geometry_source import GROUND_TRUTH, find_geometry_source
from roboarm_nmp.envs.perception.point_clouds import POINT_CLOUD, observed_points
from roboarm_nmp.envs.perception.sensors import SceneObservation
from roboarm_nmp.envs.point_images import LEFT_OUT_COLOUR, OBSERVED_COLOUR
from roboarm_nmp.envs.robots.panda import scale_of
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import (
    Box,
    ConvexHull,
    Cylinder,
    ObservedScene,
    Sphere,
    hull_faces,
    obstacle_at,
)
from roboarm_nmp.viewer.meshes import COARSE_MESH_CELL, MESH_CELL, Colour, arm_joints, link_meshes
from roboarm_nmp.viewer.simulation import Arm, Simulation, clearance

if TYPE_CHECKING:
    import viser

# m, for the Panda; for other arms in proportion to their reach.
SPACING, LABEL_HEIGHT = 2.2, 1.35  # between the bases of two arms; of the arms' names
ORIENTATION_STEPS = 2**14  # quaternions are rounded, so that recordings stay small
POSITION_STEPS = 2**13  # per m, likewise
DECODED_BY = "field"  # the encoder whose decoded points are shown where an arm uses none

# Colours (red, green, blue).
TABLE_COLOUR = (196, 178, 150)
OBSTACLE_COLOUR, SELECTED_COLOUR = (96, 132, 172), (240, 170, 60)
TOUCHABLE_COLOUR = (150, 120, 170)
START_COLOUR, GOAL_COLOUR, CONTACT_COLOUR = (150, 150, 165), (60, 190, 90), (230, 30, 30)
DECODED_COLOUR, SWEPT_COLOUR = (150, 60, 200), (150, 190, 240)
SWEPT_ARMS = 8
POINT_SIZES = {"left_out": 0.004}  # m, of the radius, as viser draws it; 0.012 of others
NAME_WIDTH = 36  # letters in a line of a label
WANTED_COLOUR, FILTERED_COLOUR = (130, 130, 130), (20, 110, 230)
TRACE_COLOUR = (235, 150, 40)
NEAR, FAR = 0.05, 0.3  # m: link distances are red up to the first, and not drawn beyond the second
NO_LINES = (np.zeros((0, 2, 3)), np.zeros((0, 2, 3), np.uint8))
ARROW_LENGTH = 0.25  # m, of the end effector's motion in a step of the longest length


def set_property(handle, name: str, value):
    """Set a property of a handle where it differs: each setting is a message to the page."""
    if not np.array_equal(getattr(handle, name), value):
        setattr(handle, name, value)


def _wxyz(orientation):
    """A quaternion (x, y, z, w) in viser's order."""
    x, y, z, w = orientation
    return (w, x, y, z)


class ArmDrawing:
    """An arm as nested frames.

    Args:
        scene: viser's `SceneApi`.
        robot: the `Robot`.
        name: of its node.
        cell: m, see `MESH_CELL`.
        colour, opacity: of a ghost; None for the arm's own colours.
    """

    def __init__(
        self,
        scene: "viser.SceneApi",
        robot: Robot,
        name: str,
        cell: float = MESH_CELL,
        colour: Colour | None = None,
        opacity: float | None = None,
    ):
        self._root = scene.add_frame(
            name,
            show_axes=False,
            position=np.array(robot.base_position),
            wxyz=_wxyz(robot.base_orientation),
        )
        self._meshes = {}  # link -> list of handles and their own colours
        self._red = frozenset()  # links
        self._joints = []
        nodes = {-1: name}  # of each link
        for joint in arm_joints(robot):
            node = f"{nodes[joint.parent]}/joint{joint.link}"
            scene.add_frame(node, show_axes=False, position=joint.position, wxyz=joint.wxyz)
            if not joint.is_fixed:
                node = f"{node}/moved"
                self._joints.append((joint, scene.add_frame(node, show_axes=False)))
            nodes[joint.link] = node
        for link, meshes in link_meshes(robot, cell * scale_of(robot)).items():
            self._meshes[link] = []
            if colour is not None and link == -1:
                continue  # the bases of ghosts are where the arm's is
            for i, (own_colour, vertices, faces) in enumerate(meshes):
                shown = own_colour if colour is None else colour
                handle = scene.add_mesh_simple(
                    f"{nodes[link]}/mesh{i}",
                    vertices,
                    faces,
                    color=shown,
                    opacity=opacity,
                    cast_shadow=opacity is None,
                    receive_shadow=opacity is None,
                )
                self._meshes[link].append((handle, shown))

    def show(self, visible: bool):
        """Draw it, or hide it."""
        set_property(self._root, "visible", visible)

    def set(self, configuration: np.ndarray):
        """Draw it at joint angles (n,), rad."""
        for joint, handle in self._joints:
            position, wxyz = joint.pose(configuration)
            position = np.round(np.array(position) * POSITION_STEPS) / POSITION_STEPS
            set_property(handle, "position", position)
            wxyz = np.round(np.array(wxyz) * ORIENTATION_STEPS) / ORIENTATION_STEPS
            set_property(handle, "wxyz", wxyz)

    def colour(self, links: frozenset[int]):
        """Draw the links of these indices in red, the others in their own colours."""
        for link in links ^ self._red:
            for handle, own_colour in self._meshes.get(link, ()):
                handle.color = CONTACT_COLOUR if link in links else own_colour
        self._red = frozenset(links)


class _Place:
    """The handles of one arm and of the scene around it."""

    def __init__(self, scene, robot, index, cell):
        scale = scale_of(robot)
        self.name = f"/arm{index}"
        self.offset = np.array([0.0, SPACING * scale * index, 0.0])
        scene.add_frame(self.name, show_axes=False, position=self.offset)
        self.arm = ArmDrawing(scene, robot, f"{self.name}/robot", cell)
        ghost = COARSE_MESH_CELL
        self.start = ArmDrawing(scene, robot, f"{self.name}/start", ghost, START_COLOUR, 0.3)
        self.goal = ArmDrawing(scene, robot, f"{self.name}/goal", ghost, GOAL_COLOUR, 0.4)
        self.ball = scene.add_icosphere(f"{self.name}/ball", radius=0.02, color=GOAL_COLOUR)
        self.axes = scene.add_frame(f"{self.name}/axes", axes_length=0.08, axes_radius=0.003)
        x, y, z = robot.base_position
        self.label = scene.add_label(
            f"{self.name}/label",
            "",
            position=(x, y, z + LABEL_HEIGHT * scale),
            anchor="bottom-center",
        )
        self.scene = None  # what is drawn of it: scene, selected obstacle, time
        self.bodies = []  # of each: the body and its colour; its handle
        self.shapes = {}  # overlays by name
        self.swept = []  # arms along a motion


class Drawing:
    """Draws a `Simulation` in the scene of a viser server.

    Args:
        server: a `viser.ViserServer`.
        simulation: the `Simulation`.
        cell: m, see `MESH_CELL`.

    Attributes:
        show: set of what is drawn besides arm and scene, see `OPTIONS`. `left_out` are points of a
            cloud that are no obstacles, `swept` are transparent arms along a recorded motion.
        selected: index of the obstacle drawn in another colour; None for none.
        on_click: function of an obstacle's index; None: obstacles cannot be clicked.
    """

    OPTIONS = (
        *("start", "goal", "observed", "left_out", "decoded"),
        *("distances", "correction", "trace", "swept"),
    )

    def __init__(
        self, server: "viser.ViserServer", simulation: Simulation, cell: float = MESH_CELL
    ):
        self.simulation = simulation
        self._scene = server.scene
        self._cell = cell
        self.show = {"start", "goal", "correction"}
        if simulation.episodes.left_out is not None:
            self.show |= {"observed", "left_out"}
        self.selected: int | None = None
        self.on_click: Callable[[int], None] | None = None
        self._places: list[_Place] = []
        # An environment map would be a third of a recording.
        self._scene.configure_environment_map(None)
        self._scene.add_light_hemisphere(
            "/sky", sky_color=(255, 255, 255), ground_color=(190, 190, 190), intensity=0.9
        )

    def update(self):
        """Draw the simulation as it is now."""
        simulation = self.simulation
        for index, arm in enumerate(simulation.arms):
            if index == len(self._places):
                self._places.append(_Place(self._scene, simulation.robot, index, self._cell))
                self._add_floor()
            place = self._places[index]
            self._draw_scene(place, simulation.query.scene, arm.time)
            self._draw_arm(place, arm)
            self._draw_overlays(place, arm)

    def _add_floor(self):
        """A floor under all arms."""
        floor = self.simulation.query.scene.floor
        middle = self._places[-1].offset[1] / 2
        self._scene.add_grid(
            "/floor",
            width=8.0,
            height=8.0 + 2 * middle,
            position=(0.0, middle, -0.6 if floor is None else floor),
            cell_color=(225, 225, 225),
            section_color=(200, 200, 200),
            plane_color=(245, 245, 245),
            plane_opacity=1.0,
            shadow_opacity=0.3,
        )

    # --- The scene

    def _draw_scene(self, place, scene, time):
        shown = scene, self.selected, 0.0 if scene.is_static else time
        if place.scene is not None and place.scene[0] is scene and place.scene[1:] == shown[1:]:
            return
        # None for an obstacle that is absent, so that the others keep their numbers.
        bodies = [
            (obstacle_at(body, time), TOUCHABLE_COLOUR if body.may_touch else OBSTACLE_COLOUR)
            for body in scene.obstacles
        ]
        if self.selected is not None and self.selected < len(bodies):
            bodies[self.selected] = bodies[self.selected][0], SELECTED_COLOUR
        bodies.append((scene.table, TABLE_COLOUR))
        for i, (body, colour) in enumerate(bodies[: len(place.bodies)]):
            self._update_body(place, i, body, colour)
        for _, handle in place.bodies[len(bodies) :]:
            if handle is not None:
                handle.remove()
        del place.bodies[len(bodies) :]
        for i in range(len(place.bodies), len(bodies)):
            place.bodies.append(self._add_body(place, i, *bodies[i]))
        place.scene = shown

    def _update_body(self, place, i, body, colour):
        """Move a body, where it has the same shape as before; otherwise make it anew."""
        (before, before_colour), handle = place.bodies[i]
        if (body, colour) == (before, before_colour):
            return
        if before is None or body is None or _shape(before) != _shape(body):
            if handle is not None:
                handle.remove()
            place.bodies[i] = self._add_body(place, i, body, colour)
            return
        if body != before:
            handle.position = body.position
            handle.wxyz = _wxyz(getattr(body, "orientation", (0.0, 0.0, 0.0, 1.0)))
        if colour != before_colour:
            handle.color = colour
        place.bodies[i] = (body, colour), handle

    def _add_body(self, place, i, body, colour):
        if body is None:
            return (body, colour), None
        name = f"{place.name}/body{i}"
        options = {"color": colour, "position": body.position}
        if not isinstance(body, Sphere):
            options["wxyz"] = _wxyz(body.orientation)
        if isinstance(body, Box):
            handle = self._scene.add_box(name, dimensions=body.size, **options)
        elif isinstance(body, Cylinder):
            handle = self._scene.add_cylinder(
                name, radius=body.radius, height=body.length, **options
            )
        elif isinstance(body, ConvexHull):
            vertices = np.array(body.vertices, np.float32)
            faces = hull_faces(body.vertices).astype(np.uint32)
            handle = self._scene.add_mesh_simple(
                name, vertices, faces, flat_shading=True, **options
            )
        else:
            handle = self._scene.add_icosphere(name, radius=body.radius, **options)
        on_click = self.on_click
        if on_click is not None and colour != TABLE_COLOUR:
            handle.on_click(lambda event: on_click(i))
        return (body, colour), handle

    # --- The arm

    def _draw_arm(self, place, arm):
        query, robot, posed = self.simulation.query, self.simulation.robot, self.simulation.pose
        configuration, links = posed, arm.contacts.links
        if configuration is None:
            configuration = robot.denormalise(arm.state)
        else:
            links = clearance(query.scene.at(arm.time), configuration).links
        place.arm.set(configuration)
        place.arm.colour(links)
        place.start.show("start" in self.show)
        place.start.set(query.start)
        place.goal.show("goal" in self.show)
        place.goal.set(query.goal)
        pose = robot.end_effector_pose(query.goal)
        for marker in (place.ball, place.axes):
            marker.visible = "goal" in self.show
            marker.position = pose[:3]
        place.axes.wxyz = _wxyz(pose[3:])
        # Seldom another text: a browser takes long to draw it.
        state = _label(arm) if posed is None else "at the sliders' angles"
        text = f"{textwrap.fill(arm.name, NAME_WIDTH)}\n{state}".rstrip()
        set_property(place.label, "text", text)

    # --- Overlays: redrawn while they are shown

    def _draw_overlays(self, place, arm):
        robot = self.simulation.robot
        observed = _observed if self.simulation.query.scene.is_static else self._observed_now
        self._points(place, "observed", OBSERVED_COLOUR, arm, observed)
        self._points(place, "left_out", LEFT_OUT_COLOUR, arm, self._left_out)
        self._points(place, "decoded", DECODED_COLOUR, arm, _decoded)
        self._draw_swept(place, arm)
        self._lines(place, "distances", 0.004, lambda: _distance_lines(arm, self.simulation))
        self._lines(place, "correction", 0.012, lambda: _arrows(arm, robot), arrows=True)
        self._lines(place, "trace", 0.006, lambda: _trace(arm, robot))
        self._contacts(place, arm)

    def _observed_now(self, scene, arm):
        """Of moving obstacles, with the arm where it is."""
        configuration = self.simulation.robot.denormalise(arm.state)
        return observed_points(SceneObservation.of(scene, configuration))

    def _left_out(self, scene, arm):
        left_out = self.simulation.episodes.left_out
        return np.zeros((0, 3), np.float32) if left_out is None else left_out

    def _draw_swept(self, place, arm):
        """Transparent arms along the recorded motion, which change with the query."""
        states = arm.recording if "swept" in self.show else None
        if states is None:
            for ghost in place.swept:
                ghost.show(False)
            return
        robot = self.simulation.robot
        for i in range(SWEPT_ARMS - len(place.swept)):
            node = f"{place.name}/swept{i}"
            ghost = ArmDrawing(self._scene, robot, node, COARSE_MESH_CELL, SWEPT_COLOUR, 0.2)
            place.swept.append(ghost)
        numbers = np.linspace(0, len(states) - 1, SWEPT_ARMS, dtype=int)
        for ghost, state in zip(place.swept, states[numbers], strict=True):
            ghost.show(True)
            ghost.set(robot.denormalise(state))

    def _points(self, place, name, colour, arm, find):
        scene = self.simulation.query.scene.at(arm.time)
        drawn, handle = place.shapes.get(name, (None, None))
        if name not in self.show:
            if handle is not None:
                handle.visible = False
            return
        if drawn is scene:
            handle.visible = True
            return
        points, size = find(scene, arm), POINT_SIZES.get(name, 0.012)
        if name == "observed" and isinstance(scene, ObservedScene):
            size = max(scene.point_radius, POINT_SIZES["left_out"])
        handle = self._scene.add_point_cloud(
            f"{place.name}/{name}",
            points,
            colour,
            point_size=size,
            point_shape="circle",
            point_shading="gradient",
        )
        place.shapes[name] = scene, handle

    def _lines(self, place, name, thickness, find, arrows=False):
        handle = place.shapes.get(name)
        points, colours = find() if name in self.show else NO_LINES
        if not len(points):
            if handle is not None:
                handle.remove()
                del place.shapes[name]
            return
        node = f"{place.name}/{name}"
        points = np.round(points, 4).astype(np.float32)
        if arrows:
            place.shapes[name] = self._scene.add_arrows(
                node, points, colours, shaft_radius=0.008, head_radius=0.02, head_length=0.04
            )
        elif handle is None or len(handle.points) != len(points):
            place.shapes[name] = self._scene.add_line_segments(
                node, points, colours, thickness=thickness
            )
        else:
            handle.points, handle.colors = points, colours

    def _contacts(self, place, arm):
        points = arm.contacts.points.astype(np.float32)
        if self.simulation.pose is not None:
            points = points[:0]
        handle = place.shapes.get("contacts")
        if handle is None and len(points):
            place.shapes["contacts"] = self._scene.add_point_cloud(
                f"{place.name}/contacts",
                points,
                CONTACT_COLOUR,
                point_size=0.03,
                point_shape="circle",
                precision="float32",
            )
        elif handle is not None:
            handle.visible = len(points) > 0
            if len(points):
                handle.points = points


def outcome(arm: Arm) -> str:
    """The state of an arm's episode in a few words."""
    if arm.problem is not None and arm.ended:
        return arm.problem
    contact = f"{arm.contact_steps} steps in contact" if arm.contact_steps else "no contact"
    if arm.success:
        return f"goal reached in {arm.steps} steps, {contact}"
    if arm.ended:
        return f"goal not reached in {arm.steps} steps, {contact}"
    return f"step {arm.steps}, {'CONTACT' if arm.in_contact else contact}"


def _label(arm):
    if arm.problem is not None and arm.ended:
        return textwrap.fill(arm.problem, NAME_WIDTH)
    contact = "with contact" if arm.contact_steps else "no contact"
    if arm.ended:
        return f"goal {'' if arm.success else 'not '}reached, {contact}"
    return contact if arm.contact_steps else ""


def _shape(body):
    """What makes two bodies equal except for their pose."""
    properties = dict(vars(body))
    properties.pop("position")
    properties.pop("orientation", None)
    return type(body), properties


def _observed(scene, arm):
    return observed_points(scene)


def _decoded(scene, arm):
    from roboarm_nmp.envs.perception.encoders import encoder_with_decoder  # PyTorch takes seconds

    encoder = arm.geometry_source
    if encoder in (None, GROUND_TRUTH, POINT_CLOUD):
        encoder = DECODED_BY
    return encoder_with_decoder(encoder).decoded_points(scene)


def _distance_lines(arm, simulation):
    """Lines (n, 2, 3), m, from each link to the nearest geometry, and their colours (n, 2, 3)."""
    scene = simulation.query.scene.at(arm.time)
    state = arm.state if simulation.pose is None else scene.robot.normalise(simulation.pose)
    checker = find_geometry_source(arm.geometry_source or GROUND_TRUTH)(scene)
    signed = checker.signed_distances(np.clip(state, -1.0, 1.0), False, within=FAR)
    near = np.isfinite(signed.distance)
    distance, witness = signed.distance[near], signed.witness[near]
    points = np.stack([witness, witness - distance[:, None] * signed.normal[near]], axis=1)
    share = np.clip((distance - NEAR) / (FAR - NEAR), 0.0, 1.0)[:, None]
    colours = (1 - share) * CONTACT_COLOUR + share * np.array(GOAL_COLOUR)
    return points, np.repeat(colours[:, None], 2, axis=1).astype(np.uint8)


def _arrows(arm, robot):
    """The end effector's motion as the policy wants it, and as the safety filter corrects it."""
    if arm.correction is None or arm.correction < 1e-3 or arm.ended or len(arm.trace) < 2:
        return NO_LINES
    before = arm.trace[-2]
    states = np.clip(np.stack([before, before + arm.wanted, before + arm.action]), -1.0, 1.0)
    start, *ends = robot.forward_kinematics(robot.denormalise(states))
    scale = ARROW_LENGTH / 0.03
    points = np.array([[start, start + scale * (end - start)] for end in ends])
    return points, np.array([WANTED_COLOUR, FILTERED_COLOUR], np.uint8)


def _trace(arm, robot):
    """The path of the end effector so far."""
    if len(arm.trace) < 2:
        return NO_LINES
    positions = robot.forward_kinematics(robot.denormalise(np.array(arm.trace)))
    return np.stack([positions[:-1], positions[1:]], axis=1), np.array(TRACE_COLOUR, np.uint8)
