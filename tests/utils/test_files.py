"""Files on file systems that have no locks."""

import errno
import fcntl
import multiprocessing

import pytest

from roboarm_nmp.datasets.journal import Journal
from roboarm_nmp.utils import files


def _without_locks(*_):
    raise OSError(errno.ENOLCK, "No locks available")


def test_files_are_written_without_locks_and_that_is_said_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(fcntl, "flock", _without_locks)
    files._warn_without_locks.cache_clear()
    for content in (b"one", b"two"):
        files.write_atomically(tmp_path / "file", content)
    assert (tmp_path / "file").read_bytes() == b"two"
    Journal(tmp_path / "journal", {"task": "no_obstacles"}).close()
    assert capsys.readouterr().err == (
        f"no file locks in {tmp_path}: do not let two processes write the same file there\n"
    )


def _hold(path, ready, done):
    with open(path, "ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        ready.set()
        done.wait()


def test_journal_that_another_process_writes_is_in_use(tmp_path):
    context = multiprocessing.get_context("spawn")
    ready, done = context.Event(), context.Event()
    process = context.Process(target=_hold, args=(tmp_path / "journal", ready, done))
    process.start()
    ready.wait()
    with pytest.raises(ValueError, match="another process is writing to it"):
        Journal(tmp_path / "journal", {"task": "no_obstacles"})
    done.set()
    process.join()
