"""Journals: the results of a long job so far, beside the file that it will write."""

import json
import os
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from roboarm_nmp.envs.scenes.primitives import scene_to_json
from roboarm_nmp.envs.tasks import get_task
from roboarm_nmp.utils.files import lock_file

VERSION = 4


def journal_of(path: Path) -> Path:
    """Path of the journal of a file."""
    return path.with_name(path.name + ".journal")


def line_of(entry: Mapping[str, Any]) -> bytes:
    """A line of a journal: a checksum and a JSON-ready dict."""
    content = json.dumps(entry).encode()
    return b"%08x %s\n" % (zlib.crc32(content), content)


def _entry_of(line):
    """The dict of a line (without its newline); None: the line is damaged."""
    checksum, _, content = line.partition(b" ")
    return json.loads(content) if checksum == b"%08x" % zlib.crc32(content) else None


class Journal:
    """Results so far: lines of JSON with a checksum. The first line is a header with the options.

    Lines are appended and flushed one at a time, so a kill can damage the last line only. Opening a
    journal drops an incomplete last line, and other lines whose checksum does not match with a
    message on stderr. One process at a time holds the journal.

    Attributes:
        entries: the results so far, by their index.

    Args:
        path: file to continue, or to begin.
        options: JSON-ready dict of what the results depend on, `task` among them. The task's scene
            is added.

    Raises:
        ValueError: the file is the journal of another job, not a journal, or in use.
        OSError: the file cannot be written.
    """

    def __init__(self, path: Path, options: Mapping[str, Any]):
        self.path = path
        self.entries: dict[int | str, dict[str, Any]] = {}
        scene = scene_to_json(get_task(options["task"]).base_scene)
        header = {"journal": VERSION, **options, "scene": scene}
        self._file = open(path, "a+b", buffering=0)  # noqa: SIM115 (closed by `close`)
        if not lock_file(self._file, wait=False):
            raise ValueError(f"{path}: another process is writing to it")
        if not path.exists() or not os.path.samestat(os.fstat(self._file.fileno()), path.stat()):
            raise ValueError(f"{path}: another process has just finished it")
        self._file.seek(0)
        contents = self._file.read()
        lines = contents.split(b"\n")
        entries = [_entry_of(line) for line in lines[:-1]]  # the last one is incomplete or empty
        if entries and entries[0] != header:
            raise ValueError(_difference(path, entries[0], header))
        if not entries and not line_of(header).startswith(contents):
            raise ValueError(_difference(path, None, header))  # nor an incomplete header
        self.entries = {entry["index"]: entry for entry in entries[1:] if entry is not None}
        damaged = entries.count(None)
        if damaged:
            print(f"{path}: damaged, {damaged} of its lines are made again", file=sys.stderr)
        good = len(contents) - len(lines[-1])
        self._file.truncate(good)
        if good == 0:
            self._write(header)

    def append(self, entry: dict[str, Any]) -> None:
        """Write a JSON-ready dict with an `index`. When this returns, a kill cannot lose it."""
        self._write(entry)
        self.entries[entry["index"]] = entry

    def _write(self, entry):
        line = line_of(entry)
        end = self._file.seek(0, 2)
        try:
            if self._file.write(line) != len(line):  # the disk is full
                raise OSError("No space left on device")
        except OSError:
            self._file.truncate(end)
            raise

    def close(self) -> None:
        """Release the journal. One without entries is deleted."""
        if not self.entries:
            self.path.unlink(missing_ok=True)
        self._file.close()


def _difference(path, stored, expected):
    """Why a journal with this header, the stored one, is not that of the expected one."""
    if not isinstance(stored, dict) or stored.get("journal") != VERSION:
        return f"{path}: not a journal that this version can continue; move or delete it"
    differences = []
    for name, value in expected.items():
        if name == "scene" and stored.get(name) != value:
            differences.append("another scene")
        elif stored.get(name) != value:
            differences.append(f"{name} {stored.get(name)!r}, not {value!r}")
    return (
        f"{path}: the journal of something else ({', '.join(differences)}): continue it with its "
        f"flags, or delete it"
    )
