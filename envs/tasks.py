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


def _two_walls(gap):
    """Walls left and right of the base: the arm goes from front to back through the gap."""
    length, height = 0.7, 0.745
    return Scene(
        tuple(
            Box((0.0, side * (gap / 2 + length / 2), height / 2), (0.04, length, height))
            for side in (1, -1)
        )
    )


TASKS = {
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
}
