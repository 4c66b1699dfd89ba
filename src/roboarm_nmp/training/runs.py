"""Run folders: flags, checkpoints, TensorBoard, and how a stopped run continues.

    args = parse_args(Args, may_change={"total_updates"})   # with --resume, those of the run
    device = seed_torch(args)
    model, optimizer = ...
    run = Run(args, "wall", {"model": model, "optimizer": optimizer}, device)
    run.start(args.total_updates, "update")
    while run.step < args.total_updates:
        loss = ...
        step = run.advance()
        if step % 100 == 0:
            run.log({"losses/loss": loss, "charts/SPS": run.rate})
        evaluating = step % args.eval_every == 0 or step == args.total_updates
        if evaluating:
            error = ...
            if run.is_best(-error):
                save_network(run.folder / "encoder.onnx", model, ...)
        if evaluating or run.interrupted:   # Ctrl-C or SIGTERM
            run.checkpoint()                # an interrupted run ends here
    run.close()

Every trainer uses these. Its `Args` is a dataclass that adds to `RunFlags`.
A trainer of a policy uses `training.protocol.PolicyRun`. These functions are for scripts:
on a mistake of the user, they end the program with a message.
"""

import contextlib
import errno
import functools
import importlib.util
import json
import math
import os
import signal
import sys
import threading
import time
import typing
from collections.abc import Collection, Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import NoReturn, TypeVar

import numpy as np
import torch
from torch.utils import deterministic

from roboarm_nmp.envs.robots.files import ROBOT_FILES
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import (
    check_archive,
    check_folder,
    clear_leftovers,
    new_contents,
    write_atomically,
)
from roboarm_nmp.utils.flags import Seed
from roboarm_nmp.utils.progress import progress_bar
from roboarm_nmp.utils.signals import Terminated, end_with_one_line, error_line, exit_interrupted


@dataclass
class RunFlags:
    """The flags of every trainer's run."""

    seed: Seed = 1
    """seed of all random numbers; runs with the same seed, machine and device are identical"""
    runs_dir: Path = Path("runs")
    """parent of the run's folder, which has TensorBoard events, the checkpoint, the best network
    (`policy.onnx` or `encoder.onnx`) and result.json"""
    resume: Path | None = None
    """continue the run in this folder from its last checkpoint, with its flags"""
    device: str = "cpu"
    """`cpu`, `cuda` or one of several, `cuda:1`"""
    track: bool = False
    """log to Weights & Biases as well as to TensorBoard (`pip install wandb`)"""


Flags = TypeVar("Flags", bound=RunFlags)
MAY_CHANGE = {"resume", "runs_dir", "track"}  # they change no number
SAME_INTERRUPT = 1.0  # s: `timeout` and `roboarm sweep` may both send a signal that one has sent
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)


def parse_args(Args: type[Flags], may_change: Collection[str] = ()) -> Flags:
    """The flags of the command line; with --resume the run's, which must not be contradicted.

    A flag `bf16` that is None is decided: whether the hardware has bfloat16.

    Args:
        Args: the dataclass of the flags.
        may_change: names of more flags that a resumed run may have at another value.

    Raises:
        SystemExit: bad flags, no such run, or other flags than the run's; no CUDA device, no wandb.
    """
    end_with_one_line("nothing was written")
    args = flags.parse(Args)
    try:
        flags.check(args)
        if args.resume is not None:
            args = _args_of_run(Args, args.resume, MAY_CHANGE | set(may_change))
            flags.check(args)
    except ValueError as error:
        fail(error)
    if args.resume is None:
        with errors_of("--runs-dir"):
            check_folder(args.runs_dir)
    try:
        device = torch.device(args.device)
    except RuntimeError:
        fail(f"--device must be `cpu` or `cuda`, got {args.device!r}")
    if device.type == "cuda":
        number = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (device.index or 0) >= number:
            fail(f"--device {args.device}: PyTorch sees {number or 'no'} CUDA device(s) here")
    if args.track and importlib.util.find_spec("wandb") is None:
        fail("--track: wandb is not installed (pip install wandb)")
    if getattr(args, "bf16", False) is None:  # args.json has the choice: resuming keeps it
        supported = args.device != "cpu" or torch.cpu._is_avx512_bf16_supported()
        args.bf16 = supported  # pyright: ignore[reportAttributeAccessIssue]
    return args


