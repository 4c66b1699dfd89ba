"""Collecting and verifying: the same file for any number of workers and of interruptions."""

import collections
import contextlib
import dataclasses
import itertools
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
import zlib
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import psutil
import pytest
from paths import ROOT
from trainers import roboarm

from roboarm_nmp import envs
from roboarm_nmp.datasets.demonstrations import load_demos, write_demos
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.journal import VERSION, line_of
from roboarm_nmp.demo_generation import collect
from roboarm_nmp.demo_generation.verify import VERDICTS, Verifier, verify
from roboarm_nmp.envs.following import follow
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.scenes.primitives import from_array, scene_to_json
from roboarm_nmp.planning.planner import Planner
from roboarm_nmp.utils import workers

TASK, NUM = "double_walls", 16


def options(**changes):
    """What a demonstration depends on, as the command's defaults have it."""
    return collect.options_of(collect.Args(TASK)) | changes


def words(output, *flags, num=NUM):
    """Of a command."""
    return ["collect", "--task", TASK, "--num", num, "--workers", 1, "--output", output, *flags]


def command(output, *flags, **more):
    return [sys.executable, "-m", "roboarm_nmp", *map(str, words(output, *flags, **more))]


def journal_lines(output):
    """The number of complete lines of the journal after the first, which holds the options."""
    journal = collect.journal_of(output)
    return max(journal.read_bytes().count(b"\n") - 1, 0) if journal.exists() else 0


@contextlib.contextmanager
def running(output, *flags, demos=2, **kwargs):
    """A collection in its own process group, once `demos` are in its journal."""
    process = subprocess.Popen(
        command(output, *flags, **kwargs),
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        wait_for(lambda: journal_lines(output) >= demos or process.poll() is not None)
        assert process.poll() is None, process.communicate()
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.005)


def worker_processes(process):
    workers = []
    for child in psutil.Process(process.pid).children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):  # it has ended since
            if "spawn_main" in " ".join(child.cmdline()):
                workers.append(child)
    return workers


