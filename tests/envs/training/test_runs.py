"""envs/training/runs.py: flags of a run, what a checkpoint brings back. (Whole runs: test_trainers.py.)"""

import contextlib
import io
import json
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from roboarm_nmp.envs.training import runs
from roboarm_nmp.envs.utils.files import new_contents


@dataclass
class Args(runs.RunFlags):
    exp_name: str = "test"
    data: Path | None = None
    files: tuple[Path, ...] = ()
    radii: tuple[float, float] = (0.1, 0.2)
    name: str | None = None
    steps: int = 10
    size: ClassVar[int] = 0


@pytest.fixture(autouse=True)
def own_excepthook(monkeypatch):
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)


@pytest.fixture
def parse(monkeypatch):
    def parse(*flags):
        monkeypatch.setattr("sys.argv", ["trainer.py", *map(str, flags)])
        return runs.parse_args(Args, may_change={"steps", "data"})

    return parse


def test_flags_come_back_as_they_were(parse, tmp_path):
    flags = ["--runs-dir", tmp_path, "--data", "a.h5", "--files", "b.h5", "c.h5", "--name", "x"]
    args = parse(*flags, "--radii", "0.3", "0.5", "--threads", "2")
    run = runs.run_folder(args, "wall")
    assert run.parent == tmp_path and run.name.startswith("wall__test__1__")
    again = parse("--resume", run)
    assert again.resume == run == runs.run_folder(again, "wall")
    args.resume = run
    assert again == args
    assert isinstance(again.data, Path) and all(isinstance(file, Path) for file in again.files)
    changed = parse("--resume", run, "--steps", "20", "--data", "d.h5", "--threads", "3")
    assert (changed.steps, changed.data, changed.threads) == (20, Path("d.h5"), 3)


@pytest.mark.parametrize(
    "flags, message",
    [
        (["--radii", "0.3", "0.4"], r"--radii is \[0.3, 0.4\] now, the run had \[0.1, 0.2\]"),
        (["--files", "e.h5"], r"--files is \['e.h5'\] now, the run had \[\]"),
        (["--name", "y"], "--name is 'y' now, the run had None"),
        (["--seed", "2", "--exp-name", "z"], "--seed is 2 now, .*; --exp-name is 'z'"),
    ],
)
def test_a_run_is_not_resumed_as_another(parse, tmp_path, flags, message):
    run = runs.run_folder(parse("--runs-dir", tmp_path), "wall")
    with pytest.raises(SystemExit, match=message):
        parse("--resume", run, *flags)


def test_a_run_older_than_a_flag_has_its_default(parse, tmp_path):
    run = runs.run_folder(parse("--runs-dir", tmp_path), "wall")
    saved = json.loads((run / "args.json").read_text())
    del saved["radii"]
    (run / "args.json").write_text(json.dumps(saved | {"a_flag_that_was": 3}))
    assert parse("--resume", run).radii == (0.1, 0.2)
    with pytest.raises(SystemExit, match="--radii"):
        parse("--resume", run, "--radii", "0.3", "0.4")


def test_no_run_and_no_gpu(parse, tmp_path, monkeypatch):
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


def test_what_is_decided_about_bfloat16_is_kept(parse, tmp_path, monkeypatch):
    @dataclass
    class WithBf16(Args):
        bf16: bool | None = None

    def begin(supported, *flags):
        monkeypatch.setattr("torch.cpu._is_avx512_bf16_supported", lambda: supported)
        monkeypatch.setattr("sys.argv", ["trainer.py", *map(str, flags)])
        args = runs.parse_args(WithBf16)
        runs.resolve_bf16(args)
        return args.bf16, runs.run_folder(args, "wall")

    for number, supported in enumerate((False, True)):
        bf16, run = begin(supported, "--runs-dir", tmp_path / str(number))
        assert bf16 is supported
        assert json.loads((run / "args.json").read_text())["bf16"] is supported
        assert begin(not supported, "--resume", run)[0] is supported
    assert begin(False, "--runs-dir", tmp_path, "--bf16", "True")[0] is True


