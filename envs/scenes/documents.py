"""YAML and JSON files of other programs as plain data, in which every value has its line.

Nothing in a file is executed: libyaml's events become `Node`s of text, lists and dicts. Sizes are
limited, so a hostile file costs neither much memory nor much time.
"""

import math
from pathlib import Path

import yaml

MAX_FILE, MAX_NODES, MAX_DEPTH = 50_000_000, 3_000_000, 30  # bytes; values; nested values
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class DocumentError(ValueError):
    """A file that cannot be used. The message is `PATH:LINE: reason`, or `PATH: reason`."""


class Node:
    """A value in a file: `value` is a str, a list of `Node`s, or a dict from str to `Node`."""

    __slots__ = ("line", "value")

    def __init__(self, value, line):
        self.value, self.line = value, line


class Mistake(Exception):
    """Something wrong at a line of a file; `load_document`'s caller adds the path."""

    def __init__(self, node, reason):
        super().__init__(node.line, reason)
        self.line, self.reason = node.line, reason


def read_text(path):
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


def load_document(path):
    """The root `Node` of a YAML or JSON file.

    Raises:
        DocumentError: the file cannot be read, is malformed, or exceeds a limit.
    """
    text = read_text(path)
    try:
        return _compose(yaml.parse(text, _LOADER))
    except Mistake as mistake:
        raise DocumentError(f"{path}:{mistake.line}: {mistake.reason}") from mistake
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise DocumentError(f"{path}:{line}: a character that is not allowed") from error
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        reason = " ".join(str(error.problem).split())
        raise DocumentError(f"{path}:{line}: {reason}") from error
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise DocumentError(f"{path}: not valid YAML ({reason})") from error


def _compose(events):
    """The root `Node` of the only document."""
    anchors, count, root = {}, 0, None
    open_nodes = []  # the lists and dicts around the present event, each with a pending key
    for event in events:
        if isinstance(event, yaml.DocumentStartEvent) and root is not None:
            raise Mistake(Node(None, event.start_mark.line + 1), "a second document")
        if isinstance(event, (yaml.SequenceEndEvent, yaml.MappingEndEvent)):
            open_nodes.pop()
        if not isinstance(event, yaml.NodeEvent):
            continue
        node = Node(None, event.start_mark.line + 1)
        count += 1
        if count > MAX_NODES:
            raise Mistake(node, f"more than {MAX_NODES:,} values")
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in anchors:
                raise Mistake(node, f"the alias {event.anchor[:40]!r} has no anchor before it")
            node = anchors[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            node.value = event.value
        else:
            node.value = [] if isinstance(event, yaml.SequenceStartEvent) else {}
        if open_nodes:
            _put(open_nodes[-1], node)
        else:
            root = node
        if isinstance(event, yaml.CollectionStartEvent):
            if len(open_nodes) == MAX_DEPTH:
                raise Mistake(node, "nested too deeply")
            open_nodes.append([node, None])
        if event.anchor and not isinstance(event, yaml.AliasEvent):
            anchors[event.anchor] = node
    if root is None:
        raise Mistake(Node(None, 1), "the file is empty")
    return root


def _put(open_node, node):
    """Add a value, or a key, to a list or dict."""
    (container, key), value = open_node, node.value
    if isinstance(container.value, list):
        container.value.append(node)
    elif key is not None:
        container.value[key] = node
        open_node[1] = None
    elif not isinstance(value, str):
        raise Mistake(node, "a key must be text")
    elif value in container.value:
        raise Mistake(node, f"the key {shorten(value)} stands twice")
    else:
        open_node[1] = value


# --- What readers ask of a node


def shorten(text):
    """Text for a message: printable, and at most 40 letters."""
    text = text if len(text) <= 40 else text[:40] + "..."
    return repr(text)


def describe(node):
    """A node in words, for a message."""
    if isinstance(node.value, str):
        return shorten(node.value)
    return "a list" if isinstance(node.value, list) else "a mapping"


def is_nothing(node):
    """Whether a node is missing, empty or null."""
    return node is None or not node.value or node.value in ("null", "~")


def mapping(node, what):
    """The dict of a node. Raises Mistake: it is none."""
    if not isinstance(node.value, dict):
        raise Mistake(node, f"{what} must be a mapping, got {describe(node)}")
    return node.value


def sequence(node, what, most=None):
    """The list of a node, which may be empty or null. Raises Mistake: it is none, or too long."""
    if is_nothing(node) and not isinstance(node.value, dict):
        return []
    if not isinstance(node.value, list):
        raise Mistake(node, f"{what} must be a list, got {describe(node)}")
    if most is not None and len(node.value) > most:
        raise Mistake(node, f"{what} has {len(node.value):,} entries, at most {most:,}")
    return node.value


def text(node, what):
    """The text of a node. Raises Mistake: it is none."""
    if not isinstance(node.value, str):
        raise Mistake(node, f"{what} must be text, got {describe(node)}")
    return node.value


def get(node, key, what):
    """The value of a key. Raises Mistake: the node is no dict, or lacks the key."""
    fields = mapping(node, what)
    if key not in fields:
        raise Mistake(node, f"{what} lacks {key}")
    return fields[key]


def number(node, what, most=math.inf):
    """A finite number. Raises Mistake: it is none, or its size exceeds `most`."""
    try:
        value = float(node.value)
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise Mistake(node, f"{what} must be a finite number, got {describe(node)}")
    if abs(value) > most:
        raise Mistake(node, f"{what} must be at most {most:g}, got {describe(node)}")
    return value


def numbers(node, what, count, most=math.inf):
    """A tuple of `count` finite numbers. Raises Mistake."""
    values = sequence(node, what)
    if len(values) != count:
        raise Mistake(node, f"{what} must be {count} numbers, got {len(values)}")
    return tuple(number(value, what, most) for value in values)
