"""Search over the flags of a trainer, with Optuna, on this machine or on a Ray cluster.

    roboarm sweep clean_rl_scripts/td3_her_mp.py \\
        --folder sweeps/td3 --trials 20 --search learning-rate=1e-6..5e-3:log \\
        -- --task double_walls_wide_gap --total-timesteps 100000

The search space: `NAME=LOW..HIGH` (integers if both are; `:log` for a logarithmic scale) or
`NAME=a,b,c` (`NAME=true,false` for boolean flags). Every trial receives the flags after `--`, too.
A trial's value is the trainer's best validation success.

The folder contains each trial's run, the search itself (`study.log`) and `trials.csv`; `tensorboard
--logdir FOLDER` shows curves and, under HPARAMS, the comparison. The same command continues an
interrupted search and, from their checkpoints, the trials that were running. With `--workers 1` an
uninterrupted search is reproducible; otherwise, samples depend on the order in which trials end.

(Paper, appendix "Parameter sweeps": learning rates from 1e-6 to 5e-3; for SAC, with and without
entropy tuning, `target-entropy=-7,None`, and alpha from 1e-5 to 10.)
"""

import csv
import fcntl
import importlib.util
import json
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import tyro

from roboarm_nmp.utils.files import check_folder, new_contents
from roboarm_nmp.utils.flags import CORES, PositiveInt, Seed, Workers, check, parse
from roboarm_nmp.utils.names import suggest
from roboarm_nmp.utils.signals import end_with_one_line, error_line
from roboarm_nmp.utils.workers import check_ray

METRIC = "validation_success_rate"
RUNNING = set()  # processes of trainers


@dataclass
class Args:
    trainer: tyro.conf.Positional[Path]
    """A trainer's script."""
    search: tuple[str, ...]
    """The search space (see above)."""
    trials: PositiveInt = 20
    """Number of trials."""
    folder: Path = Path("sweep")
    """Folder of the search."""
    seed: Seed = 0
    """Seed of the search."""
    workers: Workers = CORES
    """Trials at a time, one core each; by default as many as there are cores."""
    ray_address: str | None = None
    """Search on the Ray cluster at this address (`auto`, `HOST:PORT`)."""


def parse_search(text: str):
    """`NAME=...` -> (name, Optuna distribution). Raises ValueError if it is neither form."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    name, _, space = text.lstrip("-").partition("=")
    name = name.replace("_", "-")
    ends = re.fullmatch(r"(.+)\.\.(.+?)(:log)?", space)
    if not name or not space:
        raise ValueError(f"{text!r} is neither NAME=LOW..HIGH nor NAME=a,b,c")
    if ends is None:
        return name, CategoricalDistribution(space.split(","))
    low, high, log = ends[1], ends[2], ends[3] is not None
    try:
        if re.fullmatch(r"-?\d+", low) and re.fullmatch(r"-?\d+", high):
            return name, IntDistribution(int(low), int(high), log=log)
        return name, FloatDistribution(float(low), float(high), log=log)
    except ValueError as error:
        raise ValueError(f"{text!r}: {error}") from error


def flags_of(params: dict) -> list[str]:
    """`{"gamma": 0.98, "jacobian": "false"}` -> `["--gamma=0.98", "--no-jacobian"]`."""
    switches = {"true": "--{}", "false": "--no-{}"}
    return [switches.get(value, "--{}={}").format(name, value) for name, value in params.items()]


def train(trainer: Path, flags: list[str], folder: Path) -> float | str:
    """Run the trainer in `folder`, or continue the run there. Returns its best validation success.

    Or "stopped" by a signal, after which the run may continue, or "failed": `log.txt` says why.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "log.txt", "a") as log:
        # The trainer inherits the lock: this waits for one that has outlived its killed sweep.
        fcntl.flock(log, fcntl.LOCK_EX)
        if not any(folder.glob("*/result.json")):
            more = ["--runs-dir", str(folder), *flags]
            for checkpoint in folder.glob("*/checkpoint.pt"):  # at most one
                more = ["--resume", str(checkpoint.parent)]
            process = subprocess.Popen(
                [sys.executable, str(trainer), *more], stdout=log, stderr=log
            )
            RUNNING.add(process)
            code = process.wait()
            RUNNING.discard(process)
            if code:  # Ctrl-C, SIGTERM, and too little memory stop it
                return "stopped" if code < 0 or code in (130, 143) else "failed"
        result = json.loads(next(folder.glob("*/result.json")).read_text())
        if METRIC not in result:
            log.write(f"its result has no {METRIC}: it trains no policy\n")
        return result.get(METRIC, "failed")


def on_ray(address: str) -> tuple[Callable, int]:
    """`train` on the machines of a Ray cluster, which share the folder, and their number of cores.

    Raises ConnectionError: there is no cluster at the address.
    """
    import ray  # pyright: ignore[reportMissingImports]

    options = {"log_to_driver": False, "logging_level": "warning", "ignore_reinit_error": True}
    ray.init(address=address, **options)
    remote = ray.remote(num_cpus=1, max_retries=-1)(train)  # machines may be lost
    cores = max(1, int(ray.cluster_resources().get("CPU", 1)))
    return lambda *trial: ray.get(remote.remote(*trial)), cores