def parts():
    model = torch.nn.Linear(3, 2)
    return {
        "model": model,
        "optimizer": torch.optim.Adam(model.parameters(), lr=0.1, fused=True),
        "alpha": torch.zeros(1, requires_grad=True),
        "rng": np.random.default_rng(0),
        "progress": {"updates": 0, "best": {}},
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
    parts["progress"]["updates"] += 1
    parts["progress"]["best"] = {"loss": loss.item()}
    return loss.item()


def test_a_checkpoint_brings_every_part_back(parse, tmp_path):
    args = parse("--runs-dir", tmp_path)
    run = runs.run_folder(args, "wall")
    runs.seed_torch(args)
    before = parts()
    runs.load_checkpoint(args, before)  # a new run: nothing happens
    learn(before)
    runs.save_checkpoint(run, before, "cpu")
    assert {path.name for path in run.iterdir()} == {"args.json", "checkpoint.pt"}
    expected = [learn(before) for _ in range(3)]

    args = parse("--resume", run)
    after = parts()
    runs.load_checkpoint(args, after)
    assert after["progress"]["updates"] == 1 and after["alpha"].requires_grad
    assert [learn(after) for _ in range(3)] == expected
    for newer, name in (
        ({"critic": torch.nn.Linear(1, 1)}, "critic"),
        ({"progress": {"updates": 0, "best_step": 0}}, "best_step"),
    ):
        with pytest.raises(SystemExit, match=f"of another version: it has no {name}"):
            runs.load_checkpoint(args, after | newer)
    with pytest.raises(SystemExit, match=r"of another version: (.|\n)*size mismatch for weight"):
        runs.load_checkpoint(args, after | {"model": torch.nn.Linear(4, 2)})


def test_the_random_numbers_of_the_runs_own_gpu(parse, tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    states, given = {"cuda:0": torch.tensor([3]), "cuda:1": torch.tensor([7])}, []
    monkeypatch.setattr("torch.cuda.get_rng_state", lambda device: states[str(device)])
    monkeypatch.setattr("torch.cuda.set_rng_state", lambda *state: given.append(state))
    run = runs.run_folder(parse("--runs-dir", tmp_path, "--device", "cuda:1"), "wall")
    runs.save_checkpoint(run, parts(), torch.device("cuda:1"))
    runs.load_checkpoint(parse("--resume", run), parts())
    assert given == [(torch.tensor([7]), "cuda:1")]


def test_files_are_found_from_another_folder(parse, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for name in ("a.h5", "mine.yaml"):
        Path(name).touch()
    flags = ["--data", "a.h5", "--name", "mine.yaml", "--files", "missing.h5", "--runs-dir", "runs"]
    run = runs.run_folder(parse(*flags), "mine").absolute()
    assert parse("--resume", run).name == "mine.yaml"
    monkeypatch.chdir(tmp_path / "there")
    args = parse("--resume", run)
    assert args.data == tmp_path / "here" / "a.h5"
    assert args.name == str(tmp_path / "here" / "mine.yaml")
    assert args.files == (Path("missing.h5"),)  # whoever reads it says that it is missing


def test_what_a_kill_has_left_is_cleared_away(parse, tmp_path):
    run = runs.run_folder(parse("--runs-dir", tmp_path), "wall")
    left = run / ".checkpoint.pt.0123abcd.tmp"
    left.write_text("half of one")
    with new_contents(run / "policy.pt") as being_written:
        runs.run_folder(parse("--resume", run), "wall")
        assert not left.exists() and being_written.exists()
        being_written.write_text("whole")
    assert {path.name for path in run.iterdir()} == {"args.json", "policy.pt"}
    left.touch()
    runs.save_checkpoint(run, parts(), "cpu")
    assert not left.exists()


SCRIPT = """
import resource, signal, sys
from dataclasses import dataclass
import torch
from envs import runs

@dataclass
class Args(runs.RunFlags):
    exp_name: str = "test"

args = runs.parse_args(Args)
run = runs.run_folder(args, "wall")
numbers = torch.zeros(1000)
runs.save_checkpoint(run, {"numbers": numbers}, "cpu")
"""


@pytest.mark.parametrize(
    ("happening", "said"),
    [
        (
            "resource.setrlimit(resource.RLIMIT_FSIZE, (900, 900))\nsave()",
            "error: .*: 'checkpoint.pt'",
        ),
        ("torch.zeros(10**15)", "error: out of memory .+"),
        ("bytearray(10**15)", "error: out of memory"),
        ("raise KeyboardInterrupt", "interrupted"),
    ],
)
def test_what_is_no_mistake_of_the_program_is_said_plainly(tmp_path, happening, said):
    save = "def save():\n    runs.save_checkpoint(run, {'numbers': numbers + 1}, 'cpu')\n"
    command = [sys.executable, "-c", SCRIPT + save + happening, "--runs-dir", tmp_path]
    ended = subprocess.run(command, capture_output=True, text=True)
    run = next(tmp_path.iterdir())
    lines = ended.stderr.strip().splitlines()
    assert ended.returncode != 0 and "Traceback" not in ended.stderr
    assert re.fullmatch(said, lines[-2])
    assert lines[-1] == f"what the last checkpoint has is safe: --resume {run} goes on from there"
    assert {path.name for path in run.iterdir()} == {"args.json", "checkpoint.pt"}
    assert not torch.load(run / "checkpoint.pt", weights_only=True)["numbers"].any()


def test_other_mistakes_keep_their_traceback(tmp_path):
    command = [sys.executable, "-c", SCRIPT + "1 / 0", "--runs-dir", tmp_path]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert "Traceback" in ended.stderr and "ZeroDivisionError" in ended.stderr


def test_a_checkpoint_of_a_damaged_file_says_which(parse, tmp_path):
    run = runs.run_folder(parse("--runs-dir", tmp_path), "wall")
    args = parse("--resume", run)
    runs.load_checkpoint(args, parts())  # stopped before the first checkpoint
    runs.save_checkpoint(run, parts(), "cpu")
    content = (run / "checkpoint.pt").read_bytes()
    (run / "checkpoint.pt").write_bytes(content[: len(content) // 2])
    with pytest.raises(SystemExit, match="checkpoint.pt is damaged"):
        runs.load_checkpoint(args, parts())
    saved = torch.load(io.BytesIO(content), weights_only=True)
    rng, unnoticed = np.random.default_rng(0), 0
    for _ in range(100):
        flipped = bytearray(content)
        flipped[rng.integers(len(content))] ^= 1 << rng.integers(8)
        (run / "checkpoint.pt").write_bytes(flipped)
        with contextlib.suppress(SystemExit):
            runs.load_checkpoint(args, parts())
            unnoticed += 1  # nothing but padding or a date was hit:
            assert str(torch.load(run / "checkpoint.pt", weights_only=True)) == str(saved)
    assert unnoticed < 50


def test_events_of_steps_that_are_done_again_are_hidden(parse, tmp_path):
    args = parse("--runs-dir", tmp_path)
    run = runs.run_folder(args, "wall")
    for begin, end in ((0, 4), (2, 5)):  # stopped after step 4, its checkpoint was of step 2
        with runs.summary_writer(run, args, begin) as writer:
            for step in range(begin + 1, end + 1):
                writer.add_scalar("loss", 10 * begin + step, step)
    events = EventAccumulator(str(run))
    events.Reload()
    found = [(event.step, event.value) for event in events.Scalars("loss")]
    assert found == [(1, 1), (2, 2), (3, 23), (4, 24), (5, 25)]
    table = events.Tensors("hyperparameters/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "|radii|(0.1, 0.2)|" in table


def test_tracking_with_weights_and_biases(parse, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=r"--track: wandb is not installed \(pip install wandb\)"):
        parse("--track")
    (tmp_path / "wandb.py").write_text("calls = []\ndef init(**kw): calls.append(kw)\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    args = parse("--runs-dir", tmp_path / "runs", "--data", "a.h5")
    run = runs.run_folder(args, "wall")
    runs.summary_writer(run, args, 0).close()
    assert "wandb" not in sys.modules  # off by default

    args = parse("--resume", run, "--track")
    runs.summary_writer(run, args, 0).close()
    (call,) = sys.modules.pop("wandb").calls
    assert call["sync_tensorboard"] and call["id"] == run.name and call["resume"] == "allow"
    assert (call["config"]["data"], call["config"]["steps"]) == ("a.h5", 10)
    json.dumps(call)  # plain values only
