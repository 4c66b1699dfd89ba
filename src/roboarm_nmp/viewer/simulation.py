"""What the viewer shows, without the drawing: arms on one query, step by step, and edits of it.

    simulation = Simulation(task_episodes("wall"))
    simulation.add(PolicyArm("wall", "go-to-goal"))
    simulation.select("test", 0)
    while not simulation.ended:
        simulation.step()
    simulation.arms[0].success

Without edits, an episode is that of `evaluation.rollout.rollout`, bit for bit. After an edit of
the goal or of an obstacle, every arm goes on from where it is in a `KinematicWorld`, which has no
forces; `restart` runs the edited query in the physics again.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.format import ORIGINAL, SPLITS, DatasetError
from roboarm_nmp.datasets.queries import Query, load_queries, query_path
from roboarm_nmp.datasets.roadmap_paths import load_roadmap_paths
from roboarm_nmp.envs.robots.control import STEP_SECONDS
from roboarm_nmp.envs.scenes.files import save_scene
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.subgoals import subgoals
from roboarm_nmp.envs.world import World
from roboarm_nmp.evaluation.rollout import Episode
from roboarm_nmp.motions.trajectories import load_trajectory
from roboarm_nmp.policies.baselines import CHECKING, PLANNERS
from roboarm_nmp.policies.registry import find_policy, make_policy, own_safety_filter
from roboarm_nmp.utils.bullet import pybullet as p

GROUND_TRUTH = "ground_truth"
TIME_LIMIT = 2.0  # s, that `planner` may search: the browser waits
MAX_SECONDS = 3600  # of a trajectory from a file
# Of the inverse kinematics: steps at most, error of the position (m), damping, longest step (rad).
IK_STEPS, IK_TOLERANCE, IK_DAMPING, IK_MAX_STEP = 200, 1e-4, 0.05, 0.2


# --- What can be shown


@dataclass(frozen=True)
class Episodes:
    """Queries to choose from, and recorded motions on them, if any.

    Attributes:
        task: name of their task, or path of a scene file.
        splits: names of the parts that they are in.
        count: function from a split to the number of queries; None: there is no end.
        get: function from a split and a number to a `Query` and the recorded normalised
            configurations (n, 7), None without a recording.
        recording: what a recording is called; None where there are none.
    """

    task: str
    splits: tuple[str, ...]
    count: Callable[[str], int | None]
    get: Callable[[str, int], tuple[Query, np.ndarray | None]]
    recording: str | None = None


def task_episodes(task, seed=0):
    """The `Episodes` of a task's queries; random ones of a seed where it has no query file.

    Args:
        task: name of a task, or path of a scene file.

    Raises:
        ValueError: there is no such task, or its scene or query file cannot be used.
    """
    envs.get_task(task)
    if not query_path(task).exists():
        return Episodes(task, ("random",), lambda split: None, _random_queries(task, seed))
    queries = {}
    for split in (*SPLITS, ORIGINAL):
        try:
            queries[split] = load_queries(task, split)
        except DatasetError:
            if split != ORIGINAL:
                raise
    return Episodes(
        task,
        tuple(queries),
        lambda split: len(queries[split]),
        lambda split, number: (queries[split][number], None),
    )


def _random_queries(task, seed):
    env = envs.make(task)

    def get(split, number):
        rng = np.random.default_rng([seed, number])
        env.sample_scene(rng)
        try:
            return Query(*env.sample_moving_query(rng), env.scene), None
        except RuntimeError as error:
            raise ValueError(f"{task}: {error}") from error

    return get


def demonstration_episodes(task):
    """The `Episodes` of a task's demonstrations. Raises DatasetError: it has none."""
    demos = load_demos(task)

    def get(split, number):
        demo = demos[number]
        return Query(demo.start, demo.goal, demo.scene), demo.states

    return Episodes(task, ("demonstrations",), lambda split: len(demos), get, "demonstration")


