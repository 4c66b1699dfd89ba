"""Watch policies in the browser, and move the goal and the obstacles while the arm moves.

    roboarm view wall
    roboarm view wall --policy sac-ee-wall-p1-s1 go-to-goal
    roboarm view my_scene.yaml
    roboarm view random_boxes_hard@ur5.yaml
    roboarm view wall --policy demo
    roboarm view wall --trajectory motion.yaml
    roboarm view roadmaps
    roboarm view --cloud table.ply --trajectory motion.yaml
    roboarm view wall --policy planner --record replay.html

Several policies stand side by side, each with its own copy of the scene. The page offers queries,
play and pause, speed, what is drawn, edits, and sliders for the joints. It opens scene files and
point clouds that are dropped on it, and saves the motion as a GIF. Dragging the goal or an obstacle
changes to a kinematic simulation, without forces, in which every arm goes on from where it is;
Restart runs the edited query in the physics. `--record` writes a replay, one HTML file that plays
without a server.

The page is only for this machine, unless `--host` says otherwise. Ctrl-C ends the command.
"""

import contextlib
import html
import io
import logging
import math
import queue
import re
import socket
import sys
import tempfile
import threading
import time
import webbrowser
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import numpy as np
import tyro

from roboarm_nmp import envs
from roboarm_nmp.datasets.cloud_flags import CloudFlags, check_without_cloud, configuration_in
from roboarm_nmp.datasets.queries import Query
from roboarm_nmp.envs.robots.panda import PANDA, scale_of
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Sphere
from roboarm_nmp.envs.tasks import SCENE_FILES, split_robot
from roboarm_nmp.envs.world import SUBSTEPS, TIME_STEP
from roboarm_nmp.policies.baselines import BASELINES
from roboarm_nmp.policies.registry import policy_file, pretrained_policies
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import check_writable, write_atomically
from roboarm_nmp.utils.flags import NonNegativeFloat, NonNegativeInt, PositiveFloat, Seed
from roboarm_nmp.utils.signals import end_with_one_line, error_line
from roboarm_nmp.viewer.episodes import (
    DEMO,
    Episodes,
    cloud_episodes,
    demonstration_episodes,
    entry_episodes,
    roadmap_episodes,
    task_episodes,
    trajectory_episodes,
)

if TYPE_CHECKING:  # imported when they are needed, so that errors are seen at once
    import viser

    from roboarm_nmp.viewer.simulation import Simulation

PORT = 8080
Port = Annotated[
    int, flags.Range(1, 65535, "in [1, 65535]"), tyro.conf.arg(metavar="INT IN [1, 65535]")
]
STEPS_PER_SECOND = 1 / (TIME_STEP * SUBSTEPS)  # of simulated time
PAUSE = 2.0  # s, between the end of all episodes and the next
STATUS_SECONDS = 0.25  # between two updates of the table
IDLE_SECONDS = 0.5
MAX_QUERY = 1_000_000  # of random queries, which have no end
NEEDS_VISER = "the viewer needs viser: pip install viser"
PHYSICS = "Physics, as in an evaluation."
RECORDING = "A recorded motion, without forces."
KINEMATIC = (
    "<b>Kinematic simulation</b>, because goal or scene were edited: no forces, and obstacles do "
    "not stop the arm. <i>Restart</i> runs the edited query in the physics."
)
NEW_OBSTACLES = ("box", "cylinder", "sphere")
POINT_CLOUD_PLANNER = "planner (point cloud)"  # in the page's list of policies
NO_OBSTACLE = "none"
NOT_POSED = "Move a joint: the arms stop, and are shown there."
UPLOADS = "roboarm-view-"  # how the folders of dropped files begin
# A file that is dropped anywhere on the page goes the way of the upload button, which takes none by
# itself. The image is how a script comes into the page: viser has no other place for one.
DROP = """<style>input[aria-haspopup=listbox] { text-overflow: ellipsis }</style>
<img style="display: none" src="data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAA\
AAABAAEAAAICTAEAOw==" onload="
    if (window.opensDroppedFiles) return;
    window.opensDroppedFiles = true;
    window.addEventListener('dragover', (event) => event.preventDefault());
    window.addEventListener('drop', (event) => {
        const button = document.querySelector('input[type=file]');
        if (!event.dataTransfer.files.length) return;
        event.preventDefault();
        button.files = event.dataTransfer.files;
        button.dispatchEvent(new Event('change', {bubbles: true}));
    });
">"""


