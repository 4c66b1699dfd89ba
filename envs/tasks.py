"""The tasks: name -> scene, or a distribution of scenes, and whether training on it is allowed.

Paper: section 4. It names the tasks, but gives no dimensions. They are calibrated so that the
go-to-goal policy reaches the paper's success rates (docs/guide/tasks.md). MotionBenchMaker's scenes
are as published.

Tasks are the Panda's. `TASK@ROBOT`, such as `random_boxes_hard@arms/iiwa.yaml`, is a task with
another arm (`envs.robots.files`).
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from roboarm_nmp.envs.robots.files import load_robot
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.robot import Robot
from roboarm_nmp.envs.scenes.containers import Containers
from roboarm_nmp.envs.scenes.formats import WORLD_FILES, load_world
from roboarm_nmp.envs.scenes.mixed_scenes import MixedScenes
from roboarm_nmp.envs.scenes.moving_boxes import (
    AppearingBoxes,
    BlockedGoals,
    ChasedGoals,
    MovingBoxes,
)
from roboarm_nmp.envs.scenes.primitives import TABLE, Box, Cylinder, Scene, SceneDistribution
from roboarm_nmp.envs.scenes.random_boxes import RandomBoxes
from roboarm_nmp.envs.scenes.wide_scenes.distribution import WideScenes
from roboarm_nmp.envs.scenes.wide_scenes.names import HELD_OUT
from roboarm_nmp.utils.names import suggest

SCENE_FILES = WORLD_FILES  # this project's and those of other programs


@dataclass(frozen=True)
class Task:
    """A scene, or a distribution of scenes, under a name.

    Attributes:
        scene: a `Scene`, or a distribution of them with `base` and `sample(rng)`.
        summary: one line for listings.
        trainable: False for the tasks that are there to test generalisation (paper: "OOD").
    """

    scene: Scene | SceneDistribution
    summary: str
    trainable: bool = True

    @property
    def base_scene(self) -> Scene:
        """The `Scene` without the obstacles that vary."""
        return self.scene if isinstance(self.scene, Scene) else self.scene.base


def get_task(task: str | Path) -> Task:
    """The `Task` of a name in `TASKS` or `TRAINING_SCENES`, or of the path of a scene file.

    With `@` and a robot's file after it, the task is that robot's (`envs.robots.files`).

    Raises:
        ValueError: an unknown name, a malformed file, or a task that is the Panda's only.
    """
    task, robot = split_robot(task)
    if robot is not None:
        if has_name(task) and not is_for_any_robot(task):
            names = [name for name in (*TASKS, *TRAINING_SCENES) if is_for_any_robot(name)]
            raise ValueError(
                f"{task} is the Panda's: its obstacles and queries are. Tasks of any robot are "
                f"{', '.join(names)} and scene files"
            )
        named = get_task(task)
        return replace(named, scene=with_robot(named.scene, load_robot(robot)))
    if has_name(task):
        return TASKS[task] if task in TASKS else TRAINING_SCENES[task]
    if is_task(task):
        if has_name(task_name(task)):
            raise ValueError(f"{task}: a scene file may not have the name of a task")
        return Task(load_world(task), f"the scene in {task}")
    if Path(task).suffix or Path(task).name != str(task):
        raise ValueError(f"scene files are .yaml or .scene (docs/customise/scene.md), got {task}")
    raise ValueError(f"unknown task {task!r}: {suggest(task, TASKS)} (or a scene file, .yaml)")


def split_robot(task: str | Path) -> tuple[str, str | None]:
    """`TASK@ROBOT` as (task, robot); the robot is None without `@`, and for a name's `@panda`.

    The `@` follows a name or a scene file: folders may have one in their names, and so do a task's
    data files (`.h5`).
    """
    text = str(task)
    for at in (i for i, letter in enumerate(text) if letter == "@"):
        task, robot = text[:at], text[at + 1 :]
        if has_name(task) and robot == PANDA.name:
            return task, None
        if (has_name(task) or Path(task).suffix in SCENE_FILES) and Path(robot).suffix != ".h5":
            return task, robot
    return text, None


def with_robot(scene: Any, robot: Robot) -> Any:
    """A `Scene`, or a distribution of scenes, with another robot."""
    if isinstance(scene, Scene):
        return replace(scene, robot=robot)
    return replace(scene, base=replace(scene.base, robot=robot))


def is_for_any_robot(name: str) -> bool:
    """Whether a task's obstacles are made for any robot: there are none, or they are random."""
    scene = TASKS[name].scene if name in TASKS else TRAINING_SCENES[name].scene
    return not isinstance(scene, Scene) or not scene.obstacles