def sweep(args: Args, search: dict, flags: list[str]):
    """Run the search to its end; returns the Optuna study.

    `search` is a dict from a flag to its Optuna distribution, `flags` are those of every trial.
    Raises ValueError: the folder is that of another search.
    """
    import optuna
    from optuna.storages.journal import JournalFileBackend
    from optuna.trial import TrialState
    from torch.utils.tensorboard import SummaryWriter

    run, workers = (train, args.workers) if args.ray_address is None else on_ray(args.ray_address)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    folder = args.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    storage = optuna.storages.JournalStorage(JournalFileBackend(str(folder / "study.log")))
    study = optuna.create_study(
        study_name="sweep", direction="maximize", storage=storage, load_if_exists=True
    )
    described = {"trainer": str(args.trainer), "flags": flags, "seed": args.seed}
    described["search"] = {name: str(distribution) for name, distribution in search.items()}
    if study.user_attrs.get("search", described) != described:
        raise ValueError(f"{args.folder} holds another search: {study.user_attrs['search']}")
    study.set_user_attr("search", described)
    # A new stream of random numbers each time, otherwise the first samples would be repeated.
    seed = args.seed + len(study.trials)
    study.sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=workers > 1)
    begun = [trial for trial in study.trials if trial.params.keys() == search.keys()]
    unfinished = [trial for trial in begun if trial.state == TrialState.RUNNING]
    lock = threading.Lock()

    def run_trial():
        with lock:
            trial = unfinished.pop(0) if unfinished else study.ask(search)
        path = folder / f"trial_{trial.number:03d}"
        value = run(args.trainer.resolve(), [*flags, *flags_of(trial.params)], path)
        if value == "failed":
            study.tell(trial.number, state=TrialState.FAIL)
        elif not isinstance(value, str):  # one that was stopped is for the next search
            with SummaryWriter(path) as writer:
                writer.add_hparams(trial.params, {f"sweep/{METRIC}": value}, run_name="hparams")
            study.tell(trial.number, value)
            value = f"{value:.3f}"
        with lock:
            write_table(study, folder)
        print(f"{path.name}: {value} {trial.params}", flush=True)

    with ThreadPoolExecutor(workers) as threads:
        number = len(unfinished) + max(0, args.trials - len(begun))
        jobs = [threads.submit(run_trial) for _ in range(number)]
        try:
            for job in jobs:
                job.result()
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            for process in list(RUNNING):
                process.terminate()  # after a checkpoint
            raise
    write_table(study, folder)
    return study


def write_table(study, folder: Path) -> None:
    """`trials.csv`: a row with the flags and the value of each trial."""
    rows = []
    for trial in study.trials:
        path = folder / f"trial_{trial.number:03d}"
        row = {"trial": path.name, "state": trial.state.name.lower(), METRIC: trial.value}
        row |= {**trial.params, "seconds": trial.duration and trial.duration.total_seconds()}
        row["error"] = ""
        if row["state"] == "fail":
            row["error"] = (path / "log.txt").read_text(errors="replace").strip().split("\n")[-1]
        rows.append(row)
    with new_contents(folder / "trials.csv") as path, open(path, "w", newline="") as file:
        table = csv.DictWriter(file, rows[0] if rows else [])
        table.writeheader()
        table.writerows(rows)


def check_flags(trainer: Path, flags: list[str]) -> None:
    """Raise ValueError unless the trainer has all of these flags."""
    command = [sys.executable, trainer, "--help"]
    known = re.findall(r"--[\w-]+", subprocess.run(command, capture_output=True, text=True).stdout)
    for flag in flags:
        flag = flag.partition("=")[0].replace("_", "-")
        if flag.startswith("--") and flag not in known:
            hint = suggest(flag, known, "--help lists them")
            raise ValueError(f"{trainer} has no flag {flag}: {hint}")


def main(arguments: list[str] | None = None) -> None:
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    flags = arguments[cut + 1 :]
    args = parse(Args, arguments[:cut], others="search")
    if importlib.util.find_spec("optuna") is None:
        sys.exit('this needs the extra `sweep`: pip install -c constraints.txt -e ".[sweep]"')
    try:
        check(args)
        if not args.trainer.is_file():
            raise ValueError(f"no such trainer: {args.trainer}")
        search = dict(parse_search(text) for text in args.search)
        check_folder(args.folder)
        check_ray(args.ray_address)
        check_flags(args.trainer, [*(f"--{name}" for name in search), *flags])
        study = sweep(args, search, flags)
    except (ValueError, OSError) as error:
        sys.exit(error_line(error))
    values = [trial.value for trial in study.trials if trial.value is not None]
    table = args.folder / "trials.csv"
    if not values:
        sys.exit(error_line(f"every trial failed; see {table}"))
    print(f"best of {len(values)}: {max(values):.3f}; all of them are in {table}")


if __name__ == "__main__":
    end_with_one_line("the same command continues the search")
    main()