def roadmap_episodes(folder):
    """The `Episodes` of a folder of roadmap paths. Raises DatasetError: it is none."""
    paths = load_roadmap_paths(folder)

    def get(split, number):
        scene = int(np.searchsorted(paths.path_offsets, number, side="right")) - 1
        points = paths.points[paths.offsets[number] : paths.offsets[number + 1]]
        scene = paths.scenes[scene]
        path = scene.robot.denormalise(points)
        query = Query(path[0].astype(np.float32), path[-1].astype(np.float32), scene)
        return query, subgoals(path, scene.robot).astype(np.float32)

    count = len(paths.offsets) - 1
    return Episodes(paths.task, ("roadmap paths",), lambda split: count, get, "roadmap path")


def trajectory_episodes(task, path):
    """The `Episodes` of a file of a trajectory, in the scene of each query.

    Raises ValueError: there is no such task, or the file is no trajectory of its arm.
    """
    trajectory = load_trajectory(path, envs.get_task(task).base_scene.robot)
    if trajectory.duration > MAX_SECONDS:
        raise DatasetError(f"{path}: it is longer than {MAX_SECONDS} s")
    robot, queries = trajectory.robot, task_episodes(task)
    ends = trajectory.positions[[0, -1]].astype(np.float32)
    states = robot.normalise(trajectory.frames()).astype(np.float32)

    def get(split, number):
        return Query(*ends, queries.get(split, number)[0].scene), states

    return replace(queries, get=get, recording="trajectory")


# --- Arms


class KinematicWorld(World):
    """A world without forces: the arm jumps to every commanded configuration, also in contact."""

    def simulate(self):
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
    links: frozenset


NO_CONTACTS = Contacts(np.zeros((0, 3)), frozenset())


def contacts_in(world):
    """The `Contacts` of the last simulated step in a `World`."""
    found = [
        contact
        for contact in p.getContactPoints(bodyA=world.body, physicsClientId=world.client)
        if contact[8] < 0.0 or contact[9] > 0.0
    ]
    links = {contact[3] for contact in found}
    links |= {contact[4] for contact in found if contact[2] == world.body}
    return Contacts(np.array([contact[5] for contact in found]).reshape(-1, 3), frozenset(links))


class _Arm:
    """An arm on a query.

    Attributes:
        name: what moves it.
        state: its normalised configuration (n,); None before `begin`.
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
    """

    def __init__(self, name):
        self.name, self.geometry_source = name, None
        self.state, self.trace = None, []
        self._clear()

    def _clear(self):
        self.steps = self.contact_steps = 0
        self.contacts, self.success, self.ended = NO_CONTACTS, False, False
        self.kinematic, self.problem, self.ms_per_action = False, None, None
        self.wanted, self.action, self.correction, self.escaping = None, None, None, False

    @property
    def time(self):
        """Seconds of simulated time since the start, or the last edit."""
        return self.steps * STEP_SECONDS

    @property
    def in_contact(self):
        """Whether the last step had a contact."""
        return bool(self.contacts.links)


class WaitingArm(_Arm):
    """An arm at the start, in the place of one that is being made.

    Args:
        name: of that one.
        problem: why it waits.
    """

    LOADING = "loading (for the first time on a machine, about half a minute longer)"

    def __init__(self, name, problem=LOADING):
        super().__init__(name)
        self._problem = problem

    def begin(self, number, query, states=None):
        """Put it at the start."""
        self._clear()
        self.state, self.trace = query.scene.robot.normalise(query.start), []
        self.problem, self.ended = self._problem, True

    def edit(self, query):
        """Nothing."""

    def step(self):
        """Nothing."""

    def close(self):
        """Nothing."""


