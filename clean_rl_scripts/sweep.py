"""Search over the flags of a trainer, with Optuna on this machine or Ray Tune on a cluster.

    roboarm sweep clean_rl_scripts/td3_her_mp.py \\
        --folder sweeps/td3 --trials 20 --search policy-lr=1e-6..5e-3:log q-lr=1e-6..5e-3:log \\
        -- --task double_walls_wide_gap --total-timesteps 100000

The search space: `NAME=LOW..HIGH` (integers if both
are; `:log` for a logarithmic scale) or `NAME=a,b,c` (`NAME=true,false` for boolean flags). Every
trial receives the flags after `--`, too. A trial's value is the trainer's best validation success.

The folder contains each trial's run, the search itself (`study.log`) and `trials.csv`; `tensorboard
--logdir FOLDER` shows curves and, under HPARAMS, the comparison. The same command continues an
interrupted search; trials that were running continue from their checkpoints. An uninterrupted
search with `--workers 1` is reproducible. Otherwise, samples depend on the order in which trials
end.

(Paper, appendix "Parameter sweeps": learning rates from 1e-6 to 5e-3; for SAC, with and without
entropy tuning, `target-entropy=-7,None`, and alpha from 1e-5 to 10.)
"""

import csv
import fcntl
import io
import json
import re
import signal
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

import tyro

from roboarm_nmp.utils import names
from roboarm_nmp.utils.files import check_folder, write_atomically
from roboarm_nmp.utils.flags import CORES, PositiveInt, Seed, Workers, check, parse
from roboarm_nmp.utils.signals import Terminated, end_with_one_line, error_line, exit_interrupted
from roboarm_nmp.utils.workers import check_ray

try:
    import optuna
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend
    from optuna.trial import TrialState
except ImportError:  # --help needs no Optuna
    optuna = None

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


def parse_search(text):
    """`NAME=...` -> (name, Optuna distribution). Raises ValueError if it is neither form."""
    name, equals, values = text.partition("=")
    if not (name and equals and values):
        raise ValueError(f"{text!r} is neither NAME=LOW..HIGH nor NAME=a,b,c")
    name = name.lstrip("-").replace("_", "-")
    if ".." not in values:
        return name, CategoricalDistribution(values.split(","))
    values, _, scale = values.partition(":")
    if scale not in ("", "log"):
        raise ValueError(f"{text!r}: only `log` may follow the colon")
    low, _, high = values.partition("..")
    try:
        whole = low.lstrip("-").isdigit() and high.lstrip("-").isdigit()
        low, high = (int(low), int(high)) if whole else (float(low), float(high))
        kind = IntDistribution if whole else FloatDistribution
        return name, kind(low, high, log=scale == "log")
    except ValueError as error:
        raise ValueError(f"{text!r}: {error}") from error


def suggest(trial, name, space):
    """Optuna's value of a flag for a trial."""
    if isinstance(space, CategoricalDistribution):
        return trial.suggest_categorical(name, space.choices)
    kind = trial.suggest_int if isinstance(space, IntDistribution) else trial.suggest_float
    return kind(name, space.low, space.high, log=space.log)


def flags_of(params):
    """`{"policy-lr": 1e-3, "autotune": "false"}` -> `--policy-lr 0.001 --no-autotune`, a list."""
    flags = []
    for name, value in params.items():
        if value in ("true", "false"):
            flags.append(f"--{name}" if value == "true" else f"--no-{name}")
        else:
            flags += [f"--{name}", str(value)]
    return flags


class Stopped(Exception):
    """A trial was interrupted; the next call of the search continues it."""


