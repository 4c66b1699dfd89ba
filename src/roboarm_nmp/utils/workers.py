"""Spreading jobs over local processes, or over an existing Ray cluster.

A job is a small picklable value. `make_worker(*arguments)` is called once in each process and
returns the function that does jobs; it has an importable, top-level name.
"""

import collections
import concurrent.futures
import contextlib
import importlib.util
import itertools
import multiprocessing
import os
import re
import signal
import socket
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import resource_tracker
from typing import Any, TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")

MAX_DEATHS = 5  # without a single result between them


def run(
    make_worker: Callable[..., Callable[[Job], Result]],
    arguments: tuple,
    jobs: Iterable[Job],
    workers: int,
    warn: Callable[[str], Any] = print,
) -> Generator[Result, None, None]:
    """Yield the results of all jobs in the order of completion, from `workers` processes.

    A process that dies is replaced, its job is repeated, and `warn` is called with a sentence. If
    the caller is interrupted or closes this generator, running jobs are aborted.

    Raises:
        BrokenProcessPool, a RuntimeError: processes died `MAX_DEATHS` times without a result
            between.
        Exception: the exception of a job.
    """
    waiting = collections.deque(jobs)
    deaths = 0
    while waiting:
        with starting_processes():
            executor = concurrent.futures.ProcessPoolExecutor(
                workers, multiprocessing.get_context("spawn"), _start, (make_worker, arguments)
            )
        running = {}
        try:
            while waiting or running:
                while waiting and len(running) < 2 * workers:
                    with starting_processes():  # at the first job
                        running[executor.submit(_work, waiting[0])] = waiting[0]
                    waiting.popleft()
                done, _ = concurrent.futures.wait(
                    running, return_when=concurrent.futures.FIRST_COMPLETED
                )
                for future in sorted(done, key=lambda future: future.exception() is not None):
                    result = future.result()
                    del running[future]
                    deaths = 0
                    yield result
        except BrokenProcessPool as error:
            waiting.extendleft(running.values())
            deaths += 1
            if deaths == MAX_DEATHS:
                raise BrokenProcessPool(f"workers died {deaths} times without a result") from error
            warn("a worker died; a new one takes its place")
        except BaseException:
            # Without this, `shutdown` would wait for running jobs, which may take minutes.
            for process in executor._processes.values():
                process.terminate()
            raise
        finally:
            executor.shutdown(cancel_futures=True)


def in_order(
    work: Callable[[Job], Result], jobs: Iterable[Job], workers: int
) -> Generator[Result, None, None]:
    """Yield `work(job)` of every job, in their order; `workers` processes work ahead.

    Args:
        work: a picklable function.
        jobs: an iterable, which may be endless: closing this generator ends the processes.
        workers: >= 0; without a process, a job is done when its result is asked for.

    Raises:
        BrokenProcessPool: a process died.
        Exception: the exception of a job.
    """
    if workers == 0:
        yield from map(work, jobs)
        return
    waiting = iter(jobs)
    running = collections.deque()
    # Not ended by the SIGTERM of a process group (`timeout`): the caller finishes its step first.
    executor = concurrent.futures.ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), _start, (_same, (work,), False)
    )
    try:
        while True:
            for job in itertools.islice(waiting, 2 * workers - len(running)):
                with starting_processes():
                    running.append(executor.submit(_work, job))
            if not running:
                return
            yield running.popleft().result()
    except BaseException:
        # Without this, `shutdown` would wait for running jobs, and after a death for ever. Nor is
        # the rest of a result waited for that a process was sending when it was killed.
        executor._result_queue._writer.close()  # pyright: ignore[reportAttributeAccessIssue]
        for process in executor._processes.values():
            process.kill()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def _same(work):
    return work


@contextlib.contextmanager
def starting_processes() -> Iterator[None]:
    """A context for starting processes: SIGINT and SIGTERM, also of a terminal, wait for its end.

    Neither this process is interrupted between two of its steps, nor a new one killed while this
    one writes to it, which would wait for ever. New processes begin with both signals blocked.
    """
    numbers = {signal.SIGINT, signal.SIGTERM}
    arrived = []
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        for number in numbers:  # not only blocked: another thread may receive them
            if callable(signal.getsignal(number)):
                handlers[number] = signal.signal(number, lambda sent, frame: arrived.append(sent))
    resource_tracker.ensure_running()  # before: its start unblocks both signals
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in arrived:
            signal.raise_signal(number)


def begin_worker(is_terminable: bool = True) -> None:
    """What a process of `starting_processes` does first. It ends when its parent was killed.

    Args:
        is_terminable: whether SIGTERM ends the process, too.
    """
    # SIGINT stays blocked: a terminal sends Ctrl-C to this process, too, but the parent handles it.
    if is_terminable:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    threading.Thread(target=_follow_parent, daemon=True).start()


def _start(make_worker, arguments, is_terminable=True):
    global _worker
    begin_worker(is_terminable)
    _worker = make_worker(*arguments)


def _follow_parent():
    """End this worker when its parent was killed. Otherwise it would wait for work for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work(job):
    return _worker(job)


def check_ray(address: str | None) -> None:
    """Raise ValueError unless an address may be that of a Ray cluster, or is None: no cluster."""
    if address is None:
        return
    host, _, port = address.rpartition(":")
    if address != "auto" and not (
        re.fullmatch(r"[^/\s:]+", host) and re.fullmatch(r"\d{1,5}", port) and int(port) < 2**16
    ):
        raise ValueError(f"--ray-address must be `auto` or HOST:PORT, got {address!r}")
    if importlib.util.find_spec("ray") is None:
        raise ValueError('--ray-address needs the extra `cluster`: pip install -e ".[cluster]"')
    if address == "auto":
        return
    try:  # without an answer, Ray would wait
        socket.create_connection((host, int(port)), timeout=5).close()
    except OSError as error:
        raise ValueError(f"no Ray cluster at {address}: {error}") from error


def run_on_ray(
    address: str,
    make_worker: Callable[..., Callable[[Job], Result]],
    arguments: tuple,
    jobs: Iterable[Job],
) -> Generator[Result, None, None]:
    """Like `run`, on the Ray cluster at `address`. Ray repeats the jobs of lost workers and nodes.

    The cluster's machines need this project installed. Raises ConnectionError if there is no
    cluster at the address.
    """
    import ray  # pyright: ignore[reportMissingImports]

    ray.init(address=address, log_to_driver=False, logging_level="warning")
    try:
        # Spread over all nodes. Retried without end, because nodes may be lost.
        work = ray.remote(num_cpus=1, max_retries=-1, scheduling_strategy="SPREAD")(_work_on_ray)
        waiting = collections.deque(jobs)
        running = []
        while waiting or running:
            capacity = 2 * max(1, int(ray.cluster_resources().get("CPU", 1)))
            while waiting and len(running) < capacity:
                running.append(work.remote(make_worker, arguments, waiting.popleft()))
            done, running = ray.wait(running)
            yield from ray.get(done)
    finally:
        ray.shutdown()


_ray_workers = {}


def _work_on_ray(make_worker, arguments, job):
    key = repr((make_worker.__qualname__, arguments))
    if key not in _ray_workers:
        _ray_workers[key] = make_worker(*arguments)
    return _ray_workers[key](job)