@dataclass(kw_only=True)
class Args(CloudFlags):
    task: tyro.conf.Positional[str | None] = None
    """the task's name, the path of a scene file (.yaml), or a folder of roadmap paths; not needed
    with --cloud, where no_obstacles@FILE names another arm"""
    policy: tuple[str, ...] = ()
    """the policies, side by side: `go-to-goal`, `random`, `via-points`, `planner`, a policy
    network, a run's folder with a `policy.onnx` in it, or the name of a pretrained policy; `demo`
    replays the task's demonstrations, and --query is then the number of a demonstration; without
    one, `go-to-goal`, or the recorded motion alone"""
    demos: Path | None = None
    """with `--policy demo`: this file of demonstrations instead of the task's own"""
    entry: Path | None = None
    """replay this entry to the benchmark, a folder of `roboarm benchmark run`; --query is one of
    its queries"""
    trajectory: Path | None = None
    """play this file (.csv, .npz, .json, .yaml; docs/guide/trajectories.md) in the scene of
    --query"""
    query: NonNegativeInt = 0
    """number of the first query, from 0"""
    split: Literal["test", "validation", "original"] = "test"
    """which of the task's queries; without a query file, random queries are shown"""
    goal_type: Literal["ee", "config", "combined", "pose"] | None = None
    """what the goal is; by default the policy's own, otherwise `ee`"""
    geometry_source: str | None = None
    """where `planner`, `via-points`, the safety filter and the policy's observations take the
    obstacles from: `ground_truth`, `point_cloud`, or an encoder with a decoder; by default the
    policy's own, otherwise `ground_truth`"""
    safety_margin: NonNegativeFloat | None = None
    """put a safety filter with this margin (m) around the policies; 0 for no filter; by default the
    filter that a policy includes, if any"""
    seed: Seed = 0
    """of random queries, and of `random`, `via-points`, `planner` and escapes"""
    time_limit: PositiveFloat = 2.0
    """seconds that `planner` may search"""
    speed: PositiveFloat = 1.0
    """of the simulated time, at first"""
    record: Path | None = None
    """write a replay of the query into this HTML file, instead of opening the page"""
    host: str = "127.0.0.1"
    """address to listen at; 0.0.0.0 for all of this machine's"""
    port: Port = PORT
    """port to listen at"""
    open: bool = True
    """open the page in the browser"""


class _Choice(NamedTuple):
    """A policy as the page's list has it."""

    label: str
    policy: str
    geometry_source: str | None


# --- The page


