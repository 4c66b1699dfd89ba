"""training/arguments.py and runs.py: flags, checkpoints, logs, signals."""

import json
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from roboarm_nmp.training import runs
from roboarm_nmp.training.arguments import parse_args
from roboarm_nmp.training.devices import has_fast_bfloat16, seed_torch
from roboarm_nmp.utils import flags
from roboarm_nmp.utils.files import new_contents


@dataclass
class Args:
    seed: flags.Seed = 1
    runs_dir: Path = Path("runs")
    resume: Path | None = None
    device: str = "cpu"
    track: bool = False
    data: Path | None = None
    files: tuple[Path, ...] = ()
    radii: tuple[float, float] = (0.1, 0.2)
    name: str | None = None
    steps: int = 10
    size: ClassVar[int] = 0


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    """What a run sets for its process."""
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture
def parse(monkeypatch):
    def parse(*flags, kind=Args):
        monkeypatch.setattr("sys.argv", ["trainer.py", *map(str, flags)])
        return parse_args(kind, may_change={"steps", "data"})

    return parse


def folder_of(args, name="wall"):
    """The folder of a new or a resumed run."""
    return runs.Run(args, name, {}).folder


def test_flags_are_restored_by_resume(parse, tmp_path):
    flags = ["--runs-dir", tmp_path, "--data", "a.h5", "--files", "b.h5", "c.h5", "--name", "x"]
    args = parse(*flags, "--radii", "0.3", "0.5")
    run = folder_of(args)
    assert run.parent == tmp_path and run.name.startswith("wall__trainer__1__")
    again = parse("--resume", run)
    assert again.resume == run == folder_of(again)
    args.resume = run
    assert again == args
    assert isinstance(again.data, Path) and all(isinstance(file, Path) for file in again.files)
    changed = parse("--resume", run, "--steps", "20", "--data", "d.h5")
    assert (changed.steps, changed.data) == (20, Path("d.h5"))


def test_resuming_with_another_flag_is_rejected(parse, tmp_path):
    run = folder_of(parse("--runs-dir", tmp_path))
    with pytest.raises(SystemExit, match="--seed is 2 now, the run had 1; --name is 'z'"):
        parse("--resume", run, "--seed", "2", "--name", "z")


def test_run_without_a_newer_flag_resumes_with_its_default(parse, tmp_path):
    run = folder_of(parse("--runs-dir", tmp_path))
    saved = json.loads((run / "args.json").read_text())
    del saved["radii"]
    (run / "args.json").write_text(json.dumps(saved | {"a_flag_that_was": 3}))
    assert parse("--resume", run).radii == (0.1, 0.2)
    with pytest.raises(SystemExit, match="--radii"):
        parse("--resume", run, "--radii", "0.3", "0.4")


def test_runs_of_the_same_second_have_their_own_folders(parse, tmp_path, monkeypatch):
    monkeypatch.setattr("time.time", lambda: 1_795_000_000.0)
    names = [folder_of(parse("--runs-dir", tmp_path)).name for _ in range(3)]
    first = "wall__trainer__1__1795000000"
    assert names == [first, f"{first}_2", f"{first}_3"]


def test_missing_run_or_gpu_is_rejected(parse, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match="is no run's folder"):
        parse("--resume", tmp_path)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(SystemExit, match="PyTorch sees no CUDA device"):
        parse("--device", "cuda")
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    assert parse("--device", "cuda:1").device == "cuda:1"
    with pytest.raises(SystemExit, match=r"--device cuda:2: PyTorch sees 2 CUDA device\(s\) here"):
        parse("--device", "cuda:2")


def test_resumed_run_keeps_its_choice_of_bfloat16(parse, tmp_path, monkeypatch):
    @dataclass
    class WithBf16(Args):
        bf16: bool | None = None

    def begin(supported, *flags):
        monkeypatch.setattr("roboarm_nmp.training.arguments.has_fast_bfloat16", lambda: supported)
        args = parse(*flags, kind=WithBf16)
        return args.bf16, folder_of(args)

    for number, supported in enumerate((False, True)):
        bf16, run = begin(supported, "--runs-dir", tmp_path / str(number))
        assert bf16 is supported
        assert json.loads((run / "args.json").read_text())["bf16"] is supported
        assert begin(not supported, "--resume", run)[0] is supported
    assert begin(False, "--runs-dir", tmp_path, "--bf16", "True")[0] is True


@pytest.mark.parametrize(
    "cpu, avx512_bf16, amx, fast",
    [
        ("znver4", True, False, True),
        ("znver3", False, False, False),
        ("sapphirerapids", True, False, False),  # in a virtual machine without AMX
        ("sapphirerapids", True, True, True),
    ],
)
def test_bfloat16_is_chosen_where_it_is_faster(cpu, avx512_bf16, amx, fast, monkeypatch):
    monkeypatch.setattr("llvmlite.binding.get_host_cpu_name", lambda: cpu)
    monkeypatch.setattr("torch.cpu._is_avx512_bf16_supported", lambda: avx512_bf16)
    monkeypatch.setattr("torch.cpu._is_amx_tile_supported", lambda: amx)
    assert has_fast_bfloat16() is fast


