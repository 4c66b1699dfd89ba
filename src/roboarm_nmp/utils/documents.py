"""YAML and JSON files, read without executing anything, as values that know their line.

A file becomes a tree of `Node`s, and the functions at the end read numbers, lists and mappings from
them. What is wrong with a file is a `Mistake` at a line. Sizes are limited, so a hostile file costs
neither much memory nor much time.
"""

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

MAX_FILE = 50_000_000  # bytes
MAX_NODES = 3_000_000  # values, those that aliases repeat included
MAX_DEPTH = 30  # of nested values
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_CONSTANTS = {
    **{"": None, "~": None, "null": None, "true": True, "false": False},
    **{".inf": math.inf, "-.inf": -math.inf, ".nan": math.nan},
}
_NOT_ALLOWED = yaml.reader.Reader.NON_PRINTABLE


class DocumentError(ValueError):
    """A file that cannot be used. The message is `PATH:LINE: reason`, or `PATH: reason`."""


class Key(str):
    """A key of a mapping, with its line."""

    line: int


class Node:
    """A value in a file.

    Attributes:
        value: text, a list of `Node`s, or a dict from `Key` to `Node`.
        line: where it begins, from 1.
        is_quoted: whether text stands in quotes. Then it is text, even if it looks like a number.
    """

    __slots__ = ("is_quoted", "line", "size", "value")

    def __init__(self, value: "str | list[Node] | dict[Key, Node]", line: int):
        self.value = value
        self.line = line
        self.is_quoted = False
        self.size = 1  # values in it and itself; 0 until its end has been read


class Mistake(Exception):
    """Something wrong at a line of a file; who reads the file adds the path."""

    def __init__(self, node: Node | Key, reason: str):
        super().__init__(node.line, reason)
        self.line = node.line
        self.reason = reason


@contextlib.contextmanager
def mistakes_in(path: str | Path) -> Iterator[None]:
    """Turn each `Mistake` into a `DocumentError` that names the file and the line."""
    try:
        yield
    except Mistake as mistake:
        raise DocumentError(f"{path}:{mistake.line}: {mistake.reason}") from mistake


@contextlib.contextmanager
def errors_at(node: "Node | Key", what: str = "") -> Iterator[None]:
    """Turn each ValueError into a `Mistake` at the line of a node; `what` begins its reason."""
    try:
        yield
    except ValueError as error:
        raise Mistake(node, f"{what}: {error}" if what else str(error)) from error


def read_text(path: str | Path) -> str:
    """The text of a file. Raises DocumentError: it cannot be read, is too large, or is no text."""
    path = Path(path)
    try:
        if path.exists() and not path.is_file():  # a pipe would never end
            raise DocumentError(f"{path}: no regular file")
        if path.stat().st_size > MAX_FILE:
            raise DocumentError(f"{path}: more than {MAX_FILE // 1_000_000} MB")
        return path.read_bytes().decode()
    except OSError as error:
        raise DocumentError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise DocumentError(
            f"{path}:{line}: byte {error.object[error.start]:#04x} is not UTF-8 text"
        ) from error


def load_document(path: str | Path, allow_tags: bool = True) -> Node:
    """As `parse_document`, of a file.

    Raises DocumentError: the file cannot be read, is malformed, or exceeds a limit.
    """
    with mistakes_in(path):
        return parse_document(read_text(path), allow_tags)


def parse_document(text: str, allow_tags: bool = True) -> Node:
    """The root `Node` of a YAML or JSON text. `allow_tags`: ignore YAML's tags, such as `!a`.

    Raises Mistake: it is malformed, or exceeds a limit.
    """
    if character := _NOT_ALLOWED.search(text):
        line = text.count("\n", 0, character.start()) + 1
        raise Mistake(Node("", line), f"character {ord(character[0]):#x} is not allowed")
    try:
        return _compose(yaml.parse(text, _LOADER), allow_tags)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        reason = " ".join(str(error.problem).split())
        if error.context and error.context_mark:
            reason = f"{error.context} from line {error.context_mark.line + 1} on, {reason}"
        raise Mistake(Node("", mark.line + 1 if mark else 1), reason) from error
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise Mistake(Node("", 1), f"not valid YAML ({reason})") from error


def _compose(events, allow_tags):
    """The root `Node` of the only document."""
    anchors: dict[str, Node] = {}
    root = None
    ended = False
    count = 0
    containers = []  # the lists and dicts around the present event
    counts = []  # how many values came before each of them
    keys = []  # of each: the key whose value comes next, if it is a dict
    for event in events:
        line = event.start_mark.line + 1
        if isinstance(event, yaml.DocumentStartEvent):
            ended = root is not None  # `---` may end a file, as `ros2 topic echo` writes it
        if isinstance(event, yaml.CollectionEndEvent):
            keys.pop()
            containers.pop().size = count - counts.pop()
        if not isinstance(event, yaml.NodeEvent):
            continue
        if ended:
            if isinstance(event, yaml.ScalarEvent) and not event.value:
                continue
            raise Mistake(Node("", line), "a second document begins: a file has only one")
        if isinstance(event, yaml.AliasEvent):
            node = anchors.get(event.anchor)
            alias = f"the alias {shorten(event.anchor)!r}"
            if node is None:
                raise Mistake(Node("", line), f"{alias} has no anchor before it")
            if not node.size:
                raise Mistake(Node("", line), f"{alias} stands for a value that contains it")
        else:
            node = Node("", line)
            if not allow_tags and getattr(event, "tag", None) is not None:
                raise Mistake(node, "tags (words that start with !) are not allowed")
            if isinstance(event, yaml.ScalarEvent):
                node.value = event.value
                node.is_quoted = event.style not in (None, "")
            else:
                node.value = [] if isinstance(event, yaml.SequenceStartEvent) else {}
                node.size = 0
            if event.anchor:
                anchors[event.anchor] = node
        count += max(node.size, 1)
        if count > MAX_NODES:
            values = f"{MAX_NODES:,} values, with those that aliases repeat"
            raise Mistake(Node("", line), f"more than {values}")
        if not containers:
            root = node
        elif isinstance(containers[-1].value, list):
            containers[-1].value.append(node)
        elif keys[-1] is not None:
            containers[-1].value[keys[-1]] = node
            keys[-1] = None
        else:
            keys[-1] = _key(node, containers[-1], line)
        if isinstance(event, yaml.CollectionStartEvent):
            if len(containers) == MAX_DEPTH:
                raise Mistake(node, "nested too deeply")
            containers.append(node)
            counts.append(count - 1)
            keys.append(None)
    if root is None or root.value == "" and not root.is_quoted:
        raise Mistake(Node("", 1), "the file is empty")
    return root


