"""The simulated world: the physics engine, the arm, the scene's bodies, contacts, feasibility.

`envs.arm_env.RoboArmEnv` is a goal-conditioned MDP on such a world; sensors observe another,
`envs.perception.sensors.SensorWorld`.
"""

import math
import os
import subprocess
import sys
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from roboarm_nmp.envs.robots.body import Body
from roboarm_nmp.envs.robots.control import SUBSTEPS, TIME_STEP
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import (
    FRICTION,
    Box,
    ConvexHull,
    Cylinder,
    Scene,
    floor_box,
    hull_faces,
    pose_at,
)
from roboarm_nmp.utils.bullet import pybullet as p

# A configuration is "held" if the controller keeps the arm there without contact for this many
# environment steps, and the arm drifts no further than this (normalised).
HOLD_STEPS = 5
HOLD_DRIFT = 1e-3
# Colour and friction.
FLOOR_STYLE = (0.55, 0.55, 0.55, 1), FRICTION
TABLE_STYLE = (0.76, 0.70, 0.60, 1), FRICTION
OBSTACLE_COLOUR = (0.36, 0.50, 0.65, 1)
TOUCHABLE_COLOUR = (0.59, 0.47, 0.67, 1)
MAX_SAMPLING_TRIES = 10_000
MAX_EDGE = 4096  # pixels of an image: 20,000 by 20,000 would need all of a machine's memory
# PyBullet keeps about 4 kB of each body that is removed, so the world is made anew after this many
# bodies. That takes as long as 100 changes of scene.
MAX_BODIES_MADE = 5_000
FAR_AWAY = (0.0, 0.0, 50.0)  # m: a place without contacts
NO_TURN = (0.0, 0.0, 0.0, 1.0)
# Where obstacles are that have disappeared, or not appeared yet (m).
ABSENT = (0.0, 0.0, -10_000.0), NO_TURN
# A program that connects to the X server, and how long (s) it may take.
OPEN_DISPLAY = """
import ctypes, sys
open_display = ctypes.CDLL("libX11.so.6").XOpenDisplay
open_display.restype = ctypes.c_void_p
sys.exit(not open_display(None))
"""
DISPLAY_SECONDS = 10


def why_no_window() -> str | None:
    """The reason, in words, why PyBullet's window cannot be opened here; None if it can.

    Call this before opening a window: without a display PyBullet ends the process, and it waits
    forever for a display that does not answer.
    """
    if not sys.platform.startswith("linux"):
        return None
    display = os.environ.get("DISPLAY")
    if not display:
        return "DISPLAY is not set"
    command = [sys.executable, "-c", OPEN_DISPLAY]
    try:
        answer = subprocess.run(command, capture_output=True, timeout=DISPLAY_SECONDS)
    except subprocess.TimeoutExpired:
        return f"DISPLAY is {display}, which does not answer"
    return None if answer.returncode == 0 else f"DISPLAY is {display}, which cannot be opened"


def image_array(pixels: Any, width: int, height: int) -> np.ndarray:
    """The colours that `getCameraImage` returns, as uint8 (height, width, 3).

    A PyBullet built without NumPy returns a tuple of integers, which `bytes` converts six times as
    fast as NumPy does.
    """
    return np.frombuffer(bytes(pixels), np.uint8).reshape(height, width, 4)[..., :3].copy()