def train(trainer, flags, folder):
    """The result (dict) of a run of the trainer in `folder`, which continues if it was stopped.

    Raises:
        RuntimeError: the trainer failed; the message has the end of its output. Or it trains no
            policy.
        Stopped: a signal ended the trainer.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "log.txt", "ab") as log:
        # The trainer inherits the lock: this waits for one that has outlived its killed sweep.
        fcntl.flock(log, fcntl.LOCK_EX)
        if not any(folder.glob("*/result.json")):
            begun = sorted(folder.glob("*/checkpoint.pt"))
            which = ["--resume", begun[-1].parent] if begun else ["--runs-dir", folder, *flags]
            command = [sys.executable, trainer, *which]
            process = subprocess.Popen(command, stdout=log, stderr=log)
            RUNNING.add(process)
            try:
                code = process.wait()
            except KeyboardInterrupt:  # its signal ends the trainer, too, after a checkpoint
                process.wait()
                raise
            finally:
                RUNNING.discard(process)
            if code < 0 or code in (130, 143):  # Ctrl-C, SIGTERM, or too little memory
                raise Stopped(f"the trainer was stopped: exit code {code}")
            if code > 0:
                end = (folder / "log.txt").read_text(errors="replace").strip()[-500:]
                raise RuntimeError(f"the trainer ended with {code}: {end}")
    result = json.loads(next(folder.glob("*/result.json")).read_text())
    if METRIC not in result:
        raise RuntimeError(f"its result has no {METRIC}: it trains no policy")
    return result


def _on_sigterm(number, frame):
    """End the running trainers, after their checkpoints, and the search."""
    for process in list(RUNNING):
        process.terminate()
    raise Terminated


def folder_of(trial):
    """Name of a trial's folder: that of the trial that it continues, if any."""
    return trial.user_attrs.get("folder", f"trial_{trial.number:03d}")


def sweep(trainer, search, trials, folder, flags, seed, workers):
    """Run the search to its end; returns the Optuna study.

    Args:
        trainer: path of a script with the flags `--runs-dir` and `--resume` that writes
            `result.json` into its run's folder.
        search: dict of flag -> Optuna distribution.
        trials: number of trials, finished ones included.
        folder: path of the search's files.
        flags: list of flags of every trial.
        seed: of the search, >= 0.
        workers: trials at a time.

    Raises:
        ValueError: the folder is that of another search.
    """
    folder.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        study_name="sweep",
        direction="maximize",
        storage=JournalStorage(JournalFileBackend(str(folder / "study.log"))),
        load_if_exists=True,
    )
    described = {"trainer": str(trainer), "flags": list(flags), "seed": seed}
    described["search"] = {name: str(distribution) for name, distribution in search.items()}
    if study.user_attrs.get("search", described) != described:
        raise ValueError(f"{folder} holds another search: {study.user_attrs['search']}")
    study.set_user_attr("search", described)
    # A new stream of random numbers each time, otherwise the first samples would be repeated.
    study.sampler = optuna.samplers.TPESampler(
        seed=seed + len(study.trials), constant_liar=workers > 1
    )

    latest = {folder_of(trial): trial for trial in study.trials}
    for name, trial in latest.items():
        stopped = trial.state in (TrialState.RUNNING, TrialState.FAIL)
        if stopped and "error" not in trial.user_attrs:
            if trial.state == TrialState.RUNNING:
                study.tell(trial.number, state=TrialState.FAIL)
            study.enqueue_trial(trial.params, user_attrs={"folder": name})
    done = sum(
        trial.state == TrialState.COMPLETE or "error" in trial.user_attrs
        for trial in latest.values()
    )
    lock = threading.Lock()

    def objective(trial):
        params = {name: suggest(trial, name, space) for name, space in search.items()}
        try:
            result = train(trainer, [*flags, *flags_of(params)], folder / folder_of(trial))
        except RuntimeError as error:
            trial.set_user_attr("error", str(error))
            raise
        return result[METRIC]

    def report(study, trial):
        with lock:
            write_report(study, search, folder)
        failed = "failed" if "error" in trial.user_attrs else "stopped"
        value = failed if trial.value is None else f"{trial.value:.3f}"
        print(f"{folder_of(trial)}: {value} {trial.params}", flush=True)

    if done < trials:
        study.optimize(
            objective,
            n_trials=trials - done,
            n_jobs=workers,
            catch=(RuntimeError, Stopped),
            callbacks=[report],
        )
    write_report(study, search, folder)
    return study


def write_report(study, search, folder):
    """`trials.csv`, and for TensorBoard the flags and the value of each finished trial."""
    rows = []
    for trial in {folder_of(trial): trial for trial in study.trials}.values():
        seconds = trial.duration.total_seconds() if trial.duration is not None else None
        error = trial.user_attrs.get("error", "").splitlines()
        row = {"trial": folder_of(trial), "state": trial.state.name.lower(), METRIC: trial.value}
        row |= {name: trial.params.get(name) for name in search}
        if trial.state == TrialState.FAIL and not error:
            row["state"] = "stopped"
        rows.append(row | {"seconds": seconds, "error": error[-1] if error else ""})
        path = folder / folder_of(trial)
        if trial.state == TrialState.COMPLETE and not (path / "hparams").exists():
            from torch.utils.tensorboard import SummaryWriter  # slow to import, and not for --help

            with SummaryWriter(path) as writer:
                value = {f"sweep/{METRIC}": trial.value}
                writer.add_hparams(trial.params, value, run_name="hparams")
    write_csv(folder / "trials.csv", rows)