class _Page:
    """The page's controls, and the loop that runs simulation and drawing.

    viser calls callbacks in its own threads. They only put work into a queue, and the loop does it:
    simulation and drawing belong to one thread.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        simulation: "Simulation",
        args: Args,
        choices: list[_Choice],
        loader: "Callable[[_Page, int, _Choice, int], None]",
        folder: str,
    ):
        from roboarm_nmp.viewer.drawing import Drawing  # it imports Numba

        self.server = server
        self.simulation = simulation
        self.args = args
        self.choices = choices
        self._load = loader
        self._folder = folder  # of dropped files
        self._opened: tuple[Args, Simulation] | None = None  # of a dropped file
        self._work: queue.SimpleQueue = queue.SimpleQueue()
        self._drags = {}  # what is dragged -> function and arguments
        self._dragging = set()
        self.selected: int | None = None  # obstacle
        self.playing = True
        self.speed = args.speed
        self._message = ""
        self._is_typing = False  # joint angles
        self._typing_error = ""
        self._ended_at: float | None = None
        self._shown_at = 0.0
        self.drawing = Drawing(server, simulation)
        self.drawing.on_click = lambda index: self.do(self._select_obstacle, index)
        self._add_controls()

    # --- Work from other threads

    def do(self, function, *arguments):
        """Have the loop call a function."""
        self._work.put((function, arguments))

    def _drag(self, what, function, *arguments):
        """Have the loop call a function; a later call for the same object replaces this one."""
        self._drags[what] = function, arguments
        self._work.put((None, ()))

    def run(self) -> "tuple[Args, Simulation]":
        """The loop, until another file is opened: returns the arguments and simulation of that."""
        due, changed = time.monotonic(), True
        while self._opened is None:
            changed |= self._do_work(0.0 if changed else max(0.0, due - time.monotonic()))
            now = time.monotonic()
            if self.playing and not self.simulation.ended:
                self._ended_at = None
                if now >= due:
                    due = max(due + 1 / (STEPS_PER_SECOND * self.speed), now)
                    self.simulation.step()
                    self._is_typing = False
                    changed = True
            else:
                due = now + IDLE_SECONDS
                changed |= self._after_the_end(now)
            if changed:
                with self.server.atomic():
                    self.drawing.update()
                    self._update_controls()
                changed = False
            if now > self._shown_at + STATUS_SECONDS:
                self._shown_at = now
                self._update_status()
        return self._opened

    def _do_work(self, timeout):
        """Do what other threads have asked for; wait for the first of it. Returns whether any."""
        worked = False
        while True:
            try:
                if timeout > 0 and not worked:
                    function, arguments = self._work.get(timeout=timeout)
                else:
                    function, arguments = self._work.get_nowait()
            except queue.Empty:
                break
            worked = True
            if function is not None:
                self._try(function, *arguments)
        while self._drags:
            _, (function, arguments) = self._drags.popitem()
            self._try(function, *arguments)
        return worked

    def _try(self, function, *arguments):
        try:
            self._message = ""
            function(*arguments)
        except (OSError, ValueError) as error:
            self._message = str(error)

    def _after_the_end(self, now):
        """What happens once all episodes are over. Returns whether the drawing changes."""
        simulation = self.simulation
        if not (self.playing and simulation.ended) or simulation.edited:
            return False
        self._ended_at = self._ended_at or now
        if now < self._ended_at + PAUSE or self._at_end.value == "stop":
            return False
        self._ended_at = None
        if self._at_end.value == "repeat":
            simulation.restart()
        else:
            self._select(simulation.split, simulation.number + 1, wrap=True)
        return True

    # --- Controls

    def _add_controls(self):
        from roboarm_nmp.datasets.cloud_files import ENDINGS  # it imports Numba

        gui, simulation = self.server.gui, self.simulation
        self._status = gui.add_html("")
        gui.add_html(DROP)
        hint = f"{', '.join(SCENE_FILES)}; {', '.join(ENDINGS)}; or drop the file on the page"
        upload = gui.add_upload_button("Open a scene or a point cloud", hint=hint)
        upload.on_upload(self._file_chosen)
        with gui.add_folder("Run"):
            self._play = gui.add_button("Pause")
            self._play.on_click(lambda event: self.do(self._toggle))
            gui.add_button("Step").on_click(lambda event: self.do(self._step))
            gui.add_button("Restart").on_click(lambda event: self.do(self._restart))
            self._speed = gui.add_slider(
                "speed", min=0.1, max=4.0, step=0.1, initial_value=min(4.0, max(0.1, self.speed))
            )
            self._speed.on_update(lambda event: self.do(self._set_speed))
            self._at_end = gui.add_dropdown("at the end", ("repeat", "next query", "stop"))
            self._export = gui.add_button("Save the motion (GIF)")
            self._export.on_click(lambda event: self.do(self._export_motion, event.client))
        with gui.add_folder("Query"):
            count = simulation.episodes.count(simulation.split)
            self._split = gui.add_dropdown(
                "split", simulation.episodes.splits, initial_value=simulation.split
            )
            self._number = gui.add_number(
                "number",
                simulation.number,
                min=0,
                max=MAX_QUERY if count is None else count - 1,
                step=1,
            )
            self._split.on_update(self._query_chosen)
            self._number.on_update(self._query_chosen)
            buttons = gui.add_button_group(" ", ("previous", "next"))
            buttons.on_click(lambda event: self.do(self._move_on, event.target.value))
        with gui.add_folder("Arms"):
            self._policies = []
            for index, arm in enumerate(simulation.arms):
                if arm.name == simulation.episodes.recording:
                    continue
                labels = [choice.label for choice in self.choices]
                menu = gui.add_dropdown(
                    f"arm {index + 1}", labels, initial_value=arm.name, hint=arm.name
                )
                menu.on_update(lambda event, index=index: self._policy_chosen(event, index))
                self._policies.append((index, menu))
            self._seed = gui.add_number("seed", self.args.seed, min=0, max=2**32 - 1, step=1)
            self._seed.on_update(self._seed_chosen)
        with gui.add_folder("Show"):
            names = {
                "start": "start",
                "goal": "goal",
                "observed": "observed points",
                "left_out": "points that were left out",
                "swept": "the arm along the motion",
                "decoded": "decoded points",
                "distances": "link distances",
                "correction": "filter corrections",
                "trace": "path of the end effector",
            }
            for option in self.drawing.OPTIONS:
                if option == "decoded" and simulation.robot.arm != PANDA:
                    continue  # pretrained encoders are the Panda's
                if option == "left_out" and simulation.episodes.left_out is None:
                    continue
                box = gui.add_checkbox(names[option], option in self.drawing.show)
                box.on_update(lambda event, o=option: self.do(self._show, o, event.target.value))
        with gui.add_folder("Edit"):
            position = tuple(simulation.robot.forward_kinematics(simulation.query.goal))
            self._goal = gui.add_vector3("goal (m)", position, step=0.01)
            self._goal.on_update(self._goal_typed)
            self._obstacle = gui.add_dropdown("obstacle", self._obstacle_names())
            self._obstacle.on_update(self._obstacle_chosen)
            add = gui.add_button_group("add", NEW_OBSTACLES)
            add.on_click(lambda event: self.do(self._add_obstacle, event.target.value))
            delete = gui.add_button("Delete the obstacle")
            delete.on_click(lambda event: self.do(self._delete))
            self._file = gui.add_text("file", "my_scene.yaml")
            gui.add_button("Save the scene").on_click(lambda event: self.do(self._save))
        with gui.add_folder("Joints"):
            self._clearance = gui.add_markdown(NOT_POSED)
            robot, self._sliders = simulation.robot, []
            shown = np.clip(simulation.query.start, robot.lower, robot.upper)
            for i, (lower, upper) in enumerate(zip(robot.lower, robot.upper, strict=True)):
                slider = gui.add_slider(
                    f"joint {i + 1}",
                    min=float(lower),
                    max=float(upper),
                    step=0.001,
                    initial_value=float(shown[i]),
                )
                slider.on_update(lambda event, i=i: self._slider_moved(event, i))
                self._sliders.append(slider)
            self._angles = gui.add_text("rad", "", multiline=True, hint="to copy, or to type")
            self._angles.on_update(self._angles_typed)
            pose = gui.add_button_group("go to the", ("start", "goal"))
            pose.on_click(lambda event: self.do(self._go_to, event.target.value))
            use = gui.add_button_group("make it the", ("start", "goal"))
            use.on_click(lambda event: self.do(self._use_pose, event.target.value))
        scene = self.server.scene
        self._turns = self.args.goal_type == "pose"
        options = {"scale": 0.2, "disable_rotations": not self._turns, "depth_test": False}
        self._goal_gizmo = scene.add_transform_controls("/goal_gizmo", position=position, **options)
        self._goal_gizmo.on_update(self._goal_dragged)
        self._obstacle_gizmo = scene.add_transform_controls(
            "/obstacle_gizmo", scale=0.25, depth_test=False, visible=False
        )
        self._obstacle_gizmo.on_update(self._obstacle_dragged)

    def _obstacle_names(self):
        kinds = [type(obstacle).__name__ for obstacle in self.simulation.query.scene.obstacles]
        return (NO_OBSTACLE, *(f"{i}: {kind.lower()}" for i, kind in enumerate(kinds)))

    def _update_controls(self):
        """Set controls and gizmos that are not being used to the simulation's values."""
        from roboarm_nmp.viewer.drawing import set_property

        simulation = self.simulation
        position = simulation.robot.forward_kinematics(simulation.query.goal)
        if "goal" not in self._dragging:
            set_property(self._goal_gizmo, "position", position)
            if self._turns:
                x, y, z, w = simulation.robot.end_effector_pose(simulation.query.goal)[3:]
                set_property(self._goal_gizmo, "wxyz", np.array((w, x, y, z)))
        set_property(self._goal, "value", tuple(float(x) for x in np.round(position, 4)))
        names = self._obstacle_names()
        if self._obstacle.options != names:
            self._obstacle.options = names
        if self.selected is not None and self.selected >= len(names) - 1:
            self._select_obstacle(None)
        set_property(
            self._obstacle, "value", names[0 if self.selected is None else self.selected + 1]
        )
        set_property(self._obstacle_gizmo, "visible", self.selected is not None)
        if self.selected is not None and "obstacle" not in self._dragging:
            obstacle = simulation.query.scene.obstacles[self.selected]
            x, y, z, w = getattr(obstacle, "orientation", (0.0, 0.0, 0.0, 1.0))
            set_property(self._obstacle_gizmo, "position", np.array(obstacle.position))
            set_property(self._obstacle_gizmo, "wxyz", np.array((w, x, y, z)))
        set_property(self._number, "value", simulation.number)
        set_property(self._play, "label", "Pause" if self.playing else "Play")
        if simulation.pose is not None:
            self._update_joints()

    def _configuration(self):
        """Joint angles (n,), rad, of the sliders, or of the first arm."""
        if self.simulation.pose is not None:
            return self.simulation.pose.copy()
        return self.simulation.robot.denormalise(self.simulation.arms[0].state)

    def _update_joints(self):
        """Set the sliders, the text of their angles and the clearance there."""
        from roboarm_nmp.viewer.drawing import set_property
        from roboarm_nmp.viewer.simulation import clearance

        simulation, configuration = self.simulation, self._configuration()
        for slider, angle in zip(self._sliders, configuration, strict=True):
            set_property(slider, "value", float(np.clip(angle, slider.min, slider.max)))
        if not self._is_typing:
            text = ", ".join(f"{angle:.4f}" for angle in configuration)
            set_property(self._angles, "value", text)
        text = NOT_POSED
        if self._is_typing and self._typing_error:
            text = self._typing_error
        if simulation.pose is not None:
            found = clearance(simulation.query.scene.at(simulation.arms[0].time), simulation.pose)
            verdict = "**contact**" if found.distance < 0.0 else "**free**"
            how = "deep in each other" if found.distance < 0.0 else "apart"
            text = f"{verdict}: {found.nearest} are {100 * abs(found.distance):.1f} cm {how}"
        set_property(self._clearance, "content", text)

    def _update_status(self):
        from roboarm_nmp.viewer.drawing import outcome, set_property

        simulation = self.simulation
        episodes = simulation.episodes
        query = f"{episodes.label(simulation.split, simulation.number)}"
        lines = [f"<b>{_escaped(episodes.task)}</b>, {query}"]
        if episodes.note:
            lines.append(f"Random queries: {_escaped(episodes.note)}.")
        for arm in simulation.arms:
            mark = "▶"
            if arm.success and not arm.problem:
                mark = "✓"
            elif arm.ended or arm.problem:
                mark = "✗"
            facts = [outcome(arm)]
            if arm.ms_per_action is not None:
                facts.append(f"{arm.ms_per_action:.1f} ms per action")
            if arm.escaping:
                facts.append("an escape from a local minimum, or an approach path")
            elif arm.correction is not None:
                facts.append(f"correction by the filter {arm.correction:.3f}")
            lines.append(f"{mark} <b>{_escaped(arm.name)}</b>: {_escaped('; '.join(facts))}.")
        if all(arm.recording is not None for arm in simulation.arms):
            lines.append(RECORDING)
        elif simulation.edited and any(arm.kinematic for arm in simulation.arms):
            lines.append(KINEMATIC)
        else:
            lines.append(PHYSICS)
        if self._message:
            lines.append(f'<b style="color: #c03020">{_escaped(self._message)}</b>')
        text = "".join(f'<p style="margin: 0 0 0.5em">{line}</p>' for line in lines)
        style = "padding: 0.25em 0.75em; font-size: 0.875em; overflow-wrap: anywhere"
        set_property(self._status, "content", f'<div style="{style}">{text}</div>')
        if simulation.pose is None:
            self._update_joints()

    # --- What controls do. Callbacks run in viser's threads, the rest in the loop.

    def _say(self, message):
        self._message = message

    def _file_chosen(self, event):
        """Open a file in this thread, while the page shows what it showed before."""
        file = event.target.value
        self.do(self._say, f"{file.name}: it is being opened")
        try:
            opened = _open_file(self.args, self._folder, file.name, file.content)
        except (OSError, ValueError) as error:
            self.do(self._say, str(error))
        else:
            self.do(setattr, self, "_opened", opened)

    def _export_motion(self, client):
        """Have a thread draw the arms' motion and send it to a page as a file."""
        arms = [arm for arm in self.simulation.arms if len(arm.trace) > 1]
        if not arms:
            raise ValueError("no arm has moved yet: press Play first")
        denormalise = self.simulation.robot.denormalise
        motions = [(arm.name, denormalise(np.array(arm.trace))) for arm in arms]
        self._export.disabled = True
        self._message = "The motion is being drawn."
        arguments = client, self.simulation.query, motions, _direction(client.camera)
        threading.Thread(target=self._draw_motion, args=arguments, daemon=True).start()

    def _draw_motion(self, client, query, motions, direction):
        episodes = self.simulation.episodes
        try:
            contents = motion_gif(episodes, query, motions, direction)
            client.send_file_download("motion.gif", contents, save_immediately=True)
            self.do(self._say, "The motion was saved as motion.gif.")
        except (OSError, ValueError) as error:
            self.do(self._say, str(error))
        finally:
            self._export.disabled = False

    # --- Joints

    def _slider_moved(self, event, joint):
        if event.client is not None:
            self._drag(("joint", joint), self._move_joint, joint, event.target.value)

    def _move_joint(self, joint, angle):
        configuration = self._configuration()
        configuration[joint] = angle
        self._pose(configuration)

    def _angles_typed(self, event):
        if event.client is not None:
            self._drag("angles", self._type_angles, event.target.value)

    def _type_angles(self, text):
        self.playing = False
        self._is_typing = True  # so that the text stays as it is
        self.simulation.pose = None
        try:
            configuration = configuration_in("joint angles", text, self.simulation.robot)
        except ValueError as error:  # shown beside the text
            self._typing_error = str(error)
            return
        self._typing_error = ""
        self._pose(configuration, is_typing=True)

    def _go_to(self, which):
        self._pose(getattr(self.simulation.query, which))

    def _pose(self, configuration, is_typing=False):
        self.playing = False
        self._is_typing = is_typing
        robot = self.simulation.robot
        self.simulation.pose = np.clip(np.array(configuration, float), robot.lower, robot.upper)

    def _use_pose(self, which):
        configuration = self._configuration()
        self._is_typing = False
        if which == "start":
            self.simulation.set_start(configuration)
        else:
            self.simulation.set_goal(configuration)
            self.simulation.pose = None

    def _toggle(self):
        self.playing = not self.playing
        if self.playing and self.simulation.ended:
            self.simulation.restart()

    def _step(self):
        self.playing = False
        self.simulation.step()

    def _restart(self):
        self.simulation.restart()

    def begin_together(self):
        """Once an arm is made: all begin again, unless there were edits in the meantime."""
        if not self.simulation.edited:
            self.simulation.restart()

    def _set_speed(self):
        self.speed = self._speed.value

    def _show(self, option, shown):
        if shown:
            self.drawing.show.add(option)
        else:
            self.drawing.show.discard(option)

    def _query_chosen(self, event):
        if event.client is not None:  # not set by this program
            self.do(lambda: self._select(self._split.value, int(self._number.value)))

    def _move_on(self, which):
        move = 1 if which == "next" else -1
        self._select(self.simulation.split, self.simulation.number + move, wrap=True)

    def _select(self, split, number, wrap=False):
        count = self.simulation.episodes.count(split)
        if count is not None:
            number = number % count if wrap else min(number, count - 1)
            self._number.max = count - 1
        self.selected = self.drawing.selected = None
        self.simulation.select(split, max(number, 0))

    def _policy_chosen(self, event, index):
        if event.client is not None:
            event.target.hint = event.target.value  # the list cuts long names
            self._load_choice(index, event.target.value)

    def _seed_chosen(self, event):
        if event.client is not None:
            for index, menu in self._policies:
                self._load_choice(index, menu.value)

    def _load_choice(self, index, label):
        choice = next(choice for choice in self.choices if choice.label == label)
        self._load(self, index, choice, int(self._seed.value))

    def _goal_typed(self, event):
        if event.client is not None:
            self._drag("goal", self.simulation.move_goal, np.array(event.target.value))

    def _goal_dragged(self, event):
        self._follow("goal", event.phase)
        position = np.array(event.target.position)
        if self._turns:
            pose = np.r_[position, np.roll(event.target.wxyz, -1)]
            self._drag("goal", self.simulation.turn_goal, pose)
        else:
            self._drag("goal", self.simulation.move_goal, position)

    def _obstacle_dragged(self, event):
        self._follow("obstacle", event.phase)
        pose = tuple(map(float, event.target.position)), tuple(map(float, event.target.wxyz))
        self._drag("obstacle", self._move_obstacle, self.selected, *pose)

    def _follow(self, what, phase):
        if phase == "end":
            self._dragging.discard(what)
        else:
            self._dragging.add(what)

    def _move_obstacle(self, index, position, wxyz):
        if index is None or index >= len(self.simulation.query.scene.obstacles):
            return
        changes = {"position": position}
        obstacle = self.simulation.query.scene.obstacles[index]
        if hasattr(obstacle, "orientation"):
            w, x, y, z = (number / math.hypot(*wxyz) for number in wxyz)
            changes["orientation"] = (x, y, z, w)
        self.simulation.replace_obstacle(index, replace(obstacle, **changes))

    def _obstacle_chosen(self, event):
        if event.client is not None:
            name = event.target.value
            index = None if name == NO_OBSTACLE else int(name.partition(":")[0])
            self.do(self._select_obstacle, index)

    def _select_obstacle(self, index):
        self.selected = self.drawing.selected = index

    def _add_obstacle(self, kind):
        self.simulation.add_obstacle(new_obstacle(kind, self.simulation.robot))
        self._select_obstacle(len(self.simulation.query.scene.obstacles) - 1)

    def _delete(self):
        if self.selected is None:
            raise ValueError("choose an obstacle: click it, or use the list")
        index = self.selected
        self._select_obstacle(None)
        self.simulation.remove_obstacle(index)

    def _save(self):
        path = self.simulation.save_scene(self._file.value)
        self._message = f"The scene was saved as {path}."
        print(f"{path}: written", flush=True)


