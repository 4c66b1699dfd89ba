"""The flags of a training script, also of one that continues a run (`--resume`).

These functions are for scripts: on a mistake of the user, they end the program with a message.
"""

import contextlib
import importlib.util
import json
import typing
from collections.abc import Collection, Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import torch

from roboarm_nmp.envs.robots.files import ROBOT_FILES
from roboarm_nmp.training.devices import has_fast_bfloat16
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import check_folder
from roboarm_nmp.utils.signals import end_with_one_line, error_line

Flags = TypeVar("Flags")
MAY_CHANGE = {"resume", "runs_dir", "track"}  # they change no number


def parse_args(Args: type[Flags], may_change: Collection[str] = ()) -> Flags:
    """The flags of the command line; with --resume the run's, which must not be contradicted.

    A flag `bf16` that is None is decided: whether bfloat16 is faster on the device.

    Args:
        Args: the dataclass of the flags, `runs_dir`, `resume`, `device` and `track` among them.
        may_change: names of more flags that a resumed run may have at another value.

    Raises:
        SystemExit: bad flags, no such run, or other flags than the run's; no CUDA device, no wandb.
    """
    end_with_one_line("nothing was written")
    args: Any = flags.parse(Args)
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
        args.bf16 = args.device != "cpu" or has_fast_bfloat16()
    return args


def _args_of_run(Args, run: Path, may_change: set[str]):
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
    before = json.loads(to_json(asdict(defaults)))
    now = json.loads(to_json(asdict(args)))
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


def to_json(content: dict) -> str:
    """A dict as JSON; paths in it become strings."""
    return json.dumps(content, indent=2, default=str)


def fail(message: object) -> NoReturn:
    """End the program with a line that begins with its command: `roboarm train sac: …`."""
    raise SystemExit(error_line(message))


@contextlib.contextmanager
def errors_of(flag: str) -> Iterator[None]:
    """Inside, a ValueError ends the program with a line that names the flag, e.g. "--paths"."""
    try:
        yield
    except ValueError as error:
        fail(f"{flag}: {error}")