def parts():
    model = torch.nn.Linear(3, 2)
    return {
        "model": model,
        "optimizer": torch.optim.Adam(model.parameters(), lr=0.1, fused=True),
        "alpha": torch.zeros(1, requires_grad=True),
        "rng": np.random.default_rng(0),
        "counts_of_mine": {"updates": 0, "best": {}},
    }


def learn(parts):
    """Steps that use every part; what came out."""
    inputs = torch.randn(4, 3) * float(parts["rng"].random()) + parts["alpha"]
    loss = parts["model"](inputs).square().sum()
    parts["optimizer"].zero_grad()
    loss.backward()
    parts["optimizer"].step()
    with torch.no_grad():
        parts["alpha"] += 1
    parts["counts_of_mine"]["updates"] += 1
    parts["counts_of_mine"]["best"] = {"loss": loss.item()}
    return loss.item()


def begin(parse, tmp_path, *flags):
    """A `Run` and its parts."""
    changing = parts()
    return runs.Run(parse("--runs-dir", tmp_path, *flags), "wall", changing), changing


def test_run_continues_with_every_part_its_step_and_its_time(parse, tmp_path):
    run, before = begin(parse, tmp_path)
    run.start(10, "update")
    assert run.step == 0 and not run.interrupted
    seed_torch(run.args)
    learn(before)
    run.advance(3)
    run.advance()
    run._began -= 100.0  # as if that had taken so long
    run.save()
    run.close()
    expected = [learn(before) for _ in range(3)]

    resumed, after = begin(parse, tmp_path, "--resume", run.folder)
    assert resumed.folder == run.folder and resumed.step == 4 and 100 <= resumed.seconds < 110
    assert after["counts_of_mine"]["updates"] == 1 and after["alpha"].requires_grad
    assert [learn(after) for _ in range(3)] == expected
    resumed.start(10, "update")
    resumed.advance()
    resumed.save()
    resumed.close()
    assert 100 < resumed.seconds < 115 and resumed.step == 5
    for newer, name in (
        ({"critic": torch.nn.Linear(1, 1)}, "critic"),
        ({"counts_of_mine": {"updates": 0, "best_step": 0}}, "counts_of_mine"),
        ({"model": torch.nn.Linear(4, 2)}, "model"),
    ):
        with pytest.raises(SystemExit, match=f"version of the trainer: its {name} differs$"):
            runs.Run(resumed.args, "wall", after | newer)


def test_parameters_that_are_not_finite_are_not_saved(parse, tmp_path):
    run, changing = begin(parse, tmp_path)
    changing["model"].weight.data[0, 0] = np.nan
    with pytest.raises(FloatingPointError, match="the parameters of `model` are no longer finite"):
        run.save()
    assert not (run.folder / "checkpoint.pt").exists()


@pytest.mark.parametrize("prefix", ["", "boxes@"])  # a file, and a task with a robot's file
def test_files_are_found_from_another_working_directory(parse, tmp_path, monkeypatch, prefix):
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for name in ("a.h5", "mine.yaml"):
        Path(name).touch()
    flags = ["--data", "a.h5", "--files", "missing.h5", "--runs-dir", "runs"]
    flags += ["--name", f"{prefix}mine.yaml"]
    run = folder_of(parse(*flags), "mine").absolute()
    assert parse("--resume", run).name == f"{prefix}mine.yaml"
    monkeypatch.chdir(tmp_path / "there")
    args = parse("--resume", run)
    assert args.data == tmp_path / "here" / "a.h5"
    assert args.name == f"{prefix}{tmp_path / 'here' / 'mine.yaml'}"
    assert args.files == (Path("missing.h5"),)  # its reader reports it


def test_leftovers_of_a_kill_are_removed(parse, tmp_path):
    run = folder_of(parse("--runs-dir", tmp_path))
    left = run / ".checkpoint.pt.0123abcd.tmp"
    left.write_text("half of one")
    with new_contents(run / "policy.onnx") as being_written:
        folder_of(parse("--resume", run))
        assert not left.exists() and being_written.exists()
        being_written.write_text("whole")
    assert {path.name for path in run.iterdir()} == {"args.json", "policy.onnx"}
    left.touch()
    runs.Run(parse("--resume", run), "wall", parts()).save()
    assert not left.exists()


SCRIPT = """
import os, resource, signal, sys
from dataclasses import dataclass
import torch
from pathlib import Path
from roboarm_nmp.training import arguments, runs

@dataclass
class Args:
    seed: int = 1
    runs_dir: Path = Path("runs")
    resume: Path | None = None
    device: str = "cpu"
    track: bool = False

numbers = torch.zeros(1000)
run = runs.Run(arguments.parse_args(Args), "wall", {"numbers": numbers})
"""