def has_ended(process):
    try:
        return process.status() == psutil.STATUS_ZOMBIE  # orphans may wait for their init
    except psutil.NoSuchProcess:
        return True


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A file collected by one worker without interruption."""
    path = tmp_path_factory.mktemp("whole") / "demos.h5"
    result = roboarm(*words(path))
    assert result.returncode == 0, result.stderr
    assert f"{NUM} demonstrations from " in result.stdout and "solved" in result.stdout
    assert list(path.parent.iterdir()) == [path]
    return path


@pytest.fixture
def output(tmp_path):
    return tmp_path / "demos.h5"


def finish(output, whole, *flags):
    """Run the command on `output` to its end; the number of demonstrations it continues from."""
    result = roboarm(*words(output, *flags))
    assert result.returncode == 0, result.stderr
    assert output.read_bytes() == whole.read_bytes()
    assert list(output.parent.iterdir()) == [output]
    return int(re.search(rf"(\d+)/{NUM}, ", result.stderr).group(1))


# --- The same file


def test_a_demonstration_depends_on_its_number_alone(whole):
    collector, demos = collect.Collector(options()), load_demos(whole)
    for index in (11, 3):
        made = collector(index)
        assert made["index"] == index and made["digest"] == demos[index].digest
        assert made["plan_seed"] == demos.plan_seed[index]
        np.testing.assert_array_equal(collect._decode(made["plan"], 7), demos[index].plan)
    assert collect.Collector(options(seed=1))(3)["digest"] != demos[3].digest
    assert len(set(demos.digest.tolist())) == NUM


def test_collected_demonstrations_are_good(whole):
    demos, env = load_demos(whole), envs.make(TASK)
    assert demos.task == TASK and demos.seed == 0 and len(demos) == NUM
    assert not demos.collided.any()
    verifier = Verifier(whole, repair=False)
    assert [verifier(index) for index in range(NUM)] == [(i, "good", None) for i in range(NUM)]
    for demo in demos:
        execution = follow(env, demo.plan)
        assert execution.digest == demo.digest == zlib.crc32(execution.states.tobytes())
        assert execution.reached and not execution.collided
        assert len(demo.actions) == len(execution.states) - 1 <= env.horizon
    env.close()


def test_file_records_the_command_that_makes_it(whole):
    demos = load_demos(whole)
    assert demos.made_by.startswith("roboarm collect ")
    arguments = demos.made_by.split()[2:]
    flags = dict(zip(arguments[::2], arguments[1::2], strict=True))
    assert flags["--task"] == TASK and flags["--num"] == str(NUM) and flags["--seed"] == "0"
    assert set(flags) <= {f"--{name.replace('_', '-')}" for name in ("num", *collect.OPTIONS)}
    assert demos.parameters["options"] == options()


def test_pretrained_demonstrations_have_the_queries_of_their_seed():
    """Only their plans are those of an earlier planner (docs/guide/demonstrations.md)."""
    pretrained = load_demos("random_boxes_hard")
    collector = collect.Collector(options(task="random_boxes_hard"))
    for index in (0, 4_321):
        demo = collector(index)
        assert demo["given_up"] == 0
        plan = collect._decode(demo["plan"], 7)
        assert plan[[0, -1]].tobytes() == pretrained[index].plan[[0, -1]].tobytes()
        assert from_array(demo["obstacles"]) == pretrained[index].scene.obstacles


# --- Interrupted, killed, damaged


def test_killed_worker_is_replaced(whole, output):
    with running(output, "--workers", "2") as process:
        victim = worker_processes(process)[0]
        victim.kill()
        stdout, stderr = process.communicate(timeout=100)
    assert process.returncode == 0, stderr
    assert "a worker died" in stdout + stderr and "Traceback" not in stderr
    assert output.read_bytes() == whole.read_bytes()
    assert list(output.parent.iterdir()) == [output]


def test_killed_run_continues_and_leaves_no_workers(whole, output):
    with running(output, "--workers", "2", demos=3) as process:
        children = worker_processes(process)
        process.kill()
        assert process.wait() == -signal.SIGKILL
        assert len(children) == 2
        wait_for(lambda: all(has_ended(child) for child in children), 20)
    collected = journal_lines(output)
    assert 3 <= collected < NUM and not output.exists()
    assert finish(output, whole) == collected


@pytest.fixture(scope="module")
def journal():
    """The journal of a collection that was killed just before it wrote its file."""
    scene = scene_to_json(envs.TASKS[TASK].scene)
    collector = collect.Collector(options())
    made = [collector(index) for index in reversed(range(NUM))]
    lines = [{"journal": VERSION, **options(), "scene": scene}, *made]
    return b"".join(map(line_of, lines))


def entry_of(line):
    return json.loads(line[9:])


def test_flipped_bit_drops_its_entry_and_is_reported(whole, journal, output):
    rng, flipped = np.random.default_rng(0), bytearray(journal)
    flipped[rng.integers(journal.index(b"\n") + 1, len(journal) - 1)] ^= 1 << rng.integers(8)
    collect.journal_of(output).write_bytes(flipped)
    result = roboarm(*words(output))
    assert result.returncode == 0 and output.read_bytes() == whole.read_bytes()
    assert f"{collect.journal_of(output)}: damaged, " in result.stderr
    begun = int(re.search(rf"(\d+)/{NUM}, ", result.stderr).group(1))
    assert NUM - 2 <= begun < NUM  # two of them, if it was the end of a line


def test_full_disk_keeps_the_journal(whole, output):
    def small_files():
        resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))  # bytes

    result = subprocess.run(
        command(output), cwd=ROOT, capture_output=True, text=True, preexec_fn=small_files
    )
    assert result.returncode == 1 and "Traceback" not in result.stderr
    assert result.stderr.strip().splitlines()[-1].startswith("what was collected is safe")
    contents = collect.journal_of(output).read_bytes()
    assert contents.endswith(b"\n") and 1000 < len(contents) <= 9000
    for line in contents.splitlines(keepends=True):
        assert line == line_of(entry_of(line))
    assert list(output.parent.iterdir()) == [collect.journal_of(output)]
    collected = journal_lines(output)
    assert collected >= 1
    assert finish(output, whole) == collected


# --- Rejected


def rejection(args):
    """The message of a command that rejects its arguments at once."""
    begin = time.monotonic()
    with pytest.raises(SystemExit) as ended:
        collect.main(args)
    assert time.monotonic() - begin < 10
    message = ended.value.code
    assert isinstance(message, str) and "\n" not in message
    return message


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"task": "double_wals"}, "unknown task 'double_wals': did you mean double_walls"),
        ({"task": "three_shelves"}, "three_shelves is for testing only"),
        ({"ray_address": "x"}, "--ray-address must be `auto` or HOST:PORT"),
        ({"output": Path("missing/demos.h5")}, "cannot write .*missing/demos.h5: No such file"),
    ],
)
def test_bad_flag_is_rejected_before_any_work(tmp_path, arguments, complaint):
    output = tmp_path / arguments.pop("output", "demos.h5")
    args = collect.Args(**({"task": TASK, "num": 4, "output": output} | arguments))
    assert re.search(complaint, rejection(args))
    assert list(tmp_path.iterdir()) == []


def test_existing_file_is_rejected_without_overwrite(output):
    output.write_bytes(b"precious")
    args = collect.Args(TASK, num=NUM, output=output)
    assert rejection(args).endswith(f": {output} exists; --overwrite replaces it")
    assert output.read_bytes() == b"precious" and list(output.parent.iterdir()) == [output]


def test_file_that_is_no_journal_is_left_unchanged(output):
    path, contents = collect.journal_of(output), b"dear diary,\ntoday was fine\n"
    path.write_bytes(contents)
    assert f"{path}: not a journal" in rejection(collect.Args(TASK, num=1, output=output))
    assert path.read_bytes() == contents


# --- Workers


def test_workers_that_always_die_are_an_error():
    warnings = []
    with pytest.raises(RuntimeError, match="workers died 5 times without a result"):
        list(workers.run(os._exit, (1,), range(3), 2, warn=warnings.append))
    assert len(warnings) == 4 and all("a worker died" in text for text in warnings)


def test_death_of_a_worker_ends_results_in_order():
    results = workers.in_order(abs, itertools.count(), 2)
    children = [next(results) for _ in range(9)] and worker_processes(psutil.Process())
    children[0].kill()
    with pytest.raises(BrokenProcessPool):
        collections.deque(results)
    assert all(has_ended(child) for child in children)


# --- Verifying and repairing


@pytest.fixture(scope="module")
def exact(whole):
    """Plan, exact execution (the file's is rounded) and seed of each demonstration of `whole`."""
    demos = load_demos(whole)
    with contextlib.closing(envs.make(TASK)) as env:
        return [
            [demo.plan, follow(env, demo.plan), int(seed)]
            for demo, seed in zip(demos, demos.plan_seed, strict=True)
        ]


@pytest.fixture(scope="module")
def straight(exact):
    """The same, straight from start to goal, with collisions."""
    with contextlib.closing(envs.make(TASK)) as env:
        return [[plan[[0, -1]], follow(env, plan[[0, -1]]), seed] for plan, _, seed in exact]


@pytest.fixture(scope="module")
def colliding():
    """A configuration inside the limits and in collision."""
    rng = np.random.default_rng(0)
    with contextlib.closing(envs.make(TASK)) as env:
        while True:
            configuration = rng.uniform(0.9 * PANDA.lower, 0.9 * PANDA.upper).astype(np.float32)
            if env.in_collision(configuration):
                return configuration


def write(path, demos, parameters=None):
    plans, executions, seeds = zip(*demos, strict=True)
    write_demos(
        path,
        TASK,
        0,
        plans,
        [execution.states for execution in executions],
        {
            "plan_seed": seeds,
            "digest": [execution.digest for execution in executions],
            "collided": [execution.collided for execution in executions],
        },
        "made by a test",
        {"options": options()} if parameters is None else parameters,
    )
    return path


def starting_at(configuration, demo):
    plan = demo[0].copy()
    plan[0] = configuration
    return [plan, *demo[1:]]


@pytest.fixture
def damaged(output, exact, straight, colliding):
    """A file with bad demonstrations, and a dict from their verdict to their number."""
    collided = next(i for i, (_, e, _) in enumerate(straight) if e.collided and e.reached)
    missed = next(i for i, (_, e, _) in enumerate(straight) if not e.reached)
    changed, refused = [i for i in range(NUM) if i not in (collided, missed)][4:6]
    demos = list(exact)
    for i in (collided, missed):
        demos[i] = straight[i]
    plan, execution, seed = exact[changed]
    demos[changed] = [plan, dataclasses.replace(execution, digest=execution.digest ^ 1), seed]
    demos[refused] = starting_at(colliding, exact[refused])
    bad = {"collided": collided, "missed": missed, "changed": changed, "refused": refused}
    return write(output, demos), bad


def verdicts(path):
    verifier = Verifier(path, repair=False)
    return [verifier(index)[1] for index in range(len(verifier.demos))]


def test_verify_finds_bad_demonstrations(damaged):
    path, bad = damaged
    before = path.read_bytes()
    expected = ["good"] * NUM
    for verdict, index in bad.items():
        expected[index] = verdict
    assert verdicts(path) == expected
    result = roboarm("verify", path, "--workers", 1)
    assert result.returncode == 1
    lines = result.stdout.splitlines()
    one_each = "1 changed, 1 missed, 1 collided, 1 refused"
    assert f"{path}: {NUM - 4} good, {one_each} of {NUM} demonstrations" in lines
    assert path.read_bytes() == before


def test_repair_replaces_or_removes_bad_demonstrations(damaged):
    path, bad = damaged
    old = load_demos(path)
    result = roboarm("verify", path, "--repair", "--workers", 1)
    assert result.returncode == 0, result.stderr
    assert "; 3 repaired, 1 removed" in result.stdout
    demos = load_demos(path)
    assert (demos.parameters["repaired"], demos.parameters["removed"]) == (3, 1)
    assert demos.made_by == old.made_by and demos.parameters["options"] == options()
    assert not demos.collided.any()
    kept = [i for i in range(NUM) if i != bad["refused"]]
    for demo, seed, i in zip(demos, demos.plan_seed, kept, strict=True):
        planned_anew = i in (bad["collided"], bad["missed"])
        np.testing.assert_array_equal(demo.start, old[i].start)
        np.testing.assert_array_equal(demo.goal, old[i].goal)
        assert (demo.plan.tobytes() != old[i].plan.tobytes()) == planned_anew
        assert (seed != old.plan_seed[i]) == planned_anew
        assert (demo.digest != old[i].digest) == (planned_anew or i == bad["changed"])
    none = dict.fromkeys(VERDICTS, 0)
    expected = none | {"good": NUM - 1, "total": NUM - 1, "removed": 0}
    assert verify(path, progress=False) == expected


def test_states_that_differ_from_the_execution_are_found(output, exact):
    demos = list(exact[:3])
    states = demos[1][1].states.copy()
    states[5, 3] += 0.002
    demos[1] = [demos[1][0], dataclasses.replace(demos[1][1], states=states), demos[1][2]]
    assert verdicts(write(output, demos)) == ["good", "changed", "good"]


def test_collisions_are_rejected_unless_allowed(output, straight):
    allowed, clean = (collect.Collector(options(allow_collisions=yes)) for yes in (True, False))
    for collector in (allowed, clean):
        collector.planner = Planner(collector.env, lambda _, *ends: np.stack(ends[:2]))
        collector.planner.simplify = 0
    index = next(index for index in range(60) if allowed(index)["collided"])
    made = clean(index)
    assert not made["collided"] and made["given_up"] >= 1
    assert made["rejected"]["collided"] in (3, 6, 9)  # all three attempts on a query are straight
    # Verified by the same rule as collected.
    reached = [demo for demo in straight if demo[1].reached]
    loose = {"options": options(allow_collisions=True)}
    assert set(verdicts(write(output, reached, loose))) == {"good"}
    assert load_demos(output).collided.tolist() == [demo[1].collided for demo in reached]
    assert set(verdicts(write(output, reached))) == {"good", "collided"}


def test_file_without_options_or_without_a_repairable_demonstration_is_an_error(
    output, exact, colliding
):
    write(output, exact[:2], parameters={})  # it does not say with what options
    with pytest.raises(DatasetError, match=str(output)):
        verify(output, num_workers=1, progress=False)
    before = write(output, [starting_at(colliding, exact[0])]).read_bytes()
    with pytest.raises(DatasetError, match=str(output)):
        verify(output, num_workers=1, repair=True, progress=False)
    assert output.read_bytes() == before


def test_verify_continues_after_a_bad_file(whole, tmp_path):
    (tmp_path / "bad.h5").write_bytes(whole.read_bytes()[:3000])
    result = roboarm("verify", tmp_path / "bad.h5", tmp_path / "none.h5", whole, "--workers", 1)
    assert result.returncode == 1 and "Traceback" not in result.stderr
    assert "bad.h5: " in result.stderr and "none.h5: no such file" in result.stderr
    assert f"{whole}: {NUM} good" in result.stdout


# --- On a cluster


@pytest.mark.slow
def test_cluster_that_loses_a_node_collects_the_same_bytes(output, tmp_path, cluster):
    num = 150
    local = tmp_path / "local.h5"
    assert roboarm(*words(local, num=num)).returncode == 0
    with running(output, "--ray-address", cluster.address, demos=40, num=num) as process:
        cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
        assert journal_lines(output) < num - 40
        _, stderr = process.communicate(timeout=300)
    assert process.returncode == 0, stderr
    assert output.read_bytes() == local.read_bytes()