def _escaped(text):
    """A text for HTML; dropped files are named without their temporary folder."""
    folders = f"{re.escape(tempfile.gettempdir())}/{UPLOADS}[^/]*/[^/]*/"
    return html.escape(re.sub(folders, "", text))


def _direction(camera):
    """Yaw and pitch, degrees, of a page's camera, as `roboarm show --camera` has them."""
    x, y, z = np.subtract(camera.position, camera.look_at)
    return math.degrees(math.atan2(x, -y)), -math.degrees(math.atan2(z, math.hypot(x, y)))


def motion_gif(
    episodes: Episodes,
    query: Query,
    motions: list[tuple[str, np.ndarray]],
    direction: tuple[float, float] | None = None,
) -> bytes:
    """The contents of a GIF of motions in the scene of a query, as `roboarm show` draws them.

    Args:
        episodes: those of the query.
        query: the `Query`.
        motions: of each, its name and joint angles (k, n), rad, one configuration per step.
        direction: yaw and pitch of the view, degrees.
    """
    from roboarm_nmp.viewer.images import save_motions

    env = envs.make(episodes.task, goal_type="combined")
    names, columns = zip(*motions, strict=True)
    if len(names) == 1:
        names = ()
    with contextlib.closing(env), tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "motion.gif")
        left_out = episodes.left_out
        save_motions(path, env, query, columns, names, camera=direction, left_out=left_out)
        return path.read_bytes()


