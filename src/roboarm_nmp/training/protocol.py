"""The benchmark's protocol, for trainers of policies.

The policy of a run that is best on validation queries is saved as `policy.onnx`, and tested on test
queries at the end: `result.json`. (`evaluation.evaluate` takes more queries and returns more.)

Functions that take flags are for scripts: on a mistake of the user, they end the program with a
message.
"""

import collections
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

from roboarm_nmp import envs
from roboarm_nmp.datasets.episodes import DemoQueriesWrapper, load_demos_for
from roboarm_nmp.datasets.queries import Queries, load_queries
from roboarm_nmp.envs.arm_env import HORIZON, STANDARD_RULES, deviations
from roboarm_nmp.envs.subgoals import MAX_STEP
from roboarm_nmp.envs.tasks import task_name
from roboarm_nmp.evaluation.rollout import render_strip, rollouts
from roboarm_nmp.networks.export import read_weights, save_network
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.policies.registry import OUTPUTS, policy_file, policy_metadata, recurrent_size
from roboarm_nmp.training.collection import FinishedEpisode, TrainingEnvs
from roboarm_nmp.training.cuda_graphs import to_device
from roboarm_nmp.training.runs import Run, RunFlags, check_finite, errors_of, fail, script_name
from roboarm_nmp.utils.flags import CORES, Horizon, NonNegativeInt, PositiveFloat, PositiveInt
from roboarm_nmp.utils.progress import progress_bar

if TYPE_CHECKING:
    from roboarm_nmp.policies.safety_filter import SafetyFilter

NUM_ENVS = 8  # at most, that an evaluation runs together; the first of them renders
IMAGE_SIZE = (240, 180)
# The rules of every test. The step length, a rule too, may be the policy's own.
# Flags whose values `envs.make` may reject.
OBSERVED = ("encoder", "geometry_source", "link_distances")
RULES = [name for name in STANDARD_RULES if name != "max_step"]


@dataclass
class PolicyFlags(RunFlags):
    """The flags of every trainer of a policy: its run, task, updates and evaluations."""

    task: str = "no_obstacles"
    """task to train on, one of `roboarm_nmp.TASKS`, or a scene file (docs/customise/scene.md);
    with another arm TASK@FILE, a robot's file (docs/customise/robot.md)"""
    compile: bool = True
    """on a GPU, repeat updates as CUDA graphs, which is several times faster"""
    eval_queries: PositiveInt = 200
    """validation queries per evaluation"""
    test_queries: NonNegativeInt = 1_000
    """test queries for the best policy at the end (0: no test)"""


@dataclass
class EnvFlags:
    """The arguments of `envs.make` among a trainer's flags: the paper's MDP, and observations."""

    goal_type: Literal["ee", "config", "combined", "pose"] = "ee"
    """what the goal is: end-effector position, configuration, both, or end-effector pose"""
    action_mode: Literal["relative", "subgoal"] = "relative"
    """action: a displacement of the normalised configuration, or the next one itself"""
    max_step: PositiveFloat = MAX_STEP
    """longest displacement per step (L2, normalised configuration)"""
    horizon: Horizon = HORIZON
    """steps after which an episode is truncated"""
    stop_on_collision: bool = False
    """end an episode at the first contact"""
    velocities: bool = False
    """joint velocities in the observation"""
    encoder: str | None = None
    """the encoded scene, appended to the observation: an encoder's latent code (`vae`, `vqvae`,
    `pointnet2`, `field`, or the path of your own `encoder.onnx`, docs/guide/perception.md),
    `point_cloud` for observed points, or `oracle` for the ground-truth obstacles; by default
    nothing"""
    geometry_source: str | None = None
    """where link distances take the obstacles from: `ground_truth`, `point_cloud`, or an encoder
    with a decoder (`field`, or a path), which also gives the points of the encoder `point_cloud`"""
    link_distances: bool = False
    """append the signed distance of each link from the nearest obstacle of --geometry-source and
    its gradient to the observation"""