def script(folder, code):
    """A process that runs `SCRIPT` and `code`, when it has ended; and its run's folder."""
    command = [sys.executable, "-c", SCRIPT + code, "--runs-dir", folder]
    ended = subprocess.run(command, capture_output=True, text=True)
    return ended, min(folder.iterdir())


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (
            "resource.setrlimit(resource.RLIMIT_FSIZE, (900, 900)); numbers += 1; run.save()",
            "error: .*: 'checkpoint.pt'",
        ),
        ("torch.zeros(10**15)", "error: out of memory .+"),
    ],
)
def test_errors_that_are_no_mistake_of_the_program_get_a_line(tmp_path, code, message):
    ended, run = script(tmp_path, f"run.save()\n{code}")
    lines = ended.stderr.strip().splitlines()
    assert ended.returncode != 0 and "Traceback" not in ended.stderr
    assert re.fullmatch(message, lines[-2])
    assert lines[-1] == f"--resume {run} continues from the last checkpoint"
    assert {path.name for path in run.iterdir()} == {"args.json", "checkpoint.pt"}
    assert not torch.load(run / "checkpoint.pt", weights_only=True)["numbers"].any()


def test_signal_outside_the_loop_ends_a_run_with_a_line(tmp_path):
    ended, run = script(tmp_path, "run.save(); os.kill(os.getpid(), signal.SIGINT)")
    assert ended.returncode == 130
    line = f"interrupted; --resume {run} continues from the last checkpoint"
    assert ended.stderr.splitlines()[-1] == line and "Traceback" not in ended.stderr


LOOP = """
run.start(10, "update")
while run.step < 10:
    run.advance()
    numbers += 1
    if run.step == 3:
        os.kill(os.getpid(), signal.SIGTERM)
        assert run.interrupted  # and this step is completed
        %s
    if run.interrupted:
        run.save()
    assert run.step <= 3
"""


def test_signals_in_the_loop_end_a_run_in_a_checkpoint(tmp_path):
    # `timeout` sends it to all processes, and so does a search to its trainers.
    ended, run = script(tmp_path, LOOP % "os.kill(os.getpid(), signal.SIGTERM)")
    assert ended.returncode == 143
    line = f"terminated; checkpoint at update 3; --resume {run} continues there"
    assert ended.stderr.splitlines()[-1] == line
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    assert state["counts"]["step"] == 3 and (state["numbers"] == 3).all()


def test_second_signal_ends_a_run_at_once(tmp_path):
    later = "runs.SAME_INTERRUPT = 0.0; os.kill(os.getpid(), signal.SIGTERM)"
    ended, run = script(tmp_path, LOOP % later)
    assert ended.returncode == 143
    line = f"terminated; no checkpoint yet; --resume {run} starts again"
    assert ended.stderr.splitlines()[-1] == line
    assert not (run / "checkpoint.pt").exists()


def test_damaged_checkpoint_is_rejected_by_name(parse, tmp_path):
    run = folder_of(parse("--runs-dir", tmp_path))
    args = parse("--resume", run)
    runs.Run(args, "wall", parts()).save()  # it was stopped before the first checkpoint
    content = (run / "checkpoint.pt").read_bytes()
    (run / "checkpoint.pt").write_bytes(content[: len(content) // 2])
    with pytest.raises(SystemExit, match="checkpoint.pt is damaged"):
        runs.Run(args, "wall", parts())


def test_events_of_repeated_steps_are_hidden(parse, tmp_path):
    folder = folder_of(parse("--runs-dir", tmp_path))
    for first, end in ((0, 4), (2, 5)):  # stopped after step 4, its checkpoint was of step 2
        run = runs.Run(parse("--resume", folder), "wall", {})
        run.step = first
        run.start(5, "step")
        while run.step < end:
            run.advance()
            run.log({"loss": torch.full((2,), 10.0 * first + run.step), "nothing": None})
        run.close()
        time.sleep(1.1)  # TensorBoard orders files by their names, which have the second
    events = EventAccumulator(str(folder)).Reload()
    found = [(event.step, event.value) for event in events.Scalars("loss")]
    assert found == [(1, 1), (2, 2), (3, 23), (4, 24), (5, 25)]
    table = events.Tensors("hyperparameters/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "|radii|(0.1, 0.2)|" in table


def test_track_logs_to_weights_and_biases(parse, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=r"--track: wandb is not installed \(pip install wandb\)"):
        parse("--track")
    (tmp_path / "wandb.py").write_text("calls = []\ndef init(**kw): calls.append(kw)\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "wandb", raising=False)

    def start(args):
        run = runs.Run(args, "wall", {})
        run.start(1, "step")
        run.close()
        return run.folder

    args = parse("--runs-dir", tmp_path / "runs", "--data", "a.h5")
    run = start(args)
    assert "wandb" not in sys.modules  # off by default

    args = parse("--resume", run, "--track")
    start(args)
    (call,) = sys.modules.pop("wandb").calls
    assert call["sync_tensorboard"] and call["id"] == run.name and call["resume"] == "allow"
    assert (call["config"]["data"], call["config"]["steps"]) == ("a.h5", 10)
    json.dumps(call)  # plain values only