def _args_of_run(Args: type[Flags], run: Path, may_change: set[str]) -> Flags:
    """The flags of a run and of the command line, which may change some of them."""
    if not (run / "args.json").exists():
        fail(f"--resume: {run} is no run's folder (it has no args.json)")
    saved = json.loads((run / "args.json").read_text())
    kinds = typing.get_type_hints(Args)
    known = [field.name for field in fields(Args) if field.name in saved]
    begun_in = Path(saved.get("begun_in", "."))
    values: dict = {name: _from_json(saved[name], kinds[name], begun_in) for name in known}
    defaults = Args(**values)
    defaults.resume = run
    args = flags.parse(Args, default=defaults)
    before = json.loads(_to_json(asdict(defaults)))
    now = json.loads(_to_json(asdict(args)))
    contradicted = [
        f"--{name.replace('_', '-')} is {now[name]!r} now, the run had {before[name]!r}"
        for name in now
        if name not in may_change and now[name] != before[name]
    ]
    if contradicted:
        fail("--resume: the run has another configuration: " + "; ".join(contradicted))
    return args


def _from_json(value, kind, begun_in: Path):
    """A flag's value as the dataclass has it: JSON has neither tuples nor paths.

    A file that does not exist from here is the one from the folder where the run began.
    """
    if isinstance(value, list):
        return tuple(_from_json(item, kind, begun_in) for item in value)
    if not isinstance(value, str):
        return value
    if Path in (kind, *typing.get_args(kind)):
        return Path(_from_here(value, begun_in))
    files = [
        _from_here(part, begun_in) if part.lower().endswith(ROBOT_FILES) else part
        for part in value.split("@")  # TASK@ROBOT
    ]
    return "@".join(files)


def _from_here(value: str, begun_in: Path) -> str:
    file = begun_in / value
    return str(file) if file.exists() and not Path(value).exists() else value


def _to_json(content: dict) -> str:
    return json.dumps(content, indent=2, default=str)


def write_json(path: Path, content: dict) -> None:
    """Write a file with a dict, atomically; paths in it become strings."""
    write_atomically(path, _to_json(content).encode())


def fail(message: object) -> NoReturn:
    """End the program with a line that begins with its command: `roboarm train sac: …`."""
    sys.exit(error_line(message))


@contextlib.contextmanager
def errors_of(flag: str) -> Iterator[None]:
    """Inside, a ValueError ends the program with a line that names the flag, e.g. "--paths"."""
    try:
        yield
    except ValueError as error:
        fail(f"{flag}: {error}")


def script_name() -> str:
    """The name of the trainer's file without its ending: a part of the name of a run's folder."""
    return Path(sys.argv[0]).stem


def run_folder(args: RunFlags, task: str) -> Path:
    """The run's folder: that of --resume, otherwise a new one, with the flags in `args.json`.

    Args:
        args: the flags.
        task: the first part of the folder's name.
    """
    if args.resume is not None:
        clear_leftovers(args.resume)
        sys.excepthook = functools.partial(_say_plainly, args.resume)
        return args.resume
    first = run = args.runs_dir / f"{task}__{script_name()}__{args.seed}__{int(time.time())}"
    number = 1
    while run.exists():  # another run has begun in the same second
        number += 1
        run = first.with_name(f"{first.name}_{number}")
    run.mkdir(parents=True)
    write_json(run / "args.json", asdict(args) | {"begun_in": Path.cwd()})
    sys.excepthook = functools.partial(_say_plainly, run)
    return run