class World:
    """A scene with the arm in it, in a physics engine of its own.

    Obstacles with a motion follow their path in every physics step, whatever is in the way, and
    push the arm where they touch it. `place` sets the time.

    Copies (`copy.deepcopy`, pickle) are independent worlds in the same state, with the same future,
    bit for bit, contacts included. To make one, all commands since the arm was placed are repeated,
    and a world stores 0.3 kB per environment step for that. A copy has no window, because PyBullet
    allows only one per process.

    Args:
        scene: a `Scene`; by default an empty one.
        window: open PyBullet's window.
        drawn: give bodies visual shapes. They cost 50 MB of memory, and PyBullet takes up to six
            times as long to add a cylinder or a sphere. Without them, obstacles are specks in
            images until you call `draw`.

    Attributes:
        client: PyBullet's client id of the engine; None after `close`.
        robot: the scene's `Robot`.
        arm: the arm's `envs.robots.body.Body`.
        body: PyBullet's id of the arm's body.
        scene: the `Scene`, with its motions; `set_scene` changes it.
        has_window: whether PyBullet's window is open.

    Raises:
        TypeError: `scene` is not a `Scene`.
        RuntimeError: any method but `close` is called after `close`.
    """

    robot: Robot
    body: int
    scene: Scene

    def __init__(
        self, scene: Scene | None = None, window: bool = False, drawn: bool = True
    ) -> None:
        self.client: int | None = None
        self._drawn = drawn
        scene = Scene() if scene is None else scene
        _check_scene(scene)
        self.client = p.connect(p.GUI if window else p.DIRECT)
        self.has_window = window
        self._target = ()  # of the position controllers, n angles (rad); empty before a command
        self._make(scene)

    def check_open(self) -> None:
        """Raise RuntimeError if the world is closed."""
        if self.client is None:
            raise RuntimeError("this environment, or its world, is closed")

    def _make(self, scene):
        """Make the physics engine's settings, the robot, and a scene."""
        p.resetSimulation(physicsClientId=self.client)
        # Without deterministicOverlappingPairs the same episode differs from run to run.
        p.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP, deterministicOverlappingPairs=1, physicsClientId=self.client
        )
        p.setGravity(0, 0, -9.81, physicsClientId=self.client)
        self.robot = scene.robot
        self.arm = self._load_arm()
        self.body = self.arm.id
        # PyBullet places a body by its centre of mass.
        self._in_place = p.getBasePositionAndOrientation(self.body, physicsClientId=self.client)
        self._parts = []
        self._bodies = []
        self._bodies_made = 0
        self._goal_marker = None
        self._goal = None
        self._speck = p.createVisualShape(
            p.GEOM_BOX, halfExtents=[0.001] * 3, physicsClientId=self.client
        )
        self._change_scene(scene)

    def draw(self) -> None:
        """Give all bodies visual shapes, now and from now on."""
        self.check_open()
        if not self._drawn:
            self._drawn = True
            self._make_again(self._snapshot())

    def _load_arm(self) -> Body:
        assert self.client is not None  # it was just opened
        return Body(self.robot, self.client, self._drawn)

    # --- Copies

    def __getstate__(self):
        return vars(self) | {"snapshot": None if self.client is None else self._snapshot()}

    def __setstate__(self, state):
        vars(self).update(state, client=None, has_window=False)
        snapshot = vars(self).pop("snapshot")
        if snapshot is not None:
            self.client = p.connect(p.DIRECT)
            self._make_again(snapshot)

    def _make_again(self, snapshot):
        goal = self._goal
        self._make(self.scene)
        if goal is not None:
            self.mark_goal(*goal)
        self._restore(snapshot)

    def _snapshot(self):
        """Where the arm was placed, its commands since then, and its present state."""
        joints = p.getJointStates(self.body, self.arm.movable, physicsClientId=self.client)
        joint_states = [joint[:2] for joint in joints]  # angles and velocities
        return self._start, self._events, self._target, self._substep, joint_states

    def _restore(self, snapshot):
        """Repeat a snapshot's commands, which restores contacts, too, bit for bit."""
        start, events, target, substep, joint_states = snapshot
        if start is not None:
            self.place(*start)
            for event in events:
                if event is None:
                    self._detect_collisions()
                else:
                    if event:
                        self.command(event)
                    self.simulate()
        if target:
            self.command(target)
        if self._substep != substep:
            self._move_obstacles(substep)
        if self._snapshot()[-1] != joint_states:  # it was moved by other means
            p.resetJointStatesMultiDof(
                self.body,
                self.arm.movable,
                [[angle] for angle, _ in joint_states],
                [[velocity] for _, velocity in joint_states],
                physicsClientId=self.client,
            )

    def _record(self, event):
        """Remember a simulated step by its target, or, by None, a collision detection."""
        if self._start is not None:
            self._events.append(event)

    def set_scene(self, scene: Scene) -> bool:
        """Put the arm into another `Scene`. Returns False, and does nothing, for an equal one."""
        self.check_open()
        _check_scene(scene)
        if scene is self.scene or scene == self.scene:
            return False
        if self._bodies_made > MAX_BODIES_MADE or scene.robot != self.robot:
            self._make(scene)
        else:
            self._change_scene(scene)
        return True

    def _change_scene(self, scene):
        self._start = None
        self._events = []
        self.scene = scene
        before = self._parts
        self._parts = []
        if scene.floor is not None:
            self._parts.append((floor_box(scene.floor), *FLOOR_STYLE))
        if scene.table is not None:
            self._parts.append((scene.table, *TABLE_STYLE))
        for obstacle in scene.obstacles:
            colour = TOUCHABLE_COLOUR if obstacle.may_touch else OBSTACLE_COLOUR
            self._parts.append((obstacle, colour, scene.friction))
        # The first bodies stay as far as they are the same: floor and table, mostly.
        same = 0
        while same < min(len(before), len(self._parts)) and before[same] == self._parts[same]:
            same += 1
        for (obstacle, *_), body in zip(before[same:], self._bodies[same:], strict=True):
            self._let_touch(obstacle, body, may_collide=1)  # PyBullet will use its number again
            p.removeBody(body, physicsClientId=self.client)
        self._bodies = self._bodies[:same]
        for part in self._parts[same:]:
            self._add(*part)
        pairs = zip(self._bodies, self._parts, strict=True)
        self._movers = {body: part[0] for body, part in pairs if part[0].motion is not None}
        self._move_obstacles(0)

    # --- Moving obstacles

    @property
    def time(self) -> float:
        """Simulated seconds since the arm was placed, plus the time that `place` was given."""
        return self._substep * TIME_STEP

    @property
    def current_scene(self) -> Scene:
        """The static `Scene` at this time."""
        if self._current_scene is None:
            self._current_scene = self.scene.at(self.time)
        return self._current_scene

    def set_time(self, time: float) -> None:
        """Put moving obstacles where they are at a time (s), for images. The arm stays."""
        self.check_open()
        self._move_obstacles(round(time / TIME_STEP))

    def _move_obstacles(self, substep):
        """Put moving obstacles where they are after so many physics steps, at rest."""
        self._substep = substep
        self._current_scene: Scene | None = None
        self._poses = {body: pose_at(o, self.time) for body, o in self._movers.items()}
        for body, pose in self._poses.items():
            p.resetBasePositionAndOrientation(body, *(pose or ABSENT), physicsClientId=self.client)

    def _step_with_movers(self):
        """One physics step. Obstacles have their velocity in it, and are then at their new pose."""
        before = self._poses
        self._substep += 1
        self._poses = {body: pose_at(o, self.time) for body, o in self._movers.items()}
        for body, pose in self._poses.items():
            if pose is not None and before[body] is not None:
                velocities = _velocities(before[body], pose)
                p.resetBaseVelocity(body, *velocities, physicsClientId=self.client)
        p.stepSimulation(physicsClientId=self.client)
        self._current_scene = None
        for body, pose in self._poses.items():  # their velocity is zero again
            if pose is not None or before[body] is not None:
                pose = pose or ABSENT
                p.resetBasePositionAndOrientation(body, *pose, physicsClientId=self.client)

    def _add(self, obstacle, colour, friction):
        orientation = NO_TURN
        if isinstance(obstacle, Box):
            kind, collision = p.GEOM_BOX, {"halfExtents": [edge / 2 for edge in obstacle.size]}
            visual, orientation = collision, obstacle.orientation
        elif isinstance(obstacle, Cylinder):
            kind, orientation = p.GEOM_CYLINDER, obstacle.orientation
            collision = {"radius": obstacle.radius, "height": obstacle.length}
            visual = {"radius": obstacle.radius, "length": obstacle.length}
        elif isinstance(obstacle, ConvexHull):
            kind, orientation = p.GEOM_MESH, obstacle.orientation
            collision = {"vertices": obstacle.vertices}
            # Each face has its own corners: PyBullet would shade common ones as a round surface.
            corners = np.array(obstacle.vertices)[hull_faces(obstacle.vertices)].reshape(-1, 3)
            visual = {"vertices": corners.tolist(), "indices": list(range(len(corners)))}
        else:
            kind, collision = p.GEOM_SPHERE, {"radius": obstacle.radius}
            visual = collision
        client = self.client
        shape = self._speck
        if self._drawn:
            shape = p.createVisualShape(kind, **visual, rgbaColor=colour, physicsClientId=client)
        body = p.createMultiBody(
            0.0,  # kg: nothing moves it
            p.createCollisionShape(kind, **collision, physicsClientId=client),
            shape,
            basePosition=obstacle.position,
            baseOrientation=orientation,
            physicsClientId=client,
        )
        if friction != FRICTION:
            p.changeDynamics(body, -1, lateralFriction=friction, physicsClientId=client)
        for link in self.robot.links:  # the arm's base is bolted to the table
            if link.frame < 0 and (link.index >= 0 or obstacle is self.scene.table):
                p.setCollisionFilterPair(self.body, body, link.index, -1, 0, physicsClientId=client)
        self._let_touch(obstacle, body)
        self._bodies.append(body)
        self._bodies_made += 1

    def _let_touch(self, obstacle, body, may_collide=0):
        """Let the links that may touch an obstacle pass through its body, or not any more."""
        for link in self.robot.links_called(obstacle.may_touch) & self.robot.link_rows.keys():
            p.setCollisionFilterPair(
                self.body, body, link, -1, may_collide, physicsClientId=self.client
            )

    # --- Feasibility (paper, appendix: "not in collision, and [...] the simulator can hold")

    def in_collision(
        self, configuration: np.ndarray | Sequence[float], time: float = 0.0, moving: bool = True
    ) -> bool:
        """Whether the arm at joint angles (n, rad, inside the limits) overlaps the scene or itself.

        Moves the arm: call it between episodes, or continue with a reset.

        Args:
            time: s, of moving obstacles.
            moving: whether obstacles with a motion count.
        """
        self.place(configuration, time)
        self._detect_collisions()
        return bool(self._overlapping(moving))

    def _overlapping(self, moving):
        """The bodies that the arm overlaps."""
        contacts = p.getContactPoints(bodyA=self.body, physicsClientId=self.client)
        bodies = {contact[2] for contact in contacts if contact[8] < 0.0}
        return bodies if moving else bodies - self._movers.keys()

    def _detect_collisions(self):
        p.performCollisionDetection(physicsClientId=self.client)
        self._record(None)

    def is_feasible(self, configuration: np.ndarray, hold_steps: int = HOLD_STEPS) -> bool:
        """Whether joint angles (n, rad) are inside the limits, collision free and held.

        The arm holds them if the position controller keeps it there for `hold_steps` environment
        steps, in which moving obstacles begin to move. Moves the arm: call it between episodes,
        or continue with a reset.
        """
        if np.any(configuration < self.robot.lower) or np.any(configuration > self.robot.upper):
            return False
        if self.in_collision(configuration):
            return False
        self.command(list(configuration))
        for _ in range(hold_steps):
            if self.simulate():
                return False
        drift = self.read_arm()[0] - self.robot.normalise(configuration)
        return math.sqrt(drift @ drift) <= HOLD_DRIFT

    def sample_feasible(self, rng: np.random.Generator) -> np.ndarray:
        """Draw a feasible configuration, uniformly inside the limits: float32 (n,), rad.

        `rng` is a NumPy Generator.
        """
        for _ in range(MAX_SAMPLING_TRIES):
            configuration = rng.uniform(self.robot.lower, self.robot.upper).astype(np.float32)
            if self.is_feasible(configuration):
                return configuration
        raise RuntimeError(
            f"no feasible configuration in {MAX_SAMPLING_TRIES} samples: leave the arm more room "
            f"(`roboarm show` draws the scene)"
        )

    def check_free(
        self, ignoring_motions: Collection[str] = (), **configurations: np.ndarray
    ) -> None:
        """Raise ValueError, naming the contacts, if one of the configurations is in collision.

        For example `check_free(start=start)`, joint angles (n, rad). After an error the episode
        goes on as if nothing had been checked; otherwise the arm has moved. Obstacles with a motion
        count where they are at time 0, except for the names in `ignoring_motions`.
        """
        self.check_open()
        before = self._snapshot()
        for name, configuration in configurations.items():
            moving = name not in ignoring_motions
            if self.in_collision(configuration, moving=moving):
                contacts = self.contact_names(moving)
                self._restore(before)
                raise ValueError(
                    f"{name} is in collision: {contacts}; choose another one, or give an obstacle "
                    f"that it may touch `may_touch`"
                )

    def contact_names(self, moving: bool = True) -> str:
        """Name the pairs in contact. Call it after `in_collision`, with the same `moving`."""
        kinds = []
        if self.scene.floor is not None:
            kinds.append("the floor")
        if self.scene.table is not None:
            kinds.append("the table")
        kinds += [f"obstacle {i}" for i in range(len(self.scene.obstacles))]
        names = {
            body: f"the arm with {kind}" for body, kind in zip(self._bodies, kinds, strict=True)
        }
        names[self.body] = "the arm with itself"
        return ", ".join(sorted(names[body] for body in self._overlapping(moving)))

    # --- The arm

    def place(self, configuration: np.ndarray | Sequence[float], time: float = 0.0) -> None:
        """Teleport the arm to joint angles (n, rad), at rest, leaving no old contact points.

        Obstacles move from `time` (s, a multiple of `TIME_STEP`) on.

        Bullet keeps the contact points of two bodies while these move little against each other.
        So a configuration could inherit points from an earlier one that brought the same two links
        nearly as close. Far away, in a configuration without contacts, all of them are dropped.
        """
        self.check_open()
        client = self.client
        body = self.body
        robot = self.robot
        p.resetBasePositionAndOrientation(body, FAR_AWAY, NO_TURN, physicsClientId=client)
        self.arm.set_configuration(robot.contact_free)
        self._move_obstacles(round(time / TIME_STEP))
        p.performCollisionDetection(physicsClientId=client)
        p.resetBasePositionAndOrientation(body, *self._in_place, physicsClientId=client)
        self.arm.set_configuration(configuration)
        self._start = tuple(np.asarray(configuration)), self.time
        self._events = []

    def command(self, configuration: Sequence[float]) -> None:
        """Set the targets of the arm's position controllers: joint angles (n, rad)."""
        self.check_open()
        self._target = tuple(configuration)
        self.arm.command(configuration)

    def simulate(self) -> bool:
        """Run the physics of one environment step. Returns whether the arm was in contact."""
        self.check_open()
        self._record(self._target)
        client = self.client
        body = self.body
        contact = False
        for _ in range(SUBSTEPS):
            if self._movers:
                self._step_with_movers()
            else:
                p.stepSimulation(physicsClientId=client)
                self._substep += 1
            if not contact:
                # A contact also counts at distance zero, when the surfaces push on each other.
                for point in p.getContactPoints(bodyA=body, physicsClientId=client):
                    if point[8] < 0.0 or point[9] > 0.0:
                        contact = True
                        break
        return contact

    def read_arm(
        self, velocities: bool = False, pose: bool = False
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """The arm's state.

        Returns:
            Normalised configuration (n,), joint velocities (n,) in normalised units per second
            (None without `velocities`), and end-effector position (3,), m, or, with `pose`, its
            pose (7,), as of `Robot.end_effector_pose`; all float64.
        """
        self.check_open()
        robot = self.robot
        joints = p.getJointStates(self.body, robot.joint_indices, physicsClientId=self.client)
        state = robot.normalise([joint[0] for joint in joints])
        velocity = None
        if velocities:
            speeds = np.array([joint[1] for joint in joints])
            velocity = 2.0 * speeds / (robot.upper - robot.lower)
        if pose:
            return state, velocity, self.arm.read_end_effector_pose()
        return state, velocity, self.arm.read_end_effector()

    def mark_goal(self, position: np.ndarray, radius: float) -> None:
        """Show a green ball, visual only, at a position (3,), m. There is only one."""
        self.check_open()
        if self._goal_marker is None:
            ball = p.createVisualShape(
                p.GEOM_SPHERE,
                radius=radius,
                rgbaColor=(0.1, 0.75, 0.2, 1),
                physicsClientId=self.client,
            )
            self._goal_marker = p.createMultiBody(
                baseVisualShapeIndex=ball, physicsClientId=self.client
            )
        p.resetBasePositionAndOrientation(
            self._goal_marker, position, NO_TURN, physicsClientId=self.client
        )
        self._goal = position, radius

    def close(self) -> None:
        """Disconnect from PyBullet. Closing twice is allowed."""
        if self.client is not None:
            p.disconnect(physicsClientId=self.client)
            self.client = None

    def __del__(self):
        # A world that was never closed must not keep one of PyBullet's connections.
        if getattr(self, "client", None) is not None:
            try:
                if p.isConnected(self.client):
                    p.disconnect(physicsClientId=self.client)
            except (AttributeError, TypeError):  # at the end of the process PyBullet is gone
                pass


def _velocities(before, after):
    """The velocities (3,), m/s and rad/s, from one pose to the next, one physics step later."""
    (position, (a, b, c, d)), (there, (x, y, z, w)) = before, after
    linear = [(new - old) / TIME_STEP for old, new in zip(position, there, strict=True)]
    # The vector part of after * inverse(before), half of the angle, which is small.
    turn = 2.0 / TIME_STEP * (1.0 if a * x + b * y + c * z + d * w > 0.0 else -1.0)
    angular = (
        turn * (d * x - w * a + b * z - c * y),
        turn * (d * y - w * b + c * x - a * z),
        turn * (d * z - w * c + a * y - b * x),
    )
    return linear, angular


def _check_scene(scene):
    if not isinstance(scene, Scene):
        raise TypeError(
            f"a scene must be a roboarm_nmp.envs.scenes.primitives.Scene, got {scene!r}"
        )