def env_arguments_of(args: EnvFlags) -> dict:
    """The `EnvFlags` in a trainer's flags as a dict, for `envs.make`."""
    arguments = {field.name: getattr(args, field.name) for field in fields(EnvFlags)}
    arguments["append_link_distances"] = args.link_distances
    return arguments


def load_task(args: PolicyFlags) -> tuple[Queries, Queries]:
    """The first validation queries and test queries, as many as the flags say, of `args.task`.

    Raises:
        SystemExit: unknown task, a task for testing only, or its query file cannot be used.
    """
    try:
        if not envs.get_task(args.task).trainable:
            fail(f"{args.task} is for testing only: nothing may be learned from it")
        validation = load_queries(args.task, "validation")
        test = load_queries(args.task, "test")
        return (
            _first(validation, "--eval-queries", args.eval_queries),
            _first(test, "--test-queries", args.test_queries),
        )
    except ValueError as error:
        fail(f"--task: {error}")


def copy_weights(policy: str, module: torch.nn.Module) -> None:
    """Give a module the weights of a policy of the same sizes, a name or path: `--initial-policy`.

    Ends the program with a message where that cannot be.
    """
    with errors_of("--initial-policy"):
        initial = read_weights(policy_file(policy))
        for name, weights in module.named_parameters():
            if name not in initial or initial[name].shape != weights.shape:
                raise ValueError(f"{policy}: the sizes of its layers or its goal type are others")
            weights.data.copy_(torch.from_numpy(initial[name]))


def _first(queries: Queries, flag: str, number: int) -> Queries:
    if number > len(queries):
        print(f"{flag} {number}: there are {len(queries)}, all of them are used", file=sys.stderr)
    return queries[:number]  # pyright: ignore[reportReturnType]


def make_envs(task: str, number: int, **kwargs) -> list:
    """A list of environments of a task; `kwargs` as for `envs.make`.

    Raises:
        SystemExit: an argument is rejected.
    """
    try:
        return [envs.make(task, **kwargs) for _ in range(number)]
    except ValueError as error:
        flags = [f"--{name.replace('_', '-')}" for name in OBSERVED if kwargs.get(name)]
        fail(f"{' or '.join(flags)}: {error}" if flags else error)


def make_eval_envs(task: str, num_queries: int, **kwargs) -> list:
    """The environments for evaluations on `num_queries` queries; arguments as for `make_envs`.

    At least two, which `PolicyRun.save_policy` needs.
    """
    number = max(min(num_queries, NUM_ENVS), 2)
    rendering = make_envs(task, 1, render_mode="rgb_array", render_size=IMAGE_SIZE, **kwargs)
    return rendering + make_envs(task, number - 1, **kwargs)


def make_training_envs(
    args,
    demo_prob: float | None = None,
    demos: Sequence[Path] = (),
    bc_weight: float = 0.0,
) -> TrainingEnvs:
    """`args.num_envs` environments, with random queries or those of demonstrations (`demo_prob`).

    Args:
        args: the flags: `EnvFlags`, `task`, `num_envs` and `device`.
        demo_prob: value of the flag --demo-prob, if the trainer has it.
        demos: value of the flag --demos, files; by default the task's own.
        bc_weight: value of the flag --bc-weight, which needs demonstrations.

    Returns:
        The `training.collection.TrainingEnvs`.

    Raises:
        SystemExit: an argument is rejected, or the demonstrations do not fit.
    """
    if demo_prob is None and (demos or bc_weight > 0):
        flag = "--demos" if demos else "--bc-weight"
        fail(f"{flag} goes with --demo-prob")
    made = make_envs(args.task, args.num_envs, **env_arguments_of(args))
    # A GPU waits for its environments; on a CPU they take less time than the updates.
    processes = min(args.num_envs, CORES) if torch.device(args.device).type == "cuda" else 0
    if demo_prob is not None:
        with errors_of("--demo-prob"):
            loaded = load_demos_for(made[0], demos, args.task)
        made = [DemoQueriesWrapper(env, loaded) for env in made]
    return TrainingEnvs(made, demo_prob, processes)