def _say_plainly(run: Path, kind, error, trace) -> None:
    """Python's `excepthook`: one or two lines for errors that are no mistake of the program."""
    checkpoint = ""
    if (run / "checkpoint.pt").exists():
        checkpoint = f"--resume {run} continues from the last checkpoint"
    if isinstance(error, KeyboardInterrupt):
        print(file=sys.stderr)  # ends the line of a progress bar
        exit_interrupted(error, checkpoint or f"no checkpoint yet; --resume {run} starts again")
    if isinstance(error, MemoryError) or "allocate" in str(error):  # PyTorch's, a RuntimeError
        text = f"error: out of memory {str(error).partition(chr(10))[0]}".rstrip()
    elif isinstance(error, BrokenProcessPool) or (
        isinstance(error, OSError) and error.errno in DISK_ERRORS
    ):
        text = f"error: {error}"
    elif isinstance(error, FloatingPointError):
        text, checkpoint = f"error: training has diverged: {error}; its files are in {run}", ""
    else:
        return sys.__excepthook__(kind, error, trace)
    print("\n".join(filter(None, ["", text, checkpoint])), file=sys.stderr)


def seed_torch(args: RunFlags) -> torch.device:
    """Seed PyTorch and make it deterministic. Returns the device."""
    if "OMP_NUM_THREADS" not in os.environ:  # one thread is fastest for small networks
        torch.set_num_threads(1)
    torch.manual_seed(args.seed)
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # or cuBLAS is not deterministic
    torch.use_deterministic_algorithms(True)
    # Otherwise, deterministic mode also fills every new tensor with NaN, a check that costs time.
    deterministic.fill_uninitialized_memory = False  # pyright: ignore[reportAttributeAccessIssue]
    return torch.device(args.device)


def check_finite(name: str, values: torch.Tensor | np.ndarray) -> None:
    """Raise FloatingPointError, which ends a run with a line, if training has diverged.

    Args:
        name: of the values, a plural, for the message.
        values: tensor or array.
    """
    if not torch.as_tensor(values).isfinite().all():
        raise FloatingPointError(f"{name} are no longer finite")


def save_checkpoint(run: Path, parts: dict, device: torch.device | str) -> None:
    """Write `checkpoint.pt`: the states of the run's parts, and of torch's random numbers.

    Args:
        run: the run's folder.
        parts: dict from names to the parts: anything with `state_dict` and `load_state_dict`
            (modules, optimisers), a tensor, a dict of plain values, or a NumPy generator.
        device: of the run. For a GPU, its random numbers are saved, too.

    Raises:
        FloatingPointError: a module's parameters are not finite. The old checkpoint remains.
    """
    for name, part in parts.items():
        if isinstance(part, torch.nn.Module):
            for parameter in part.parameters():
                check_finite(f"the parameters of `{name}`", parameter)
    state = {name: _state_of(part) for name, part in parts.items()}
    state["torch_rng"] = torch.get_rng_state()
    if torch.device(device).type == "cuda":
        state["cuda_rng"] = torch.cuda.get_rng_state(device)
    try:
        with new_contents(run / "checkpoint.pt") as temporary:
            torch.save(state, temporary)
    except RuntimeError as error:  # PyTorch's, for a full disk
        raise OSError(errno.ENOSPC, str(error).splitlines()[0], "checkpoint.pt") from error


