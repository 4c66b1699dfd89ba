"""Commands with one to three flags of random values."""

import contextlib
import dataclasses
import importlib
import os
import random
import runpy
import shutil
import sys
from pathlib import Path

from attacks import children
from attacks.children import RAN, REFUSED

MEGABYTES = 8000
SECONDS = 60  # a run that is not rejected is a whole one; trials of a sweep are processes
NUMBERS = (0, -1, -5, 1, 2, 3.5, 2**31, 2**63, 2**70, 10**30, 1e-300, 1e-320, 1e300, 0.5)
WORDS = ("nan", "inf", "", " ", "x", "None", "../../x", "/proc", "/dev/null/x", "no/such/folder")
WORDS += ("a" * 300, "ü\n", "1,5", "1e3", "0x10", "--", "-", "wall", "empty.h5")
PLAIN = 20  # the round of attempts without odd flags, in which every command runs
# Flags whose large numbers only take long.
LONG = ("total_timesteps", "total_updates", "num", "num_test", "num_validation", "scenes", "trials")
LONG += ("paths_per_scene", "steps", "horizon", "tries", "num_nodes", "round_queries", "draws")
LONG += ("num_queries", "attempts", "max_checks", "simplify", "time_limit")
LONG += ("updates_per_step",)

RUN = "--eval-queries 1 --test-queries 1 --runs-dir runs"
RL = f"--task wall --num-envs 1 --hidden-size 8 --batch-size 4 --learning-starts 20 {RUN}"
RL += " --total-timesteps 60 --eval-every 60 --horizon 20"
BC = f"--task wall --hidden-size 8 --batch-size 4 --num-demos 5 {RUN}"
BC += " --total-updates 4 --eval-every 4"
ENCODER = "--observations observations --total-updates 2 --eval-every 2 --batch-size 1"
ENCODER += " --validation-share 0.5 --runs-dir runs"
TINY = {
    "clean_rl_scripts.sac_her_mp": RL,
    "clean_rl_scripts.td3_her_mp": RL,
    "clean_rl_scripts.crl_mp": RL,
    **dict.fromkeys(("bc_script.bc", "bc_script.gciql", "bc_script.diffusion"), BC),
    "bc_script.roadmap_bc": f"--paths roadmaps --task wall --hidden-size 8 --token-width 8"
    f" {RUN} --num-blocks 1 --batch-size 4 --first-scenes 1 --pool-scenes 2 --examples-per-scene 4"
    " --updates-per-scene 2 --total-updates 4 --eval-every 4",
    "scene_embedding_train.vae": f"{ENCODER} --image-size 16 --width 2",
    "scene_embedding_train.vqvae": f"{ENCODER} --image-size 16 --width 2",
    "scene_embedding_train.pointnet2": f"{ENCODER} --width 4 --num-points 16 --num-centres 8 4"
    " --num-neighbours 4",
    "scene_embedding_train.field": f"{ENCODER} --width 4 --num-points 16",
    "clean_rl_scripts.evaluate": "--policy go-to-goal --task wall --num-queries 1 --json a.json",
    "demo_generation.collect": "--task wall --num 1 --workers 1 --output demos.h5",
    "demo_generation.make_queries": "--task mine.yaml --num-test 2 --num-validation 1 --workers 1"
    " --output queries.h5",
    "demo_generation.roadmaps": "--output paths --task wall --scenes 1 --paths-per-scene 2"
    " --num-nodes 50 --workers 1",
    "demo_generation.verify": "demos_of_wall.h5 --workers 1",
    "demo_generation.export": "--format minari --file demos_of_wall.h5 --overwrite",
    "scene_embedding_train.collect": "--num 1 --image-size 16 --num-samples 100 --workers 1"
    " --output seen",
    "viewer.show": "wall --output a.png --size 32 32",
    "clean_rl_scripts.sweep": "trainer.py --search x=1..3 --trials 1 --folder sweep",
}
TINY = {f"roboarm_nmp.{name}": flags for name, flags in TINY.items()}
TRAINER = """
import json, sys
from dataclasses import dataclass
from pathlib import Path
import tyro

@dataclass
class Args:
    x: int = 1
    runs_dir: Path = Path("runs")

args = tyro.cli(Args)
run = args.runs_dir / "run"
run.mkdir(parents=True)
(run / "result.json").write_text(json.dumps({"validation_success_rate": 1 / args.x}))
"""


