"""What the viewer shows, without the drawing: arms on one query, step by step, and edits of it.

    simulation = Simulation(task_episodes("wall"), "test", 0)
    simulation.add(PolicyArm("wall", "go-to-goal"))
    while not simulation.ended:
        simulation.step()
    simulation.arms[0].success

Without edits, an episode is that of `evaluation.rollout.rollout`, bit for bit. After an edit of
the goal or of an obstacle, every arm goes on from where it is in a `KinematicWorld`, which has no
forces; `restart` runs the edited query in the physics again.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.files import save_scene
from roboarm_nmp.envs.scenes.primitives import ObservedScene, Scene
from roboarm_nmp.envs.world import World
from roboarm_nmp.evaluation.rollout import Episode, Trajectory
from roboarm_nmp.policies.baselines import CHECKING, PLANNERS
from roboarm_nmp.policies.registry import find_policy, make_policy, own_safety_filter
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.viewer.episodes import Episodes

if TYPE_CHECKING:  # it imports Numba, which takes a while
    from roboarm_nmp.policies.safety_filter import SafetyFilter

GROUND_TRUTH, POINT_CLOUD = "ground_truth", "point_cloud"
TIME_LIMIT = 2.0  # s, that `planner` may search: the browser waits
# Of the inverse kinematics.
IK_STEPS = 200
IK_TOLERANCE = 1e-4  # m
IK_DAMPING = 0.05
IK_MAX_STEP = 0.2  # rad
IK_DIFFERENCE = 1e-5  # rad, of the Jacobian


# --- Arms


class KinematicWorld(World):
    """A world without forces: the arm jumps to every commanded configuration, also in contact."""

    def simulate(self) -> bool:
        """Put the arm at its target. Returns whether it is in contact there."""
        return self.in_collision(self._target, self.time + STEP_SECONDS)

    def check_free(self, ignoring_motions=(), **configurations):
        """Allows contacts: obstacles may be moved into the arm."""


class Contacts(NamedTuple):
    """Contacts of the arm.

    points: m, (n, 3), on the arm, in the base's frame.
    links: PyBullet's indices of the arm's links that are in contact; -1 is the base.
    """

    points: np.ndarray
    links: frozenset[int]


NO_CONTACTS = Contacts(np.zeros((0, 3)), frozenset())


def contacts_in(world: World) -> Contacts:
    """The `Contacts` of the last simulated step in a `World`."""
    points, links = [], set()
    for contact in p.getContactPoints(bodyA=world.body, physicsClientId=world.client):
        _, _, other_body, link, other_link, point, *_, distance, force = contact[:10]
        if distance < 0.0 or force > 0.0:
            points.append(point)
            links.add(link)
            if other_body == world.body:
                links.add(other_link)
    return Contacts(np.array(points).reshape(-1, 3), frozenset(links))


def contacts_with_points(world: World, scene: Scene, configuration: np.ndarray) -> Contacts:
    """As `contacts_in`, with links at the points of an `ObservedScene`, which no world has.

    Args:
        world: the `World`.
        scene: its scene.
        configuration: joint angles (n,), rad, of the step.
    """
    contacts = contacts_in(world)
    if not isinstance(scene, ObservedScene):
        return contacts
    return contacts._replace(links=contacts.links | clearance(scene, configuration).links)


class Arm:
    """An arm on a query.

    Attributes:
        name: what moves it.
        state: its normalised configuration (n,); before `begin`, there is none.
        steps, contact_steps: steps so far, and those with a contact.
        contacts: the `Contacts` after the last step.
        success: whether it has reached its goal.
        ended: whether its episode is over.
        kinematic: whether there are no forces.
        geometry_source: where its observations or its plan take the obstacles from; None: nowhere.
        problem: why it does not move, in words; None if it does.
        trace: the configurations so far, a list of (n,), normalised.
        ms_per_action: mean over the episode; None before the first action.
        action: the last action (n,).
        wanted: the policy's last action (n,), before the safety filter; None without a filter, and
            while the filter escapes from a local minimum or follows an approach path.
        correction: the filter's change of it, L2, normalised; None where `wanted` is None.
        escaping: whether the filter escapes, or follows an approach path, without the policy.
        recording: the normalised configurations (k, n) that it replays; None where it does not.
    """

    recording: np.ndarray | None = None

    def __init__(self, name: str):
        self.name = name
        self.geometry_source: str | None = None
        self.state = np.zeros(0, np.float32)
        self.trace: list[np.ndarray] = []
        self._clear()

    def _clear(self):
        self.steps = 0
        self.contact_steps = 0
        self.contacts = NO_CONTACTS
        self.success = False
        self.ended = False
        self.kinematic = False
        self.problem: str | None = None
        self.ms_per_action: float | None = None
        self.wanted: np.ndarray | None = None
        self.action: np.ndarray | None = None
        self.correction: float | None = None
        self.escaping = False

    @property
    def time(self) -> float:
        """Seconds of simulated time since the start, or the last edit."""
        return self.steps * STEP_SECONDS

    @property
    def in_contact(self) -> bool:
        """Whether the last step had a contact."""
        return bool(self.contacts.links)

    def begin(self, number: int, query: Query, states: np.ndarray | None = None):
        """Put it at the start of a query. `states`: recorded configurations (k, n), normalised."""

    def edit(self, query: Query):
        """Go on from the present configuration with another goal or scene."""

    def step(self):
        """One step."""

    def close(self):
        """Disconnect from PyBullet."""


class WaitingArm(Arm):
    """An arm at the start, in the place of one that is being made.

    Args:
        name: of that one.
        problem: why it waits.
    """

    LOADING = "loading; the first time on a machine, functions are compiled, which takes a minute"

    def __init__(self, name: str, problem: str = LOADING):
        super().__init__(name)
        self._problem = problem

    def begin(self, number: int, query: Query, states: np.ndarray | None = None):
        """Put it at the start."""
        self._clear()
        self.state = query.scene.robot.normalise(query.start)
        self.trace = []
        self.problem = self._problem
        self.ended = True


class RecordedArm(Arm):
    """An arm that replays recorded configurations.

    Its contacts are those of each configuration in the scene as it is now; there are no forces.
    """

    def __init__(self, name: str):
        super().__init__(name)
        self._world = World(drawn=False)

    def begin(self, number: int, query: Query, states: np.ndarray | None = None):
        """Put it at the start of a recording, normalised configurations (k, n)."""
        assert states is not None
        self._clear()
        self.recording = states
        self.state = states[0]
        self.trace = [states[0]]
        self.kinematic = True
        self._world.set_scene(query.scene)

    def edit(self, query: Query):
        """Replace the scene."""
        self._world.set_scene(query.scene)

    def step(self):
        """Advance by one configuration."""
        if self.ended or self.recording is None:
            return
        self.steps += 1
        self.state = self.recording[self.steps]
        self.trace.append(self.state)
        configuration = self._world.robot.denormalise(self.state)
        self._world.in_collision(configuration, self.time)
        self.contacts = contacts_with_points(self._world, self._world.scene, configuration)
        self.contact_steps += self.in_contact
        self.ended = self.success = self.steps == len(self.recording) - 1

    def close(self):
        """Disconnect from PyBullet."""
        self._world.close()


class PolicyArm(Arm):
    """An arm that a policy moves.

    Args:
        task: name of a task, or path of a scene file.
        policy: as for `policies.registry.find_policy`.
        goal_type: `ee`, `config`, `combined`, `pose`; None for the policy's own, otherwise `ee`.
        geometry_source: where the policy, its observations and its safety filter take the obstacles
            from (`envs.perception.geometry_source`); None for the policy's own, otherwise
            `ground_truth`.
        safety_filter: an `policies.safety_filter.SafetyFilter`; None for the one that the
            policy includes, if any; False for none.
        seed: of random numbers.
        time_limit: seconds that `planner` may search.

    Raises:
        ValueError: the policy cannot be used in this task.
    """

    def __init__(
        self,
        task: str,
        policy: str,
        goal_type: str | None = None,
        geometry_source: str | None = None,
        safety_filter: "SafetyFilter | Literal[False] | None" = None,
        seed: int = 0,
        time_limit: float = TIME_LIMIT,
    ):
        super().__init__(policy)
        path, own_arguments = find_policy(policy)
        if safety_filter is None:
            safety_filter = own_safety_filter(path)
        arguments: dict[str, Any] = {"goal_type": "ee", **own_arguments}
        if goal_type is not None:
            arguments["goal_type"] = goal_type
        source = geometry_source or arguments.get("geometry_source")
        if safety_filter:
            arguments["link_distances"] = True
        if arguments.get("link_distances"):
            source = source or GROUND_TRUTH
            arguments["geometry_source"] = source
        elif arguments.get("encoder") == POINT_CLOUD and source != GROUND_TRUTH:
            source = source or POINT_CLOUD
            arguments["geometry_source"] = source
        elif path in CHECKING:
            source = source or GROUND_TRUTH
        else:
            source = None
        self.geometry_source = source
        self.env = envs.make(task, **arguments)
        arm_env = self.env.unwrapped
        assert isinstance(arm_env, RoboArmEnv)
        self._arm_env = arm_env
        self._physics: World = arm_env.world
        self._kinematics: KinematicWorld | None = None
        self._seed = seed
        self._filter: SafetyFilter | None = safety_filter or None
        self._begin = make_policy(
            path,
            self.env,
            seed=seed,
            time_limit=time_limit,
            geometry_source=source or GROUND_TRUTH,
            safety_filter=False,
        )
        self._number = 0
        self._plans = path in PLANNERS
        self._observes_distances = bool(arguments.get("link_distances"))
        self._act: Callable[[Any], Any] | None = None
        self._seconds = 0.0  # of all actions

    def compile(self):
        """Have Numba compile what this arm needs, if `roboarm compile` has not.

        Other threads may use other arms meanwhile.
        """
        # Here, because Numba takes a while to import.
        from roboarm_nmp.envs.collision.checker import CollisionChecker

        robot = self._arm_env.robot
        checker = CollisionChecker(Scene(robot=robot))
        state = np.zeros(robot.num_joints)
        if self._observes_distances:
            distances = checker.link_distances(state)
            if self._filter:
                self._filter(state, distances)
        if self._plans:
            checker.is_motion_free(state, state)

    def begin(self, number: int, query: Query, states: np.ndarray | None = None):
        """Start an episode on a query, in the physics. `states` are not used."""
        self._number = number
        self._arm_env.world = self._physics
        self._start(query)

    def edit(self, query: Query):
        """Go on from the present configuration to another goal, in another scene."""
        if self._kinematics is None:
            self._kinematics = KinematicWorld(query.scene, drawn=False)
        self._arm_env.world = self._kinematics
        self._kinematics.set_scene(query.scene)
        collides = self._kinematics.in_collision(query.goal, moving=False)
        self._start(query._replace(start=self._arm_env.robot.denormalise(self.state)))
        self.kinematic = True
        if collides:
            self.problem = "the goal is in collision"
            self.ended = self.ended or self._plans

    def _start(self, query: Query):
        self._clear()
        self._seconds = 0.0
        self._act = None
        robot = self._arm_env.robot
        self.state = robot.normalise(query.start)
        self.trace = [self.state]
        query = query._replace(start=np.clip(query.start, robot.lower, robot.upper))
        try:
            self.env.reset_specific(*query)  # before planning, as `evaluate` does
            act, plan_found, _ = self._begin(self._number, query)
            self._episode = Episode(self.env, query)
        except ValueError as error:
            self.problem = str(error)
            self.ended = True
            return
        if act is None or plan_found is False:
            self.problem = "no plan found" if act is None else "no path is verified"
        if act is not None:
            self._act = self._recorded(act)
        self.success = self._episode.ended
        self.ended = self._episode.ended or act is None
        self.state = self._observed_state()

    def _observed_state(self) -> np.ndarray:
        return self._episode.observation["observation"][: self._arm_env.robot.num_joints]

    def _recorded(self, act: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """The policy through its safety filter, which notes what the policy wanted."""
        if not self._filter:
            return act

        def note(observation):
            wanted = act(observation)
            self.wanted = wanted
            return wanted

        rng = np.random.default_rng([self._seed, self._number])  # as `make_policy` has it
        filtered = self._filter.filter_policy(note, self.env, rng)

        def act_safely(observation):
            self.wanted = None
            self.correction = None
            action = filtered(observation)
            self.escaping = self.wanted is None
            if self.wanted is not None:
                length = max(np.linalg.norm(self.wanted), 1e-9)
                self.wanted = self.wanted * min(1.0, self._arm_env.max_step / length)
                self.correction = float(np.linalg.norm(action - self.wanted))
            return action

        return act_safely

    def step(self):
        """One step of the environment."""
        if self.ended or self._act is None:
            return
        began = time.perf_counter()
        action = self._act(self._episode.observation)
        self._seconds += time.perf_counter() - began
        self._episode.step(action)
        self.action = action
        self.steps += 1
        self.ms_per_action = 1000 * self._seconds / self.steps
        self.state = self._observed_state()
        self.trace.append(self.state)
        scene, configuration = self._arm_env.scene, self._arm_env.robot.denormalise(self.state)
        self.contacts = contacts_with_points(self._arm_env.world, scene, configuration)
        is_observed = isinstance(scene, ObservedScene)
        self.contact_steps += self.in_contact if is_observed else self._episode.info["collision"]
        self.ended = self._episode.ended
        self.success = self._episode.info["is_success"]

    def trajectory(self) -> Trajectory:
        """The `evaluation.rollout.Trajectory` since the start or the last edit."""
        return self._episode.trajectory()

    def close(self):
        """Disconnect from PyBullet."""
        self._physics.close()
        if self._kinematics is not None:
            self._kinematics.close()


# --- All arms


class Clearance(NamedTuple):
    """How far a configuration is from contact.

    distance: m, between the arm and what is nearest, itself included; negative in contact.
    links: PyBullet's indices of the links in contact.
    nearest: the nearest link and what it is near to, in words.
    """

    distance: float
    links: frozenset[int]
    nearest: str


def clearance(scene: Scene, configuration: np.ndarray) -> Clearance:
    """The `Clearance` of joint angles (n,), rad, within the limits, in a static scene."""
    # Here, because Numba takes a while to import.
    from roboarm_nmp.envs.collision import checker
    from roboarm_nmp.envs.perception.geometry_source import ground_truth_checker

    robot = scene.robot
    state = np.clip(robot.normalise(configuration), -1.0, 1.0)
    signed = ground_truth_checker(scene).signed_distances(state)
    row = int(signed.distance.argmin())
    words = {
        checker.TABLE: "the table",
        checker.FLOOR: "the floor",
        checker.ARM: "another link",
        checker.POINT: "a point",
        checker.NOTHING: "nothing",
    }
    geometry = int(signed.geometry[row])
    near_to = words.get(geometry, f"obstacle {geometry}")
    links = [robot.collision_links[i] for i in np.flatnonzero(signed.distance < 0.0)]
    nearest = f"{robot.link_names[robot.collision_links[row]]} and {near_to}"
    return Clearance(float(signed.distance[row]), frozenset(links), nearest)


class Simulation:
    """Arms on one query, at first the first one of the episodes.

    Attributes:
        episodes: the `Episodes` to choose from.
        arms: list of `Arm`s.
        split, number: of the chosen query.
        query: the `Query` with all edits.
        edited: whether start, goal or scene differ from those of the chosen query.
        pose: joint angles (n,), rad, at which all arms are shown until the next step, if any.

    Raises:
        ValueError: there is no such query.
    """

    def __init__(self, episodes: Episodes, split: str | None = None, number: int = 0):
        self.episodes = episodes
        self.arms: list[Arm] = []
        self.pose: np.ndarray | None = None
        self.select(split or episodes.splits[0], number)

    def add(self, arm: Arm):
        """Another arm, at the start of the query. Closed by `close`."""
        self.arms.append(arm)
        self._place(arm)

    def replace(self, index: int, arm: Arm):
        """Another arm in the place of one, which is closed. It goes on from where that one is."""
        old = self.arms[index]
        self.arms[index] = arm
        self._place(arm)
        if self.edited:
            arm.state = old.state
            arm.edit(self.query)
        old.close()

    def _place(self, arm: Arm):
        arm.begin(self.number, self.query, self._states)

    def select(self, split: str, number: int):
        """Put all arms at the start of a query. Raises ValueError: there is no such query."""
        self.query, self._states = self.episodes.find(split, number)
        self.split = split
        self.number = number
        self.edited = False
        self.restart()

    def restart(self):
        """Put all arms at the start of the query, edited as it is, in the physics."""
        self.pose = None
        for arm in self.arms:
            self._place(arm)

    def step(self):
        """One step of all arms whose episode is not over."""
        self.pose = None
        for arm in self.arms:
            arm.step()

    @property
    def ended(self) -> bool:
        """Whether the episodes of all arms are over."""
        return all(arm.ended for arm in self.arms)

    @property
    def robot(self) -> Robot:
        """The `Robot` of the query's scene."""
        return self.query.scene.robot

    # --- Edits. All arms go on from where they are.

    def _edit(self, query: Query):
        self.query = query
        self.edited = True
        for arm in self.arms:
            arm.edit(query)

    def _set_obstacles(self, obstacles):
        scene = replace(self.query.scene, obstacles=tuple(obstacles))
        self._edit(self.query._replace(scene=scene))

    def set_start(self, start: np.ndarray):
        """Another start, joint angles (n,), rad, clipped to the limits; all arms begin there."""
        start = np.clip(start, self.robot.lower, self.robot.upper).astype(np.float32)
        self.query = self.query._replace(start=start)
        self.edited = True
        self.restart()

    def set_goal(self, goal: np.ndarray):
        """Another goal, joint angles (n,), rad; clipped to the limits."""
        goal = np.clip(goal, self.robot.lower, self.robot.upper).astype(np.float32)
        self._edit(self.query._replace(goal=goal))

    def move_goal(self, position: np.ndarray):
        """Another goal whose end effector is at a position (3,), m, near the present goal.

        Where the arm does not reach that far, the end effector comes as near as it finds.
        """
        self.set_goal(inverse_kinematics(self.robot, position, self.query.goal))

    def turn_goal(self, pose: np.ndarray):
        """Another goal with a pose (7,) of the end effector, near the present goal.

        Where the arm does not reach the pose, the goal stays.
        """
        # Here, because Numba takes a while to import.
        from roboarm_nmp.envs.robots import inverse_kinematics as poses

        goals = poses.inverse_kinematics(self.robot, pose, near=self.query.goal)
        if len(goals):
            self.set_goal(goals[0])

    def replace_obstacle(self, index: int, obstacle):
        """Another obstacle in the place of one. Raises ValueError: its numbers are invalid."""
        obstacles = list(self.query.scene.obstacles)
        obstacles[index] = obstacle
        self._set_obstacles(obstacles)

    def add_obstacle(self, obstacle):
        """One more obstacle, the last. Raises ValueError: its numbers are invalid."""
        self._set_obstacles([*self.query.scene.obstacles, obstacle])

    def remove_obstacle(self, index: int):
        """The scene without an obstacle."""
        obstacles = list(self.query.scene.obstacles)
        del obstacles[index]
        self._set_obstacles(obstacles)

    def save_scene(self, path: str | Path) -> Path:
        """Write the scene as YAML, never over a file that is there: `name_2.yaml` follows it.

        Returns the path of the file. Raises DocumentError, OSError: it cannot be written.
        """
        path = Path(path)
        if path.suffix not in (".yaml", ".yml"):
            path = path.with_name(f"{path.name}.yaml")
        stem, number = path.stem, 2
        while path.exists():
            path = path.with_stem(f"{stem}_{number}")
            number += 1
        save_scene(self.query.scene, path)
        return path

    def close(self):
        """Close all arms."""
        for arm in self.arms:
            arm.close()