def load_checkpoint(args: RunFlags, parts: dict) -> None:
    """Restore the parts from the checkpoint of --resume, if there is one.

    Args:
        args: the flags.
        parts: as for `save_checkpoint`, with the same names. They stay on their devices.

    Raises:
        SystemExit: the checkpoint is damaged, or has other parts.
    """
    if args.resume is None or not (args.resume / "checkpoint.pt").exists():
        return
    path = args.resume / "checkpoint.pt"
    try:  # on the CPU first, where replay buffers belong
        check_archive(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file leads to any of many
        fail(f"--resume: {path} is damaged: {error}")
    for name, part in parts.items():
        try:
            _restore(part, state[name])
        except KeyError as error:
            fail(f"--resume: {path} is of another version: it has no {error.args[0]}")
        except RuntimeError:  # PyTorch's, which lists all weights
            fail(f"--resume: {path} is of another version: the layers of its {name} are others")
    torch.set_rng_state(state["torch_rng"])
    if "cuda_rng" in state:
        torch.cuda.set_rng_state(state["cuda_rng"], args.device)


def _state_of(part):
    if isinstance(part, np.random.Generator):
        return json.dumps(part.bit_generator.state)  # its integers are too large for torch.save
    if isinstance(part, torch.Tensor):
        return part.detach()
    return part if isinstance(part, dict) else part.state_dict()


def _restore(part, state) -> None:
    if isinstance(part, np.random.Generator):
        part.bit_generator.state = json.loads(state)
    elif isinstance(part, torch.Tensor):
        part.data.copy_(state)
    elif isinstance(part, dict):
        if missing := part.keys() - state.keys():
            raise KeyError(min(missing))
        part.update(state)
    else:
        part.load_state_dict(state)
        for group in getattr(part, "param_groups", ()):
            if isinstance(group["lr"], torch.Tensor):  # of `training.cuda_graphs.adam`
                group["lr"] = group["lr"].to(group["params"][0].device)


def summary_writer(run: Path, args: RunFlags, step: int):
    """TensorBoard's writer for a run that is at `step`, with a table of the flags.

    Events after `step`, from an earlier process, are hidden. With `args.track`, events go to
    Weights & Biases, too.
    """
    if args.track:
        import wandb  # pyright: ignore[reportMissingImports]

        wandb.init(
            project="roboarm-nmp",
            name=run.name,
            id=run.name,  # so that a resumed run continues there, too
            dir=str(run),
            config=json.loads(_to_json(asdict(args))),
            resume="allow",
            sync_tensorboard=True,
        )
    from torch.utils.tensorboard import SummaryWriter  # slow to import, and not for --help

    writer = SummaryWriter(run, purge_step=step + 1)
    rows = "\n".join(f"|{name}|{value}|" for name, value in asdict(args).items())
    writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}")
    return writer


