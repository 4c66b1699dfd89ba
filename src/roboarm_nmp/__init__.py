"""RoboArm-NMP: a learning and evaluation environment for neural motion planning.

    import roboarm_nmp

    env = roboarm_nmp.make("double_walls", goal_type="ee")
    result = roboarm_nmp.evaluate("go-to-goal", "double_walls", num_queries=100)

Importing registers the Gymnasium ids, such as `RoboArmNMP/DoubleWalls-v0`.
"""

from typing import TYPE_CHECKING, Any

from roboarm_nmp.envs import TASKS, make

if TYPE_CHECKING:
    from roboarm_nmp.evaluation.evaluate import evaluate

__all__ = ["TASKS", "evaluate", "make"]


def __getattr__(name: str) -> Any:
    # PyTorch takes seconds to import, and only evaluations need it.
    if name == "evaluate":
        from roboarm_nmp.evaluation.evaluate import evaluate

        return evaluate
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
