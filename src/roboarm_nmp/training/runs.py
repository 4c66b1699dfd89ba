"""Run folders: checkpoints, TensorBoard, and how a stopped run continues.

    device = seed_torch(args)
    progress = {"best_error": math.inf}
    state = {"model": model, "optimizer": optimizer, "progress": progress}
    run = Run(args, "wall", state, device)     # with --resume, `state` is the checkpoint's
    run.start(args.total_updates, "update")
    while run.step < args.total_updates:
        loss = ...
        run.advance()
        run.log({"losses/loss": loss})
        if run.step % 1000 == 0 or run.interrupted:   # Ctrl-C or SIGTERM
            run.save()                                # an interrupted run ends here
    run.close()

When to evaluate, what is best and what is saved stand in the trainers.
"""

import errno
import functools
import json
import os
import signal
import sys
import threading
import time
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch.utils import deterministic

from roboarm_nmp.training.arguments import fail, to_json
from roboarm_nmp.utils.files import check_archive, clear_leftovers, new_contents, write_atomically
from roboarm_nmp.utils.progress import progress_bar
from roboarm_nmp.utils.signals import Terminated, exit_interrupted

SAME_INTERRUPT = 1.0  # s: `timeout` and `roboarm sweep` may both send a signal that one has sent
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)


def seed_torch(args: Any) -> torch.device:
    """Seed PyTorch with `args.seed` and make it deterministic. Returns `args.device`."""
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
        raise FloatingPointError(f"{name} are no longer finite: lower --learning-rate")


def script_name() -> str:
    """The name of the trainer's file without its ending: a part of the name of a run's folder."""
    return Path(sys.argv[0]).stem