def is_task(task: str | Path) -> bool:
    """Whether `task` is a name, or the path of a scene file; a robot may follow."""
    task, _ = split_robot(task)
    return has_name(task) or Path(task).suffix in SCENE_FILES


def has_name(task: str | Path) -> bool:
    """Whether `task` is one of `TASKS` or `TRAINING_SCENES`."""
    return task in TASKS or task in TRAINING_SCENES


def task_name(task: str | Path) -> str:
    """The name of a task in files: its own, or that of its files without suffix."""
    return "@".join(Path(part).stem for part in split_robot(task) if part is not None)


def _two_walls(gap):
    """Walls left and right of the base. The arm moves from front to back through the gap."""
    length, height = 0.7, 0.745
    return Scene(
        tuple(
            Box((0.0, side * (gap / 2 + length / 2), height / 2), (0.04, length, height))
            for side in (1, -1)
        )
    )


# Racks behind the arm would stand beyond the standard table.
_WIDE_TABLE = Box((0.0, 0.0, -0.02), (1.6, 1.6, 0.04))


def _racks(quarters, near, width, heights, sides=True, table=_WIDE_TABLE):
    """Equal racks of boards around the robot.

    Args:
        quarters: their sides: 0 in front of the robot, 1 to its left, 2 behind it, 3 to its right.
        near: distance of their fronts from the robot's axis, m.
        width: m.
        heights: of the boards' centres, m.
        sides: closed sides as high as the rack; otherwise four poles.
        table: the box under them.
    """
    depth, board, pole = 0.35, 0.03, 0.04
    top = heights[-1] + board / 2
    upright = (depth, board, top) if sides else (pole, pole, top)
    y = (width + board) / 2 if sides else (width - pole) / 2
    xs = (near + depth / 2,) if sides else (near + pole / 2, near + depth - pole / 2)
    parts = [((near + depth / 2, 0.0, height), (depth, width, board)) for height in heights]
    parts += [((x, side, top / 2), upright) for x in xs for side in (y, -y)]
    obstacles = []
    for quarter in range(4):
        if quarter in quarters:
            obstacles += [Box(*part) for part in parts]
        parts = [((-y, x, z), (b, a, c)) for (x, y, z), (a, b, c) in parts]
    return Scene(tuple(obstacles), table=table)


# MotionBenchMaker's nominal scenes (Chamzas et al., RA-L 7(2), 2022), to the millimetre. They have
# neither table nor floor: the shelves stand 0.7 m below the robot's base. A floor at the base's
# height would collide with 42 of the 100 original goals of the thin shelf (docs/guide/tasks.md).
def _can(x, y, z):
    return Cylinder((x, y, z), radius=0.03, length=0.14)


def _bookshelf_tall():
    shelves = [Box((1.3, 0.0, z), (1.2, 1.0, 0.04)) for z in (0.0, 0.3, 0.6, 0.9)]
    sides = [Box((1.3, y, 0.12), (1.3, 0.04, 1.64)) for y in (-0.5, 0.5)]
    cans = [_can(x, 0.0, z) for z in (0.68, 0.08, 0.38) for x in (1.2, 1.0, 0.8)]
    return Scene((*shelves, *sides, *cans), table=None, floor=None)


def _bookshelf_thin():
    heights = (-0.35, -0.1, 0.15, 0.4, 0.65, 0.9)
    shelves = [Box((0.9, 0.0, z), (0.62, 1.0, 0.04)) for z in heights]
    board = Box((0.9, 0.0, 0.2), (0.62, 0.04, 1.4))
    legs = [Box((x, y, 0.12), (0.04, 0.04, 1.64)) for x in (0.6, 1.2) for y in (0.5, -0.5)]
    levels = ((-0.26, 0.25), (-0.01, -0.25), (0.24, 0.25), (0.49, -0.25), (0.74, 0.25))
    cans = [_can(x, y, z) for z, y in levels for x in (1.0, 0.7)]
    return Scene((*shelves, board, *legs, *cans), table=None, floor=None)


