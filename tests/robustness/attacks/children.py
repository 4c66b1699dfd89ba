"""Many attempts, one after another, in child processes: a crash or a hang ends only one of them.

An attempt is a function from a number to a word for its outcome.
"""

import os
import resource
import select
import signal
import traceback

REFUSED, RAN = "refused", "ran"
SECONDS, MEGABYTES = 20, 1500
repeating = False  # True for one attempt in this process, whose messages are shown


def outcomes(attempt, numbers, per_child, seconds=SECONDS, megabytes=MEGABYTES):
    """Yield `(number, word)` for each number, in order; `per_child` attempts share a process.

    A process may use so many `megabytes` more than this one.

    Words besides those of `attempt`: `crash: SIGNAL`, `hang` (more than `seconds`), `traceback:
    ERROR` for an exception that `attempt` raised.
    """
    numbers = list(numbers)
    while numbers:
        batch = numbers[:per_child]
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reader)
            _attempts(attempt, batch, writer, megabytes)
        os.close(writer)
        done = 0
        hangs = False
        for word in _lines(reader, seconds):
            if word is None:
                hangs = True
                os.kill(child, signal.SIGKILL)
                break
            yield batch[done], word
            done += 1
        os.close(reader)
        _, status = os.waitpid(child, 0)
        if done < len(batch):
            died = os.WIFSIGNALED(status)
            crash = f"crash: {signal.Signals(os.WTERMSIG(status)).name if died else 'it ended'}"
            yield batch[done], "hang" if hangs else crash
            done += 1
        numbers = numbers[done:]


def _lines(reader, seconds):
    """Lines of a pipe until its end; None for a line that takes too long."""
    left = b""
    while True:
        ready, _, _ = select.select([reader], [], [], seconds)
        read = os.read(reader, 2**16) if ready else None
        if not read:
            return (yield None) if read is None else None
        *whole, left = (left + read).split(b"\n")
        yield from (line.decode() for line in whole)


def _attempts(attempt, numbers, writer, megabytes):
    try:
        with open("/proc/self/statm") as file:
            has = int(file.read().split()[0]) * resource.getpagesize()
        limit = has + 2**20 * megabytes
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in numbers:
            try:
                word = attempt(number)
            except BaseException as error:
                where = traceback.extract_tb(error.__traceback__)[-1]
                word = f"traceback: {type(error).__name__} in {where.name}"
            os.write(writer, (word.replace("\n", " ") + "\n").encode())
    finally:
        os._exit(0)