def attempts(seed, folder):
    """The attempt: a function from a number to the outcome of a command with such flags."""
    fields = {name: _fields(name) for name in TINY}
    inputs = folder / "inputs"
    inputs.mkdir()
    _make_inputs(inputs)
    os.environ["MINARI_DATASETS_PATH"] = "minari"  # of each attempt's folder

    def attempt(number):
        rng = random.Random(f"{seed} {number}")
        module = list(TINY)[number % len(TINY)]
        plain = number // len(TINY) == PLAIN
        odd = [] if plain else _flags(fields[module], rng)
        here = folder / str(number)
        shutil.rmtree(here, ignore_errors=True)
        shutil.copytree(inputs, here, symlinks=True)
        before = _everything(here)
        try:
            code, output = _run(module, [*TINY[module].split(), *odd], here)
            made = _everything(here) - before
        finally:
            shutil.rmtree(here)
        if children.repeating:
            print(output)
        if "Traceback" in output:
            return f"traceback of {module}: {output.strip().splitlines()[-1][:120]}"
        if any(not path.name.isdigit() for path in folder.iterdir() if path != inputs):
            return f"{module} left something elsewhere"
        if plain and code != 0:
            return f"{module} does not run"
        if code == 0 or "training has diverged" in output:
            return RAN
        if any(path.name.endswith((".tmp", ".part", ".journal")) for path in made):
            return f"{module} left {sorted(path.name for path in made)}"
        return REFUSED if not made else f"{module}: late, after {sorted(p.name for p in made)[:3]}"

    return attempt


def _everything(folder):
    return set(folder.rglob("*"))


def _fields(module):
    args = importlib.import_module(module).Args
    return {field.name: field for field in dataclasses.fields(args)}


def _flags(fields, rng):
    """One to three flags of a command line."""
    flags = []
    for name in rng.sample(sorted(fields), min(len(fields), rng.randint(1, 3))):
        flag = f"--{name.replace('_', '-')}"
        if str(fields[name].type).startswith(("bool", "<class 'bool'")):
            flags.append(rng.choice([flag, f"--no-{flag[2:]}"]))
            continue
        values = [number for number in NUMBERS if name not in LONG or not 5 < number < 2**62]
        words = [word for word in WORDS if word != "None" or name not in LONG]
        value = rng.choice([*values, *words])
        flags += [flag, str(value)]
        if name in ("size", "radii"):
            flags.append(str(rng.choice(values)))
    return flags


def _run(module, arguments, folder):
    """The exit code and the output of a command, run in this process, in a folder."""
    os.chdir(folder)
    sys.argv = [module, *arguments]
    file, streams = open("output", "w+"), (os.dup(1), os.dup(2))  # noqa: SIM115 (closed below)
    with file, contextlib.redirect_stderr(file), contextlib.redirect_stdout(file):
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        try:
            runpy.run_module(module, run_name="__main__", alter_sys=True)
            code = 0
        except SystemExit as end:
            code = end.code or 0
            if isinstance(code, str):
                print(code, file=file)
        except BaseException as error:
            sys.excepthook(type(error), error, error.__traceback__)
            code = 1
        file.flush()
        file.seek(0)
        text = file.read()
    for number, stream in enumerate(streams, start=1):
        os.dup2(stream, number)
    Path("output").unlink()
    return code, text


def _make_inputs(folder):
    """The input files of the tiny commands."""
    from roboarm_nmp.demo_generation import collect, roadmaps
    from roboarm_nmp.envs.scenes.files import save_scene
    from roboarm_nmp.envs.scenes.primitives import Scene
    from roboarm_nmp.scene_embedding_train import collect as observe

    save_scene(Scene(), folder / "mine.yaml")
    (folder / "trainer.py").write_text(TRAINER)
    (folder / "empty.h5").touch()
    options = collect.options_of(collect.Args("wall"))
    collect.collect(folder / "demos_of_wall.h5", 1, options, progress=False)
    small = {"scenes": 2, "paths_per_scene": 4, "num_nodes": 100, "workers": 1}
    roadmaps.collect(roadmaps.Args(folder / "roadmaps", **small), progress=False)
    small = {"num": 4, "image_size": 32, "num_samples": 400, "workers": 1}
    observe.collect(observe.Args(output=folder / "observations", **small), progress=False)