def _open_file(args: Args, folder: str, name: str, contents: bytes) -> "tuple[Args, Simulation]":
    """The arguments and the `Simulation` of a dropped file, which is put into the folder.

    Raises OSError, ValueError: it cannot be used.
    """
    from roboarm_nmp.datasets.cloud_files import ENDINGS  # it imports Numba

    name = Path(name).name
    ending = Path(name).suffix.lower()
    if ending not in (*SCENE_FILES, *ENDINGS):
        raise ValueError(
            f"{name}: a scene ends in {', '.join(SCENE_FILES)}, a point cloud in "
            f"{', '.join(ENDINGS)}"
        )
    path = Path(tempfile.mkdtemp(dir=folder), name)  # a file of the same name may be in use
    path.write_bytes(contents)
    policies = tuple(policy for policy in args.policy if policy != DEMO)
    task, cloud = str(path), None
    if ending in ENDINGS:
        _, robot = split_robot(str(args.task))
        task, cloud = "no_obstacles" if robot is None else f"no_obstacles@{robot}", path
    args = replace(args, task=task, cloud=cloud, policy=policies, demos=None, entry=None, query=0)
    return args, _simulation(args)


def new_obstacle(kind: str, robot: Robot) -> Box | Cylinder | Sphere:
    """An obstacle in front of a robot's base; its lengths are in proportion to the reach."""
    scale = scale_of(robot)
    x, y, z = robot.base_position
    position = (x + 0.5 * scale, y, z + 0.5 * scale)
    if kind == "box":
        return Box(position, (0.15 * scale, 0.15 * scale, 0.15 * scale))
    if kind == "cylinder":
        return Cylinder(position, 0.06 * scale, 0.3 * scale)
    return Sphere(position, 0.1 * scale)