class RecordedArm(_Arm):
    """An arm that replays recorded configurations.

    Its contacts are those of each configuration in the scene as it is now; there are no forces.
    """

    def __init__(self, episodes):
        super().__init__(episodes.recording)
        self._world = World(drawn=False)

    def begin(self, number, query, states):
        """Put it at the start of a recording, normalised configurations (n, 7)."""
        self._clear()
        self._states, self.state, self.kinematic = states, states[0], True
        self.trace = [states[0]]
        self._world.set_scene(query.scene)

    def edit(self, query):
        """Replace the scene."""
        self._world.set_scene(query.scene)

    def step(self):
        """Advance by one configuration."""
        if self.ended:
            return
        self.steps += 1
        self.state = self._states[self.steps]
        self.trace.append(self.state)
        self._world.in_collision(self._world.robot.denormalise(self.state), self.time)
        self.contacts = contacts_in(self._world)
        self.contact_steps += self.in_contact
        self.ended = self.success = self.steps == len(self._states) - 1

    def close(self):
        """Disconnect from PyBullet."""
        self._world.close()


class PolicyArm(_Arm):
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
        task,
        policy,
        goal_type=None,
        geometry_source=None,
        safety_filter=None,
        seed=0,
        time_limit=TIME_LIMIT,
    ):
        super().__init__(policy)
        path, arguments = find_policy(policy)
        if safety_filter is None:
            safety_filter = own_safety_filter(path)
        arguments = dict(arguments)
        arguments["goal_type"] = goal_type or arguments.get("goal_type", "ee")
        source = geometry_source or arguments.get("geometry_source")
        if safety_filter:
            arguments["link_distances"] = True
        if arguments.get("link_distances"):
            source = arguments["geometry_source"] = source or GROUND_TRUTH
        elif arguments.get("encoder") == "point_cloud" and source != GROUND_TRUTH:
            source = arguments["geometry_source"] = source or "point_cloud"
        elif path in CHECKING:
            source = source or GROUND_TRUTH
        else:
            source = None
        self.geometry_source = source
        self.env = envs.make(task, **arguments)
        self._physics, self._kinematics = self.env.unwrapped.world, None
        self._seed, self._filter = seed, safety_filter
        options = {"seed": seed, "time_limit": time_limit, "safety_filter": False}
        self._begin = make_policy(path, self.env, geometry_source=source or GROUND_TRUTH, **options)
        self._number, self._plans = 0, path in PLANNERS

    def compile(self):
        """Have Numba compile what this arm needs, half a minute for the first time on a machine.

        Other threads may use other arms meanwhile.
        """
        # Here, because Numba takes a while to import.
        from roboarm_nmp.envs.collision.checker import CollisionChecker

        robot = self.env.unwrapped.robot
        checker, state = CollisionChecker(Scene(robot=robot)), np.zeros(robot.num_joints)
        if "link_distances" in self.env.observation_space.spaces:
            distances = checker.link_distances(state)
            if self._filter:
                self._filter(state, distances)
        if self._plans:
            checker.is_motion_free(state, state)

    def begin(self, number, query, states=None):
        """Start an episode on a query, in the physics. `states` are not used."""
        self._number, self.env.unwrapped.world = number, self._physics
        self._start(query)

    def edit(self, query):
        """Go on from the present configuration to another goal, in another scene."""
        if self._kinematics is None:
            self._kinematics = KinematicWorld(query.scene, drawn=False)
        self.env.unwrapped.world = self._kinematics
        self._kinematics.set_scene(query.scene)
        collides = self._kinematics.in_collision(query.goal, moving=False)
        self._start(query._replace(start=self.env.unwrapped.robot.denormalise(self.state)))
        self.kinematic = True
        if collides:
            self.problem = "the goal is in collision"
            self.ended |= self._plans

    def _start(self, query):
        self._clear()
        self._seconds, self._act, robot = 0.0, None, self.env.unwrapped.robot
        self.state = robot.normalise(query.start)
        self.trace = [self.state]
        query = query._replace(start=np.clip(query.start, robot.lower, robot.upper))
        try:
            self.env.reset_specific(*query)  # before planning, as `evaluate` does
            act, plan_found = self._begin(self._number, query)
            self._episode = Episode(self.env, query)
        except ValueError as error:
            self.problem, self.ended = str(error), True
            return
        if act is None or plan_found is False:
            self.problem = "no plan found"
        self._act = self._recorded(act) if act is not None else None
        self.ended, self.success = self._episode.ended or act is None, self._episode.ended
        self.state = self._state()

    def _state(self):
        joints = self.env.unwrapped.robot.num_joints
        return self._episode.observation["observation"][:joints]

    def _recorded(self, act):
        """The policy through its safety filter, which notes what the policy wanted."""
        if not self._filter:
            return act

        def note(observation):
            self.wanted = act(observation)
            return self.wanted

        rng = np.random.default_rng([self._seed, self._number])  # as `make_policy` has it
        filtered = self._filter.filter_policy(note, self.env, rng)

        def act_safely(observation):
            self.wanted, self.correction = None, None
            action = filtered(observation)
            self.escaping = self.wanted is None
            if not self.escaping:
                length = max(np.linalg.norm(self.wanted), 1e-9)
                self.wanted = self.wanted * min(1.0, self.env.unwrapped.max_step / length)
                self.correction = float(np.linalg.norm(action - self.wanted))
            return action

        return act_safely

    def step(self):
        """One step of the environment."""
        if self.ended:
            return
        began = time.perf_counter()
        self.action = self._act(self._episode.observation)
        self._seconds += time.perf_counter() - began
        self._episode.step(self.action)
        self.steps += 1
        self.ms_per_action = 1000 * self._seconds / self.steps
        self.state = self._state()
        self.trace.append(self.state)
        self.contacts = contacts_in(self.env.unwrapped.world)
        self.contact_steps += self._episode.info["collision"]
        self.ended, self.success = self._episode.ended, self._episode.info["is_success"]

    def trajectory(self):
        """The `evaluation.rollout.Trajectory` since the start or the last edit."""
        return self._episode.trajectory()

    def close(self):
        """Disconnect from PyBullet."""
        for world in (self._physics, self._kinematics):
            if world is not None:
                world.close()


