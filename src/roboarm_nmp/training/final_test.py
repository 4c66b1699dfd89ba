"""The queries of a trainer of policies, and the test of its best policy at the end."""

import sys
from typing import Any

from roboarm_nmp.datasets.queries import Queries, load_queries
from roboarm_nmp.envs.tasks import get_task
from roboarm_nmp.training.arguments import fail
from roboarm_nmp.training.runs import Run

RESULTS = (
    *("success_rate", "collision_free_success_rate", "collision_rate"),
    *("contact_share", "mean_steps"),
)
"""What a trainer reports of `evaluation.evaluate`."""


def load_task(args: Any) -> tuple[Queries, Queries]:
    """The first `eval_queries` validation and `test_queries` test queries of `args.task`.

    Raises:
        SystemExit: unknown task, a task for testing only, or its query file cannot be used.
    """
    try:
        if not get_task(args.task).trainable:
            fail(f"{args.task} is for testing only: nothing may be learned from it")
        validation = load_queries(args.task, "validation")
        test = load_queries(args.task, "test")
    except ValueError as error:
        fail(f"--task: {error}")
    for kind, queries in (("eval", validation), ("test", test)):
        number = getattr(args, f"{kind}_queries")
        if number > len(queries):
            print(f"--{kind}-queries {number}: there are only {len(queries)}", file=sys.stderr)
    return validation[: args.eval_queries], test[: args.test_queries]  # pyright: ignore


def finish(run: Run, test: Queries, best_success: float, best_step: int, workers: int = 1) -> None:
    """End a run: test `policy.onnx`, write `result.json`, and print a line.

    The test is under the task's standard rules, whatever the training's were: 400 steps, contacts
    allowed. Without queries there is none.

    Args:
        run: the run.
        test: test queries.
        best_success, best_step: of the best evaluation on validation queries.
        workers: processes of the test.
    """
    from roboarm_nmp.evaluation.evaluate import evaluate  # slow to import, and not for --help

    run.close()
    policy = run.folder / "policy.onnx"
    result: dict[str, Any] = {"task": run.args.task, "goal_type": run.args.goal_type}
    text = "no test, --test-queries 0"
    if len(test):
        tested = evaluate(policy, run.args.task, queries=test, workers=workers, progress=True)
        names = (*RESULTS, "num_queries", "robot", "privileged", "deviations")
        result |= {name: tested[name] for name in names}
        text = (
            f"{len(test)} test queries{', privileged' if tested['privileged'] else ''}: success "
            f"{result['success_rate']:.3f}, collision-free success "
            f"{result['collision_free_success_rate']:.3f}"
        )
    result |= {
        "policy": str(policy),
        "policy_step": best_step,
        "validation_success_rate": best_success,
        "steps": run.step,
        "seconds": round(run.seconds),
    }
    run.write_result(result)
    print(
        f"{run.args.task}, goal {run.args.goal_type}, {text}; validation success "
        f"{best_success:.3f} at {best_step}; {run.step} steps in {run.seconds:.0f} s. "
        f"{run.folder / 'result.json'}"
    )