def inverse_kinematics(robot: Robot, position, configuration) -> np.ndarray:
    """Joint angles (n,), rad, near a configuration, with the end effector at a position (3,), m.

    Damped least squares (Wampler, 1986) within the joint limits. Where the position is not reached,
    the nearest configuration that was found.

    Args:
        robot: the `Robot`.
        position: (3,), m, in the world.
        configuration: (n,), rad, where the search begins.
    """
    configuration = np.array(configuration, np.float64)
    position = np.asarray(position, np.float64)
    differences = IK_DIFFERENCE * np.eye(robot.num_joints)
    best, smallest = configuration, np.inf
    for _ in range(IK_STEPS):
        end_effector = robot.forward_kinematics(configuration)
        error = position - end_effector
        distance = np.linalg.norm(error)
        if distance < smallest:
            best, smallest = configuration, distance
        if distance < IK_TOLERANCE:
            break
        ahead = robot.forward_kinematics(configuration + differences)
        behind = robot.forward_kinematics(configuration - differences)
        jacobian = (ahead - behind).T / (2 * IK_DIFFERENCE)
        damped = jacobian @ jacobian.T + IK_DAMPING**2 * np.eye(3)
        step = jacobian.T @ np.linalg.solve(damped, error)
        step *= min(1.0, IK_MAX_STEP / max(np.abs(step).max(), 1e-12))
        configuration = np.clip(configuration + step, robot.lower, robot.upper)
    return best