class Run:
    """A training run: its folder, its progress, its checkpoints and what it logs.

    Args:
        args: the flags: `seed`, `runs_dir`, `resume`, `device`, `track` and others.
        name: the first part of the folder's name, e.g. the task.
        state: dict from names to the parts of a checkpoint: anything with `state_dict` and
            `load_state_dict` (modules, optimisers), a tensor, a dict of plain values, or a NumPy
            generator. With `args.resume` they are restored, each on its device.

    Attributes:
        folder: path of the run's folder, which is printed.
        step: number of steps (or updates) so far, those of earlier processes included.
        seconds: of training, likewise.
        interrupted: whether Ctrl-C or SIGTERM has arrived. The trainer then calls `save` at the end
            of the current step. A second signal, or one while `interruptible`, raises.

    Raises:
        SystemExit: the checkpoint is damaged, or has other parts.
    """

    def __init__(self, args: Any, name: str, state: dict):
        self.args = args
        self.folder = self._make_folder(name)
        print(f"run folder: {self.folder}", flush=True)
        self._counts = {"step": 0, "seconds": 0.0}
        self._state = {**state, "counts": self._counts}
        self._interrupt: KeyboardInterrupt | None = None
        self.interruptible = True
        self._began = time.monotonic()
        if args.resume is not None and (args.resume / "checkpoint.pt").exists():
            self._load()

    @property
    def step(self) -> int:
        return self._counts["step"]

    @property
    def seconds(self) -> float:
        return self._counts["seconds"] + time.monotonic() - self._began

    @property
    def interrupted(self) -> bool:
        return self._interrupt is not None

    def _make_folder(self, name):
        args = self.args
        run = args.resume
        if run is not None:
            clear_leftovers(run)
        else:
            first = run = (
                args.runs_dir / f"{name}__{script_name()}__{args.seed}__{int(time.time())}"
            )
            number = 1
            while run.exists():  # another run has begun in the same second
                number += 1
                run = first.with_name(f"{first.name}_{number}")
            run.mkdir(parents=True)
            flags = asdict(args) | {"begun_in": Path.cwd()}
            write_atomically(run / "args.json", to_json(flags).encode())
        sys.excepthook = functools.partial(_say_plainly, run)
        return run

    def start(self, total: int, unit: str) -> None:
        """Open TensorBoard's writer and a progress bar of `total` steps; `unit` names one."""
        if self.args.track:  # events go to Weights & Biases, too
            import wandb  # pyright: ignore[reportMissingImports]

            wandb.init(
                project="roboarm-nmp",
                name=self.folder.name,
                id=self.folder.name,  # so that a resumed run continues there, too
                dir=str(self.folder),
                config=json.loads(to_json(asdict(self.args))),
                resume="allow",
                sync_tensorboard=True,
            )
        from torch.utils.tensorboard import SummaryWriter  # slow to import, and not for --help

        # What an earlier process has logged after the checkpoint is hidden.
        self.writer = SummaryWriter(self.folder, purge_step=self.step + 1)
        rows = "\n".join(f"|{name}|{value}|" for name, value in asdict(self.args).items())
        self.writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}")
        self._unit = unit
        self._bar = progress_bar(None, "training", total, unit, initial=self.step, smoothing=0.05)
        self._began = time.monotonic()
        self.interruptible = False
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) is not signal.SIG_IGN:  # as in a shell's background
                    signal.signal(number, self._on_signal)

    def _on_signal(self, number, frame):
        """The first signal lets the current step finish. A later one ends the program at once."""
        interrupt = Terminated() if number == signal.SIGTERM else KeyboardInterrupt()
        now = time.monotonic()
        if not self.interrupted:
            self._interrupt = interrupt
            self._interrupted_at = now
        if self.interruptible or now - self._interrupted_at > SAME_INTERRUPT:
            raise interrupt

    def advance(self, number: int = 1) -> None:
        """Count `number` more steps."""
        self._counts["step"] += number
        self._bar.update(number)

    @property
    def rate(self) -> float:
        """Mean steps per second since `start`."""
        return (self._bar.n - self._bar.initial) / self._bar.format_dict["elapsed"]

    def log(self, values: dict, step: int | None = None) -> None:
        """Write a dict of numbers to TensorBoard; of a tensor its mean, of None nothing.

        `step`: of the training; by default the present one.
        """
        for name, value in values.items():
            if value is None:
                continue
            value = value.mean().item() if isinstance(value, torch.Tensor) else value
            self.writer.add_scalar(name, value, self.step if step is None else step)

    def log_image(self, name: str, image: np.ndarray) -> None:
        """Write an image, uint8 (height, width, 3), to TensorBoard."""
        self.writer.add_image(name, image, self.step, dataformats="HWC")

    def log_video(self, name: str, images: list[np.ndarray]) -> None:
        """Write images, uint8 (height, width, 3), as a GIF: to TensorBoard and to the folder."""
        from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore

        path = self.folder / f"{name.replace('/', '_')}_{self.step}.gif"
        first, *others = [Image.fromarray(image) for image in images]
        first.save(path, save_all=True, append_images=others, duration=100, loop=0)
        height, width, _ = images[0].shape
        gif = Summary.Image(
            height=height, width=width, colorspace=3, encoded_image_string=path.read_bytes()
        )
        summary = Summary(value=[Summary.Value(tag=name, image=gif)])
        self.writer._get_file_writer().add_summary(summary, self.step)

    def show(self, **values) -> None:
        """Show values at the end of the progress bar."""
        self._bar.set_postfix(values)  # in their order

    def save(self) -> None:
        """Write `checkpoint.pt`. If the run was interrupted, end it with a line.

        Raises:
            FloatingPointError: a module's parameters are not finite. The old checkpoint remains.
            SystemExit: the run was interrupted.
        """
        for name, part in self._state.items():
            if isinstance(part, torch.nn.Module):
                for parameter in part.parameters():
                    check_finite(f"the parameters of `{name}`", parameter)
        self._counts["seconds"] = self.seconds
        self._began = time.monotonic()
        state = {name: _state_of(part) for name, part in self._state.items()}
        state["torch_rng"] = torch.get_rng_state()
        if torch.device(self.args.device).type == "cuda":
            state["cuda_rng"] = torch.cuda.get_rng_state(self.args.device)
        try:
            with new_contents(self.folder / "checkpoint.pt") as temporary:
                torch.save(state, temporary)
        except RuntimeError as error:  # PyTorch's, for a full disk
            raise OSError(errno.ENOSPC, str(error).splitlines()[0], "checkpoint.pt") from error
        if self._interrupt is not None:
            self.close()
            where = f"checkpoint at {self._unit} {self.step:,}"
            exit_interrupted(self._interrupt, f"{where}; --resume {self.folder} continues there")

    def _load(self):
        path = self.folder / "checkpoint.pt"
        try:  # on the CPU first, where replay buffers belong
            check_archive(path)
            state = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # a damaged file leads to any of many
            fail(f"--resume: {path} is damaged: {error}")
        for name, part in self._state.items():
            try:
                _restore(part, state[name])
            except KeyError as error:
                fail(f"--resume: {path} is of another version: it has no {error.args[0]}")
            except RuntimeError:  # PyTorch's, which lists all weights
                fail(f"--resume: {path} is of another version: the layers of its {name} are others")
        torch.set_rng_state(state["torch_rng"])
        if "cuda_rng" in state:
            torch.cuda.set_rng_state(state["cuda_rng"], self.args.device)

    def write_result(self, result: dict) -> None:
        """Write `result.json`: a dict, the trainer's name (`script`), and the flags."""
        content = {**result, "script": script_name(), "args": asdict(self.args)}
        write_atomically(self.folder / "result.json", to_json(content).encode())

    def close(self) -> None:
        """Close progress bar and writer. From here on, a signal ends the program at once."""
        self.interruptible = True
        self._bar.close()
        self.writer.close()


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
    elif isinstance(error, (EOFError, ConnectionError)):
        text = "error: a process with environments has died"
    elif isinstance(error, BrokenProcessPool) or (
        isinstance(error, OSError) and error.errno in DISK_ERRORS
    ):
        text = f"error: {error}"
    elif isinstance(error, FloatingPointError):
        text = f"error: training has diverged: {error}; its files are in {run}"
        checkpoint = ""
    else:
        return sys.__excepthook__(kind, error, trace)
    print("\n".join(filter(None, ["", text, checkpoint])), file=sys.stderr)