# --- All arms


class Simulation:
    """Arms on one query.

    Attributes:
        episodes: the `Episodes` to choose from.
        arms: list of `PolicyArm`s and `RecordedArm`s.
        split, number: of the chosen query.
        query: the `Query` with all edits.
        edited: whether goal or scene differ from those of the chosen query.
    """

    def __init__(self, episodes):
        self.episodes, self.arms = episodes, []
        self.split, self.number = episodes.splits[0], 0
        self.query, self._states, self.edited = None, None, False

    def add(self, arm):
        """Another arm, at the start of the query. Closed by `close`."""
        self.arms.append(arm)
        if self.query is not None:
            self._place(arm)

    def replace(self, index, arm):
        """Another arm in the place of one, which is closed. It goes on from where that one is."""
        old, self.arms[index] = self.arms[index], arm
        self._place(arm)
        if self.edited:
            arm.state = old.state
            arm.edit(self.query)
        old.close()

    def _place(self, arm):
        arm.begin(self.number, self.query, self._states)

    def select(self, split, number):
        """Put all arms at the start of a query. Raises ValueError: there is no such query."""
        if split not in self.episodes.splits:
            known = ", ".join(self.episodes.splits)
            raise ValueError(f"there are no {split} queries of {self.episodes.task}: {known}")
        count = self.episodes.count(split)
        if number < 0 or (count is not None and number >= count):
            raise ValueError(f"no {split} query {number}: the numbers are 0 to {count - 1}")
        self.query, self._states = self.episodes.get(split, number)
        self.split, self.number, self.edited = split, number, False
        self.restart()

    def restart(self):
        """Put all arms at the start of the query, edited as it is, in the physics."""
        for arm in self.arms:
            self._place(arm)

    def step(self):
        """One step of all arms whose episode is not over."""
        for arm in self.arms:
            arm.step()

    @property
    def ended(self):
        """Whether the episodes of all arms are over."""
        return all(arm.ended for arm in self.arms)

    @property
    def robot(self):
        """The `Robot` of the query's scene."""
        return self.query.scene.robot

    # --- Edits. All arms go on from where they are.

    def _edit(self, **changes):
        self.query, self.edited = self.query._replace(**changes), True
        for arm in self.arms:
            arm.edit(self.query)

    def set_goal(self, goal):
        """Another goal, joint angles (n,), rad; clipped to the limits."""
        self._edit(goal=np.clip(goal, self.robot.lower, self.robot.upper).astype(np.float32))

    def move_goal(self, position):
        """Another goal whose end effector is at a position (3,), m, near the present goal.

        Where the arm does not reach that far, the end effector comes as near as it finds.
        """
        self.set_goal(inverse_kinematics(self.robot, position, self.query.goal))

    def turn_goal(self, pose):
        """Another goal with a pose (7,) of the end effector, near the present goal.

        Where the arm does not reach the pose, the goal stays.
        """
        # Here, because Numba takes a while to import.
        from roboarm_nmp.envs.robots import inverse_kinematics as poses

        found = poses.inverse_kinematics(self.robot, pose, near=self.query.goal)
        if len(found):
            self.set_goal(found[0])

    def replace_obstacle(self, index, obstacle):
        """Another obstacle in the place of one. Raises ValueError: its numbers are invalid."""
        obstacles = list(self.query.scene.obstacles)
        obstacles[index] = obstacle
        self._edit(scene=replace(self.query.scene, obstacles=tuple(obstacles)))

    def add_obstacle(self, obstacle):
        """One more obstacle, the last. Raises ValueError: its numbers are invalid."""
        obstacles = (*self.query.scene.obstacles, obstacle)
        self._edit(scene=replace(self.query.scene, obstacles=obstacles))

    def remove_obstacle(self, index):
        """The scene without an obstacle."""
        obstacles = list(self.query.scene.obstacles)
        del obstacles[index]
        self._edit(scene=replace(self.query.scene, obstacles=tuple(obstacles)))

    def save_scene(self, path):
        """Write the scene as YAML, never over a file that is there: `name_2.yaml` follows it.

        Returns the path of the file. Raises DocumentError, OSError: it cannot be written.
        """
        path = Path(path)
        if path.suffix not in (".yaml", ".yml"):
            path = path.with_name(f"{path.name}.yaml")
        first, number = path, 2
        while path.exists():
            path = first.with_stem(f"{first.stem}_{number}")
            number += 1
        save_scene(self.query.scene, path)
        return path

    def close(self):
        """Close all arms."""
        for arm in self.arms:
            arm.close()