class Run:
    """A training run: its folder, its progress, its checkpoints and what it logs.

    Attributes:
        folder: path of the run's folder.
        device: of the run.
        step: number of steps (or updates) so far, those of earlier processes included.
        seconds: of training up to the last checkpoint, likewise.
        best_step, best_score: of the best evaluation so far; 0 and -inf before the first.
        best_result: dict of that evaluation's other results.
        interrupted: whether Ctrl-C or SIGTERM has arrived. The trainer then calls `checkpoint` at
            the end of the current step.
    """

    def __init__(self, args: RunFlags, name: str, state: dict, device: torch.device | str):
        """Make and print the run's folder. With --resume, restore `state` from its checkpoint.

        Args:
            args: the flags.
            name: the first part of the folder's name, e.g. the task.
            state: dict from names to the parts of the run, as for `save_checkpoint`.
            device: of the run.
        """
        self.args = args
        self.device = device
        self.folder = run_folder(args, name)
        print(f"run folder: {self.folder}", flush=True)
        self._progress: dict = {
            "step": 0,
            "seconds": 0.0,
            "best_step": 0,
            "best_score": -math.inf,
            "best_result": {},
        }
        self._state = {**state, "progress": self._progress}
        load_checkpoint(args, self._state)
        self._interrupt: KeyboardInterrupt | None = None
        self._may_raise = True

    @property
    def step(self) -> int:
        return self._progress["step"]

    @property
    def seconds(self) -> float:
        return self._progress["seconds"]

    @property
    def best_step(self) -> int:
        return self._progress["best_step"]

    @property
    def best_score(self) -> float:
        return self._progress["best_score"]

    @property
    def best_result(self) -> dict:
        return self._progress["best_result"]

    @property
    def interrupted(self) -> bool:
        return self._interrupt is not None

    def start(self, total: int, unit: str) -> None:
        """Open TensorBoard's writer and a progress bar of `total` steps; `unit` names one."""
        self.writer = summary_writer(self.folder, self.args, self.step)
        self._seconds_before = self.seconds
        self._unit = unit
        self._bar = progress_bar(None, "training", total, unit, initial=self.step, smoothing=0.05)
        self._may_raise = False
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) is not signal.SIG_IGN:  # as in a shell's background
                    signal.signal(number, self._on_signal)

    def _on_signal(self, number, frame):
        """The first signal lets the current step finish. A later one ends the program at once."""
        interrupt = Terminated() if number == signal.SIGTERM else KeyboardInterrupt()
        now = time.monotonic()
        if not self.interrupted:
            self._interrupt, self._interrupted_at = interrupt, now
        if self._may_raise or now - self._interrupted_at > SAME_INTERRUPT:
            raise interrupt

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """Inside, the first signal raises KeyboardInterrupt at once."""
        before = self._may_raise
        self._may_raise = True
        try:
            yield
        finally:
            self._may_raise = before

    def advance(self, number: int = 1) -> int:
        """Count `number` more steps; returns `step`."""
        self._progress["step"] += number
        self._bar.update(number)
        return self.step

    @property
    def rate(self) -> float:
        """Mean steps per second since `start`."""
        return (self._bar.n - self._bar.initial) / self._bar.format_dict["elapsed"]

    def log(self, values: dict, step: int | None = None) -> None:
        """Write a dict of numbers to TensorBoard. Of a tensor, its mean is written.

        `step`: of the training; by default the present one.
        """
        for name, value in values.items():
            value = value.mean().item() if isinstance(value, torch.Tensor) else value
            self.writer.add_scalar(name, value, self.step if step is None else step)

    def log_image(self, name: str, image: np.ndarray) -> None:
        """Write an image, uint8 (height, width, 3), to TensorBoard."""
        self.writer.add_image(name, image, self.step, dataformats="HWC")

    def show(self, **values) -> None:
        """Show values at the end of the progress bar."""
        self._bar.set_postfix(values)  # in their order

    def reached(self, score: float | None) -> bool:
        """Whether the best evaluation so far has this score; False for None."""
        return score is not None and self.best_score >= score

    def is_best(self, score: float, result: dict | None = None) -> bool:
        """Note an evaluation. Returns whether no earlier one had a higher score.

        Args:
            score: number; higher is better.
            result: dict of other numbers, kept as `best_result`.
        """
        if not score >= self.best_score:
            return False
        self._progress.update(best_step=self.step, best_score=score, best_result=result or {})
        return True

    def checkpoint(self) -> None:
        """Write `checkpoint.pt`. If the run was interrupted, end it with a line.

        Raises:
            FloatingPointError: as `save_checkpoint`.
            SystemExit: the run was interrupted.
        """
        self._progress["seconds"] = self._seconds_before + self._bar.format_dict["elapsed"]
        save_checkpoint(self.folder, self._state, self.device)
        if self._interrupt is not None:
            self.close()
            where = f"checkpoint at {self._unit} {self.step:,}"
            exit_interrupted(self._interrupt, f"{where}; --resume {self.folder} continues there")

    def write_result(self, result: dict) -> None:
        """Write `result.json`: a dict, the trainer's name (`script`), and the flags."""
        content = {**result, "script": script_name(), "args": asdict(self.args)}
        write_json(self.folder / "result.json", content)

    def close(self) -> None:
        """Close progress bar and writer. From here on, a signal ends the program at once."""
        self._may_raise = True
        self._bar.close()
        self.writer.close()