def write_csv(path, rows):
    """Write rows (dicts with the same keys), atomically."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, rows[0] if rows else [])
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, text.getvalue().encode())


def sweep_on_ray(address, trainer, search, trials, folder, flags, seed):
    """The same with Ray Tune on an existing cluster, whose machines share this folder.

    Raises ConnectionError if there is no cluster at the address.
    """
    import ray
    from ray import tune
    from ray.tune.search.optuna import OptunaSearch

    trainer, folder = trainer.resolve(), folder.resolve()

    def trial(params):
        path = folder / "runs" / tune.get_context().get_trial_id()
        tune.report({METRIC: train(trainer, [*flags, *flags_of(params)], path)[METRIC]})

    ray.init(address=address, log_to_driver=False, logging_level="warning")
    try:
        path = str(folder / "tune")
        if tune.Tuner.can_restore(path):
            tuner = tune.Tuner.restore(path, trial, resume_unfinished=True, restart_errored=True)
        else:
            tuner = tune.Tuner(
                tune.with_resources(trial, {"cpu": 1}),
                tune_config=tune.TuneConfig(
                    num_samples=trials,
                    search_alg=OptunaSearch(search, metric=METRIC, mode="max", seed=seed),
                ),
                run_config=tune.RunConfig(
                    name="tune",
                    storage_path=str(folder),
                    failure_config=tune.FailureConfig(max_failures=3),
                ),
            )
        rows = [
            {"trial": result.metrics.get("trial_id"), METRIC: result.metrics.get(METRIC)}
            | {name: (result.config or {}).get(name) for name in search}
            | {"error": str(result.error or "")}
            for result in tuner.fit()
        ]
    finally:
        ray.shutdown()
    write_csv(folder / "trials.csv", rows)
    return rows


def _check(args, flags):
    """The search space, as for `sweep`. Raises ValueError: an argument is not valid."""
    check(args)
    if not args.trainer.is_file():
        scripts = [str(path) for path in args.trainer.parent.glob("*.py")]
        hint = names.suggest(args.trainer, scripts, "expected the path of a trainer's script")
        raise ValueError(f"no such trainer: {args.trainer}: {hint}")
    search = dict(parse_search(text) for text in args.search)
    check_folder(args.folder)
    check_ray(args.ray_address)
    command = [sys.executable, args.trainer, "--help"]
    shown = subprocess.run(command, capture_output=True, text=True, errors="replace")
    if shown.returncode != 0:
        end = (shown.stderr or shown.stdout).strip()[-500:]
        raise ValueError(f"{args.trainer} --help ends with {shown.returncode}: {end}")
    known = set(re.findall(r"--[\w-]+", shown.stdout))
    given = [flag.partition("=")[0] for flag in flags if flag.startswith("--")]
    for flag in (*(f"--{name}" for name in search), *given):
        if flag.replace("_", "-") not in known:
            hint = names.suggest(flag, sorted(known), "--help lists them")
            raise ValueError(f"{args.trainer} has no flag {flag}: {hint}")
    return search


def main(arguments=None):
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    flags = arguments[cut + 1 :]
    args = parse(Args, arguments[:cut], others="search")
    if optuna is None:
        sys.exit('this needs the extra `sweep`: pip install -c constraints.txt -e ".[sweep]"')
    signal.signal(signal.SIGTERM, _on_sigterm)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        search = _check(args, flags)
        if args.ray_address is not None:
            rows = sweep_on_ray(
                args.ray_address, args.trainer, search, args.trials, args.folder, flags, args.seed
            )
            values = [row[METRIC] for row in rows if row[METRIC] is not None]
        else:
            study = sweep(
                args.trainer, search, args.trials, args.folder, flags, args.seed, args.workers
            )
            values = [t.value for t in study.trials if t.state == TrialState.COMPLETE]
    except (ValueError, OSError) as error:
        sys.exit(error_line(error))
    except KeyboardInterrupt as interrupt:
        exit_interrupted(interrupt, "the same command continues the search")
    if not values:
        sys.exit(error_line(f"every trial failed; see {args.folder / 'trials.csv'}"))
    print(
        f"best of {len(values)}: {max(values):.3f}; all of them are in {args.folder / 'trials.csv'}"
    )


if __name__ == "__main__":
    end_with_one_line("nothing was written")
    main()