def stack(observations: list[dict], device: torch.device | str) -> dict[str, torch.Tensor]:
    """Observations -> float32 tensors (N, ...) by name."""
    return {
        name: to_device(np.stack([o[name] for o in observations]), device)
        for name in observations[0]
    }


def evaluate(
    policy: Callable,
    envs: list,
    queries: Queries | list,
    device: torch.device | str,
    safety_filter: "SafetyFilter | None" = None,
    seed: int = 0,
    description: str | None = None,
) -> dict[str, float]:
    """Run a deterministic policy on every query, each env one at a time; mean results.

    Args:
        policy: from `observation`, `achieved_goal`, `desired_goal` and what else is observed,
            tensors (N, ...), to actions (N, n); a module or a loaded network. A recurrent one
            (`policies.registry.recurrent_size`) also receives its state, and returns the next.
        envs: the environments to do it in.
        queries: `datasets.queries.Queries`, or a list of `Query`.
        device: of the policy.
        safety_filter: an `policies.safety_filter.SafetyFilter` around the policy, or None.
        seed: of the filter's escapes from local minima, >= 0.
        description: of a progress bar that disappears at the end; None for no bar.

    Returns:
        `success_rate`, `collision_free_success_rate`, `collision_rate`, and `episode_length` in
        steps.

    Raises:
        FloatingPointError: the policy's actions or its recurrent state are not finite.
    """
    trajectories = _rollouts(policy, envs, queries, device, safety_filter, seed)
    bar = progress_bar(
        trajectories,
        description or "",
        len(queries),
        "query",
        transient=True,
        disable=description is None,
    )
    results = [(trajectory.success, trajectory.collides, len(trajectory)) for trajectory in bar]
    success, collides, steps = np.array(results, dtype=np.float64).T
    return {
        "success_rate": float(success.mean()),
        "collision_free_success_rate": float((success * (1 - collides)).mean()),
        "collision_rate": float(collides.mean()),
        "episode_length": float(steps.mean()),
    }


class _NetworkPolicy:
    """The policy of one of the episodes whose actions one call of a network predicts.

    Attributes:
        recurrent_state: of the network, in this episode.
        prediction: the action (n,) for the current observation, and the recurrent state after it.
        act: from an observation to an action (n,), through the safety filter, if there is one.
    """

    def __init__(self, recurrent_size):
        self.recurrent_state = np.zeros(recurrent_size, np.float32)
        self.prediction: tuple = ()
        self.act = self.predicted

    def predicted(self, observation):
        # During an escape the filter does not call this: the recurrent state stays as it is.
        action, self.recurrent_state = self.prediction
        return action

    def __call__(self, observation):
        return self.act(observation)


def _rollouts(network, envs, queries, device, safety_filter, seed=0):
    """An iterator of the `Trajectory` of every query, in any order; arguments as for `evaluate`."""
    size = recurrent_size(network)

    def begin(env, number):
        policy = _NetworkPolicy(size)
        if safety_filter is not None:
            rng = np.random.default_rng([seed, number])
            policy.act = safety_filter.filter_policy(policy.predicted, env, rng)
        return policy

    @torch.no_grad()
    def predict(policies, observations):
        states = [policy.recurrent_state for policy in policies]
        if size:
            observations = [
                observation | {"recurrent_state": state}
                for observation, state in zip(observations, states, strict=True)
            ]
            actions, states = (x.cpu().numpy() for x in network(**stack(observations, device)))
            check_finite("the policy's recurrent state", states)
        else:
            actions = network(**stack(observations, device)).cpu().numpy()
        check_finite("the policy's actions", actions)
        for policy, action, state in zip(policies, actions, states, strict=True):
            policy.prediction = action, state

    return rollouts(envs, queries, begin, predict)