def _key(node, container, line):
    if not isinstance(node.value, str):
        raise Mistake(node, f"a key must be text, got {describe(node)}")
    if node.value in container.value:
        raise Mistake(Node("", line), f"the key {shorten(node.value)!r} stands twice")
    key = Key(node.value)
    key.line = line
    return key


def plain_data(node: Node) -> Any:
    """A node as dicts, lists, text, numbers, booleans and None."""
    value = node.value
    if isinstance(value, dict):
        return {str(key): plain_data(item) for key, item in value.items()}
    if isinstance(value, list):
        return [plain_data(item) for item in value]
    if node.is_quoted:
        return value
    if value in _CONSTANTS:
        return _CONSTANTS[value]
    if value[0] in "+-.0123456789":
        for kind in (int, float):
            with contextlib.suppress(ValueError):
                return kind(value)
    return value


# --- What readers ask of a node


def shorten(text: str) -> str:
    """At most 40 letters of a text, for a message, all of them printable."""
    text = text if len(text) <= 40 else text[:40] + "..."
    return text if text.isprintable() else repr(text)[1:-1]


def describe(node: Node) -> str:
    """A node in words, for a message."""
    if isinstance(node.value, dict):
        return "a mapping"
    if isinstance(node.value, list):
        return "a list"
    text = shorten(" ".join(node.value.split()))  # it may have line breaks
    return f"the text '{text}'" if node.is_quoted else text or "nothing"


def is_nothing(node: Node | None) -> bool:
    """Whether a node is missing, empty or null."""
    return node is None or not node.value or node.value in ("null", "~")


def switch(node: Node) -> bool | None:
    """True or False; None: the node is neither `true` nor `false`."""
    if node.is_quoted or node.value not in ("true", "false"):
        return None
    return node.value == "true"


def text(node: Node, what: str) -> str:
    """The text of a node. Raises Mistake: it is none."""
    if not isinstance(node.value, str):
        raise Mistake(node, f"{what} must be text, got {describe(node)}")
    return node.value


def mapping(node: Node, what: str) -> dict[str, Node]:
    """The dict of a node. Raises Mistake: it is none."""
    if not isinstance(node.value, dict):
        raise Mistake(node, f"{what} must be a mapping, got {describe(node)}")
    return node.value  # pyright: ignore[reportReturnType] (a `Key` is text)


def get(node: Node, key: str, what: str) -> Node:
    """The value of a key. Raises Mistake: the node is no dict, or lacks the key."""
    fields = mapping(node, what)
    if key not in fields:
        raise Mistake(node, f"{what} lacks {key}")
    return fields[key]


def sequence(node: Node, what: str, most: int | None = None) -> list[Node]:
    """The list of a node, which may be empty or null. Raises Mistake: it is none, or too long."""
    if is_nothing(node) and not isinstance(node.value, dict):
        return []
    if not isinstance(node.value, list):
        raise Mistake(node, f"{what} must be a list, got {describe(node)}")
    if most is not None and len(node.value) > most:
        raise Mistake(node, f"{what} has {len(node.value):,} entries, at most {most:,}")
    return node.value


def number(node: Node, what: str, most: float = math.inf, positive: bool = False) -> float:
    """A finite number. Raises Mistake: it is none, its size exceeds `most`, or it isn't positive.

    It is any number that Python's `float` reads, without quotes; also `1e-2`, which YAML 1.1 treats
    as text.
    """
    try:
        value = math.nan if node.is_quoted else float(node.value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise Mistake(node, f"{what} must be a finite number, got {describe(node)}")
    if abs(value) > most:
        raise Mistake(node, f"{what} must be at most {most:.0f}, got {describe(node)}")
    if positive and value <= 0:
        raise Mistake(node, f"{what} must be positive, got {describe(node)}")
    return value


def numbers(
    node: Node, what: str, count: int, most: float = math.inf, positive: bool = False
) -> tuple[Any, ...]:
    """A tuple of `count` finite numbers, floats. Raises Mistake: as `number`."""
    if not isinstance(node.value, list):
        raise Mistake(node, f"{what} must be a list of {count} numbers, got {describe(node)}")
    if len(node.value) != count:
        length = len(node.value)
        raise Mistake(node, f"{what} must be a list of {count} numbers, got {length}")
    return tuple(number(value, what, most, positive) for value in node.value)
