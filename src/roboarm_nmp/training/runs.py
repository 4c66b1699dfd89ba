"""Run folders: checkpoints, TensorBoard, and how a stopped run continues.

    progress = {"best_error": math.inf}
    state = {"model": model, "optimizer": optimizer, "progress": progress}
    run = Run(args, "wall", state)     # with --resume, `state` is the checkpoint's
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

import functools
import json
import signal
import sys
import threading
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from roboarm_nmp.training.arguments import to_json
from roboarm_nmp.training.checkpoints import load_checkpoint, save_checkpoint
from roboarm_nmp.training.errors import say_plainly
from roboarm_nmp.utils.files import clear_leftovers, write_atomically
from roboarm_nmp.utils.progress import progress_bar
from roboarm_nmp.utils.signals import Terminated, exit_interrupted

SAME_INTERRUPT = 1.0  # s: `timeout` and `roboarm sweep` may both send a signal that one has sent


def script_name() -> str:
    """The name of the trainer's file without its ending: a part of the name of a run's folder."""
    return Path(sys.argv[0]).stem


class Run:
    """A training run: its folder, its progress, its checkpoints and what it logs.

    Args:
        args: the flags: `seed`, `runs_dir`, `resume`, `device`, `track` and others.
        name: the first part of the folder's name, e.g. the task.
        state: dict from names to the parts of a checkpoint, as of `checkpoints.save_checkpoint`.
            With `args.resume` they are restored.

    Attributes:
        folder: path of the run's folder, which is printed.
        step: number of steps (or updates) so far, those of earlier processes included.
        seconds: of training, likewise.
        interrupted: the Ctrl-C or SIGTERM that has arrived, or None. The trainer then calls `save`
            at the end of the current step. A second signal, or one while `interruptible`, raises.

    Raises:
        SystemExit: the checkpoint is damaged, or has other parts.
    """

    def __init__(self, args: Any, name: str, state: dict):
        self.args = args
        self.folder = self._make_folder(name)
        print(f"run folder: {self.folder}", flush=True)
        self._counts = {"step": 0, "seconds": 0.0}  # as of the last checkpoint
        self._state = {**state, "counts": self._counts}
        self.interrupted: KeyboardInterrupt | None = None
        self.interruptible = True
        self._began = time.monotonic()
        self._checkpoint = self.folder / "checkpoint.pt"
        if args.resume is not None and self._checkpoint.exists():
            load_checkpoint(self._checkpoint, self._state, args.device)
        self.step = self._counts["step"]

    @property
    def seconds(self) -> float:
        return self._counts["seconds"] + time.monotonic() - self._began

    def _make_folder(self, name):
        args = self.args
        run = args.resume
        if run is not None:
            clear_leftovers(run)
        else:
            name = f"{name}__{script_name()}__{args.seed}__{int(time.time())}"
            run = args.runs_dir / name
            number = 1
            while run.exists():  # another run has begun in the same second
                number += 1
                run = args.runs_dir / f"{name}_{number}"
            run.mkdir(parents=True)
            flags = asdict(args) | {"begun_in": Path.cwd()}
            write_atomically(run / "args.json", to_json(flags).encode())
        sys.excepthook = functools.partial(say_plainly, run)
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
        if self.interrupted is None:
            self.interrupted = interrupt
            self._interrupted_at = now
        if self.interruptible or now - self._interrupted_at > SAME_INTERRUPT:
            raise interrupt

    def advance(self, number: int = 1) -> None:
        """Count `number` more steps."""
        self.step += number
        self._bar.update(number)

    @property
    def rate(self) -> float:
        """Mean steps per second since `start`."""
        return (self._bar.n - self._bar.initial) / self._bar.format_dict["elapsed"]

    def log(self, values: dict) -> None:
        """Write a dict of numbers to TensorBoard; of a tensor its mean, of None nothing."""
        for name, value in values.items():
            value = value.mean() if isinstance(value, torch.Tensor) else value
            if value is not None:
                self.writer.add_scalar(name, value, self.step)

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
        self._counts.update(step=self.step, seconds=self.seconds)
        self._began = time.monotonic()
        save_checkpoint(self._checkpoint, self._state, self.args.device)
        if self.interrupted is not None:
            self.close()
            where = f"checkpoint at {self._unit} {self.step:,}"
            exit_interrupted(self.interrupted, f"{where}; --resume {self.folder} continues there")

    def write_result(self, result: dict) -> None:
        """Write `result.json`: a dict, the trainer's name (`script`), and the flags."""
        result = {**result, "script": script_name(), "args": asdict(self.args)}
        write_atomically(self.folder / "result.json", to_json(result).encode())

    def close(self) -> None:
        """Close progress bar and writer. From here on, a signal ends the program at once."""
        self.interruptible = True
        self._bar.close()
        self.writer.close()