def rollout_image(policy, env, query, device, safety_filter=None, frames=8):
    """An image strip (height, frames * width, 3), uint8, of the policy on one query.

    `env`: one that renders.
    """
    [trajectory] = _rollouts(policy, [env], [query], device, safety_filter)
    steps = [*range(0, len(trajectory), 10), len(trajectory)]
    chosen = np.linspace(0, len(steps) - 1, frames).round().astype(int)
    return render_strip(env, query, trajectory.actions, [steps[i] for i in chosen])


class PolicyRun(Run):
    """A run that trains a policy, and validates, saves and tests it under the benchmark's protocol.

    Args:
        args: the flags, `task`, `goal_type` and `seed` among them.
        state: dict from names to the parts of the run, as for `runs.Run`.
        device: of the run.
        env_arguments: dict of `envs.make`'s arguments, which `policy.onnx` is evaluated with.
        eval_envs: of `make_eval_envs`, with these arguments.
        validation: validation queries.
        safety_filter: an `policies.safety_filter.SafetyFilter` that is part of the policy, or
            None.
    """

    args: PolicyFlags

    def __init__(
        self,
        args: PolicyFlags,
        state: dict,
        device: torch.device | str,
        env_arguments: dict,
        eval_envs: list,
        validation: Queries | list,
        safety_filter: "SafetyFilter | None" = None,
    ):
        super().__init__(args, task_name(args.task), state, device)
        self.env_arguments = env_arguments
        self.eval_envs = eval_envs
        self.validation = validation
        self.safety_filter = safety_filter
        self._recent = collections.deque(maxlen=100)  # outcomes of training episodes

    def log_episode(self, episode: FinishedEpisode, demos_injected: int | None = None) -> None:
        """Log an episode, and how many demonstrations were added so far (None: not logged)."""
        self._recent.append(episode.info["is_success"])
        values = {
            "charts/episodic_return": episode.episode_return,
            "charts/episodic_length": episode.info["elapsed_steps"],
            "charts/success": np.mean(self._recent),
        }
        if demos_injected is not None:
            values["charts/demos_injected"] = demos_injected
        self.log(values, self.step + episode.number + 1)  # every environment's step counts

    def validate(self, policy) -> bool:
        """Evaluate a policy on the validation queries, and log results and images of the first.

        With a safety filter, the policy is evaluated without it, too: `eval/..._without_filter`.

        Args:
            policy: as for `evaluate`.

        Returns:
            Whether this is the best policy of the run so far. False if a signal has interrupted
            the evaluation: the resumed run repeats it (`repeat_evaluation`).
        """
        queries, envs, device = self.validation, self.eval_envs, self.device
        safety_filter = self.safety_filter
        self._progress["unfinished_evaluation"] = True
        if self.interrupted:
            return False
        try:
            with self.interruptible():
                result = evaluate(
                    policy, envs, queries, device, safety_filter, description="validation"
                )
                self.log({f"eval/{name}": value for name, value in result.items()})
                if safety_filter is not None:
                    description = "validation without filter"
                    bare = evaluate(policy, envs, queries, device, description=description)
                    self.log({f"eval/{name}_without_filter": v for name, v in bare.items()})
                image = rollout_image(policy, envs[0], queries[0], device, safety_filter)
                self.log_image("eval/rollout", image)
        except KeyboardInterrupt:
            return False
        del self._progress["unfinished_evaluation"]
        is_best = self.is_best(result["success_rate"])
        success = f"{result['success_rate']:.3f}"
        self.show(**{"validation success": success, "best": f"{self.best_score:.3f}"})
        return is_best

    def repeat_evaluation(self, policy) -> None:
        """At the start of a resumed run: the evaluation that a signal ended, if there was one."""
        if "unfinished_evaluation" in self._progress:
            if self.validate(policy):
                self.save_policy(policy)
            self.checkpoint()

    def save_policy(self, policy: torch.nn.Module) -> None:
        """Write `policy.onnx` for `evaluate.py` and others.

        Args:
            policy: the module, `forward(observation, achieved_goal, desired_goal)`, and what else
                is observed; with a `recurrent_size`, its `recurrent_state`, too.
        """
        robot = self.eval_envs[0].unwrapped.robot
        metadata = policy_metadata(self.args.task, self.env_arguments, robot, self.safety_filter)
        metadata.update(script=script_name(), seed=self.args.seed, step=self.step)
        example = stack([env.reset(seed=0)[0] for env in self.eval_envs[:2]], self.device)
        if size := recurrent_size(policy):
            metadata["recurrent_size"] = size
            number = len(example["observation"])
            example["recurrent_state"] = torch.zeros(number, size, device=self.device)
        outputs = OUTPUTS if size else OUTPUTS[:1]
        save_network(self.folder / "policy.onnx", policy, example, metadata, outputs)

    def final_test(self, queries: Queries) -> None:
        """End the run: test `policy.onnx` on test queries, write `result.json`, and print a line.

        Always under the task's standard rules, the horizon of `RoboArmEnv` and contacts allowed,
        for comparable results. File and line contain the rules of the training, if they are others,
        the step length, if it is not the standard one (`deviations`), and whether the policy
        observes ground-truth obstacles (`privileged`). Without queries there is no test, and file
        and line have no results of one.
        """
        self.close()
        result, text = {}, "no test, --test-queries 0"
        if len(queries):
            result, text = self._test(queries)
        task, goal_type = self.args.task, self.env_arguments["goal_type"]
        result.update(
            task=task,
            robot=self.eval_envs[0].unwrapped.robot.name,
            goal_type=goal_type,
            num_queries=len(queries),
            policy=str(self.folder / "policy.onnx"),
            policy_step=self.best_step,
            validation_success_rate=self.best_score,
            steps=self.step,
            seconds=round(self.seconds),
        )
        self.write_result(result)
        print(
            f"{task}, goal {goal_type}, {text}; validation success {self.best_score:.3f} at "
            f"{self.best_step}; {self.step} steps in {self.seconds:.0f} s. "
            f"{self.folder / 'result.json'}"
        )

    def _test(self, queries: Queries) -> tuple[dict, str]:
        """The results of a test as a dict, and the most important ones in words."""
        # Here, because Numba takes a while to import, which --help would wait for.
        from roboarm_nmp.evaluation.evaluate import is_privileged
        from roboarm_nmp.policies.safety_filter import SafetyFilter

        policy = load_network(self.folder / "policy.onnx")
        arguments = {name: value for name, value in self.env_arguments.items() if name not in RULES}
        test_envs = make_eval_envs(self.args.task, len(queries), **arguments)
        safety_filter = SafetyFilter.from_metadata(policy.metadata)
        result: dict = evaluate(
            policy, test_envs, queries, self.device, safety_filter, description="test"
        )
        success, collision_free = result["success_rate"], result["collision_free_success_rate"]
        rules = {name: getattr(test_envs[0], name) for name in RULES}
        trained = {name: self.env_arguments.get(name, rules[name]) for name in RULES}
        result["rules"] = rules
        result["rules_in_training"] = trained
        result["deviations"] = deviations(arguments)
        result["privileged"] = is_privileged(arguments)
        if rules != trained:
            print(
                f"trained with {_words(trained)}; tested under the standard rules, {_words(rules)}:"
            )
        for name, value in result["deviations"].items():
            print(f"not comparable: {name} is {value}, not {STANDARD_RULES[name]}")
        privileged = ", privileged" if result["privileged"] else ""
        return result, (
            f"{len(queries)} test queries{privileged}: success {success:.3f}, collision-free "
            f"success {collision_free:.3f}"
        )


def _words(rules: dict) -> str:
    contacts = "ended by a contact" if rules["stop_on_collision"] else "contacts allowed"
    return f"{rules['horizon']} steps, {contacts}"