def inverse_kinematics(robot, position, configuration):
    """Joint angles (n,), rad, near a configuration, with the end effector at a position (3,), m.

    Damped least squares (Wampler, 1986) within the joint limits. Where the position is not reached,
    the nearest configuration that was found.

    Args:
        robot: the `Robot`.
        position: (3,), m, in the world.
        configuration: (n,), rad, where the search begins.
    """
    c, position = np.array(configuration, np.float64), np.asarray(position, np.float64)
    best, least = c, np.inf
    for _ in range(IK_STEPS):
        here = robot.forward_kinematics(c)
        error = position - here
        distance = np.linalg.norm(error)
        if distance < least:
            best, least = c, distance
        if distance < IK_TOLERANCE:
            break
        jacobian = _jacobian(robot, c, here)
        damped = jacobian @ jacobian.T + IK_DAMPING**2 * np.eye(3)
        step = jacobian.T @ np.linalg.solve(damped, error)
        step *= min(1.0, IK_MAX_STEP / max(np.abs(step).max(), 1e-12))
        c = np.clip(c + step, robot.lower, robot.upper)
    return best


def _jacobian(robot, configuration, end_effector):
    """The Jacobian (3, n), m per rad, of the end effector, which is at a position (3,), m."""
    jacobian, poses = np.zeros((3, robot.num_joints)), robot.frame_poses(configuration)
    index = robot.end_effector_frame
    while index >= 0:
        frame, (origin, axes) = robot.frames[index], poses[index]
        axis = axes[:, 2]
        motion = axis if frame.is_prismatic else np.cross(axis, end_effector - origin)
        jacobian[:, frame.joint] += frame.multiplier * motion
        index = frame.parent
    return jacobian