# --- The command


def _check(args: Args):
    """Raises ValueError for arguments that cannot be used, before any work."""
    flags.check(args)
    if args.demos is not None and DEMO not in args.policy:
        raise ValueError("--demos goes with --policy demo")
    recordings = (args.trajectory is not None, DEMO in args.policy, args.entry is not None)
    if args.cloud is not None:
        args.task = args.task or "no_obstacles"
        if DEMO in args.policy or args.entry is not None:
            raise ValueError("--cloud goes with a trajectory or a policy: leave out the recording")
    else:
        check_without_cloud(args)
    if args.task is None:
        raise ValueError("name a task or a scene file, or give --cloud FILE")
    if Path(args.task).is_dir():
        if any(recordings):
            raise ValueError("a recording goes with a task, not with a folder")
    else:
        envs.get_task(args.task)
    if sum(recordings) > 1:
        raise ValueError("--trajectory, --policy demo and --entry are recordings: give one of them")
    for policy in args.policy:
        if policy != DEMO and policy not in BASELINES:
            policy_file(policy)  # or it raises
    if args.record is not None:
        if args.record.suffix.lower() != ".html":
            raise ValueError(f"--record must end in .html, got {args.record}")
        check_writable(args.record)
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise ValueError(f"{NEEDS_VISER} ({error})") from error
    if args.record is None:
        _check_port(args.host, args.port)