TASKS: dict[str, Task] = {
    "no_obstacles": Task(Scene(), "the arm, its table and the floor"),
    "wall": Task(
        Scene((Box((0.6, 0.0, 0.3875), (0.7, 0.04, 0.775)),)),
        "a wall in front of the arm, seen edge-on from the base, splits left from right",
    ),
    "double_walls_wide_gap": Task(
        _two_walls(0.6), "two walls split front from back; a gap of 0.6 m around the base"
    ),
    "double_walls": Task(
        _two_walls(0.3), "two walls split front from back; a gap of 0.3 m around the base"
    ),
    "boxes": Task(
        Scene(
            (
                Box((0.55, 0.25, 0.2), (0.2, 0.2, 0.4)),
                Box((0.5, -0.35, 0.125), (0.25, 0.2, 0.25)),
                Box((0.4, -0.05, 0.75), (0.2, 0.25, 0.12)),
                Box((-0.45, 0.35, 0.3), (0.15, 0.2, 0.6)),
                Box((-0.4, -0.4, 0.5), (0.2, 0.15, 0.15)),
                Box((0.1, 0.6, 0.5), (0.25, 0.15, 0.15)),
            )
        ),
        "six boxes, standing and hanging, all around the arm",
    ),
    "random_boxes_easy": Task(
        RandomBoxes(2, 4), "2 to 4 shelves, poles and walls around the arm, new in every episode"
    ),
    "random_boxes_medium": Task(RandomBoxes(3, 6), "the same, 3 to 6"),
    "random_boxes_hard": Task(RandomBoxes(4, 8), "the same, 4 to 8"),
    "three_shelves": Task(
        _racks((0,), 0.34, 0.9, (0.2, 0.5, 0.8), table=TABLE),
        "a rack of three shelves in front of the arm, closed at the sides",
        trainable=False,
    ),
    "pole_shelves": Task(
        _racks((0, 2), 0.39, 0.8, (0.2, 0.5, 0.8), sides=False),
        "two racks of three shelves on poles, in front of the arm and behind it",
        trainable=False,
    ),
    "narrow_shelves": Task(
        _racks((0, 1, 2, 3), 0.39, 0.3, (0.2, 0.4, 0.6, 0.8, 1.0)),
        "four narrow racks of five shelves, all around the arm",
        trainable=False,
    ),
    "benchmaker_bookshelf_tall": Task(
        _bookshelf_tall(), "MotionBenchMaker's bookshelf_tall: four wide shelves", trainable=False
    ),
    "benchmaker_bookshelf_thin": Task(
        _bookshelf_thin(),
        "MotionBenchMaker's bookshelf_thin: six shelves, divided by a board",
        trainable=False,
    ),
    "wide_scenes": Task(
        WideScenes(), "fourteen families of places where arms work, from kitchens to scaffolds"
    ),
    "wide_scenes_held_out": Task(
        WideScenes(HELD_OUT),
        "four more: bottle racks, conveyors, pipes, rubble",
        trainable=False,
    ),
    "appearing_boxes": Task(
        AppearingBoxes(),
        "random_boxes_hard, half of the boxes appear in the first 3 s",
        trainable=False,
    ),
    "moving_boxes_easy": Task(
        MovingBoxes(share=1 / 3, periods=(6.0, 10.0)),
        "random_boxes_hard, a third of the boxes oscillates with periods of 6 to 10 s",
        trainable=False,
    ),
    "moving_boxes_medium": Task(
        MovingBoxes(share=0.5, periods=(3.0, 8.0)),
        "the same, half of the boxes, periods of 3 to 8 s",
        trainable=False,
    ),
    "moving_boxes_hard": Task(
        MovingBoxes(share=0.8, periods=(1.2, 3.2)),
        "the same, four of five boxes, periods of 1.2 to 3.2 s",
        trainable=False,
    ),
    "blocked_goals": Task(
        BlockedGoals(),
        "random_boxes_medium, and a box at the goal that leaves after 2 to 6 s",
        trainable=False,
    ),
    "chased_goals": Task(
        ChasedGoals(),
        "random_boxes_medium, and one or two boxes that visit the goal again and again",
        trainable=False,
    ),
}
STATIC_TASKS = {name: task for name, task in TASKS.items() if not hasattr(task.scene, "animate")}
"""The tasks whose obstacles do not move."""
# Not a task of the benchmark: it has no queries. Paths in these scenes are training data.
TRAINING_SCENES = {
    "mixed_scenes": Task(MixedScenes(), "random boxes, walls with gaps, or racks of shelves"),
    "containers": Task(Containers(), "open boxes, shelves with compartments, cluttered tables"),
}
