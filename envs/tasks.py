"""The tasks: name -> scene, and whether training on it is allowed (paper, section 4).

The paper gives no dimensions. These were chosen to be what the names say, then calibrated so that
the go-to-goal policy succeeds as often as in the paper (docs/tasks.md). A new fixed scene is one
more entry of `TASKS`.
"""

from dataclasses import dataclass

from envs.scenes import Box, Scene


@dataclass(frozen=True)
class Task:
    """A scene under a name; `summary` is one line for listings."""

    scene: Scene
    summary: str
    trainable: bool = True


TASKS = {
    "no_obstacles": Task(Scene(), "the arm, the table and the floor"),
    "wall": Task(
        Scene((Box((0.5, 0.0, 0.3), (0.5, 0.04, 0.6)),)),
        "one wall in front of the arm",
    ),
}