def _check_port(host, port):
    """Raises ValueError unless a server can listen there: viser would choose another port."""
    try:
        with socket.create_server((host, port)):
            pass
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(
            f"cannot listen at {host}, port {port} ({reason}): choose another with --port"
        ) from error


def _server(host, port):
    """A viser server, which says nothing."""
    import viser

    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host, port, label="RoboArm-NMP", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
    server.gui.main_panel.dock_right()
    return server


def _stop(server):
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _simulation(args: Args) -> "Simulation":
    """The `Simulation` of the arguments, without policies, on its first query."""
    from roboarm_nmp.viewer.simulation import RecordedArm, Simulation

    assert args.task is not None  # it is checked
    if args.cloud is not None:
        episodes = cloud_episodes(args.task, args, args.seed, args.trajectory)
    elif Path(args.task).is_dir():
        episodes = roadmap_episodes(args.task)
    elif args.entry is not None:
        episodes = entry_episodes(args.task, args.entry)
    elif DEMO in args.policy:
        episodes = demonstration_episodes(args.task, args.demos)
    elif args.trajectory is not None:
        episodes = trajectory_episodes(args.task, args.trajectory, args.seed)
    else:
        episodes = task_episodes(args.task, args.seed)
    simulation = Simulation(episodes, episodes.split(args.split), args.query)
    if episodes.recording is not None:
        simulation.add(RecordedArm(episodes.recording))
    return simulation


def _choices(args: Args, simulation) -> tuple[list[_Choice], list[_Choice]]:
    """The policies of the arguments, and all that the page's list offers: lists of `_Choice`."""
    names = [name for name in args.policy if name != DEMO]
    if not names and simulation.episodes.recording is None:
        names = ["go-to-goal"]
    chosen = [_Choice(name, name, args.geometry_source) for name in names]
    offered = {choice.label: choice for choice in chosen}
    pretrained = pretrained_policies() if simulation.robot.arm == PANDA else ()
    for name in (*BASELINES, *pretrained):
        offered.setdefault(name, _Choice(name, name, args.geometry_source))
    offered[POINT_CLOUD_PLANNER] = _Choice(POINT_CLOUD_PLANNER, "planner", "point_cloud")
    return chosen, list(offered.values())


def _arm(args, task, choice, seed):
    """The `PolicyArm` of a choice."""
    from roboarm_nmp.policies.safety_filter import SafetyFilter
    from roboarm_nmp.viewer.simulation import PolicyArm

    safety_filter = None
    if args.safety_margin is not None:
        safety_filter = SafetyFilter(args.safety_margin) if args.safety_margin else False
    arm = PolicyArm(
        task,
        choice.policy,
        goal_type=args.goal_type,
        geometry_source=choice.geometry_source,
        safety_filter=safety_filter,
        seed=seed,
        time_limit=args.time_limit,
    )
    arm.name = choice.label
    return arm


def _view(args):
    """Serve the page until Ctrl-C."""
    simulation = _simulation(args)
    server = _server(args.host, args.port)
    url = f"http://{args.host}:{args.port}"
    server.on_client_disconnect(
        lambda client: print(f"a page was closed or lost; {url} opens it again", flush=True)
    )
    try:
        with tempfile.TemporaryDirectory(prefix=UPLOADS) as folder:
            page = _make_page(server, simulation, args, folder)
            print(f"{url}  (Ctrl-C ends)", flush=True)
            if args.open and not _open(url):
                print(f"no browser could be opened: open {url} yourself", flush=True)
            while True:
                args, opened = page.run()
                simulation.close()
                simulation = opened
                server.gui.reset()
                server.scene.reset()
                server.gui.main_panel.dock_right()
                page = _make_page(server, simulation, args, folder)
    finally:
        _stop(server)


def _make_page(server, simulation, args, folder) -> _Page:
    """The page of a simulation, whose policies are being made."""
    from roboarm_nmp.viewer.compile import compile_in_process
    from roboarm_nmp.viewer.simulation import WaitingArm

    task = simulation.episodes.task
    chosen, offered = _choices(args, simulation)
    for choice in chosen:
        simulation.add(WaitingArm(choice.label))
    lock = threading.Lock()  # arms are made one after another

    def load(page, index, choice, seed, restart=False):
        """Make an arm in another thread, so that the page keeps moving; then exchange it."""
        page.do(simulation.replace, index, WaitingArm(choice.label))

        def work():
            with lock:
                try:
                    if choice.policy not in ("go-to-goal", "random"):
                        compile_in_process()  # which would stop the page in this process
                    arm = _arm(args, task, choice, seed)
                    arm.compile()
                except ValueError as error:
                    print(f"{choice.label}: {error}", file=sys.stderr, flush=True)
                    page.do(simulation.replace, index, WaitingArm(choice.label, str(error)))
                else:
                    page.do(simulation.replace, index, arm)
                    if restart:
                        page.do(page.begin_together)

        threading.Thread(target=work, daemon=True).start()

    page = _Page(server, simulation, args, offered, load, folder)
    _place_camera(server, simulation)
    first = len(simulation.arms) - len(chosen)
    # Baselines first: they are ready at once.
    for index in sorted(range(len(chosen)), key=lambda i: chosen[i].policy not in BASELINES):
        load(page, first + index, chosen[index], args.seed, restart=True)
    return page


def _open(url):
    try:
        return webbrowser.open(url)
    except (OSError, webbrowser.Error):
        return False


def camera(arms: int, robot: Robot = PANDA) -> tuple[np.ndarray, np.ndarray, float]:
    """Where the camera of a page with so many arms is at first, m; its target; its field (rad)."""
    from roboarm_nmp.viewer.drawing import SPACING

    middle = SPACING * (arms - 1) / 2
    base, scale = np.array(robot.base_position), scale_of(robot)
    eye = base + scale * np.array((1.4 + arms, middle + 0.6, 0.9 + 0.3 * arms))
    target = base + scale * np.array((0.0, middle, 0.4))
    return eye, target, math.radians(50)


def _place_camera(server, simulation):
    eye, target, field_of_view = camera(len(simulation.arms), simulation.robot)
    server.initial_camera.position = eye
    server.initial_camera.look_at = target
    server.initial_camera.fov = field_of_view


def _record(args):
    """Write a replay of the query, one HTML file."""
    from roboarm_nmp.viewer.drawing import COARSE_MESH_CELL, Drawing, outcome

    simulation = _simulation(args)
    for choice in _choices(args, simulation)[0]:
        simulation.add(_arm(args, simulation.episodes.task, choice, args.seed))
    server = _server("127.0.0.1", args.port)
    try:
        drawing = Drawing(server, simulation, COARSE_MESH_CELL)
        _place_camera(server, simulation)
        drawing.update()
        recording = server.get_scene_serializer()
        while not simulation.ended:
            recording.insert_sleep(1 / (STEPS_PER_SECOND * args.speed))
            simulation.step()
            drawing.update()
        recording.insert_sleep(PAUSE)
        contents = recording.as_html().encode()
        write_atomically(args.record, contents)
    finally:
        _stop(server)
    print(f"{args.record}: written, {len(contents) / 1000:.0f} kB")
    for arm in simulation.arms:
        print(f"  {arm.name}: {outcome(arm)}")


def view(args: Args) -> int:
    """Run the viewer. Returns the exit code: 0, or 2 where nothing can be viewed."""
    end_with_one_line("the same command starts again")
    try:
        _check(args)
        if args.record is not None:
            _record(args)
        else:
            _view(args)
    except (OSError, ValueError) as error:
        print(error_line(error), file=sys.stderr)
        return 2
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The command. Returns the exit code: 0, or 2 where nothing can be viewed."""
    return view(flags.parse(Args, arguments, others="viewer"))


if __name__ == "__main__":
    sys.exit(main())
