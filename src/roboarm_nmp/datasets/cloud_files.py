"""Point clouds from files: PLY, PCD, NPY, NPZ, or a depth image.

    points = load_cloud("table.ply")                           # float32 (n, 3), m
    points = load_cloud("table.pcd", units="mm", frame=(0.4, 0.0, 0.8, 1.0, 0.0, 0.0, 0.0))
    points = load_cloud("depth.png", frame=camera_pose, intrinsics=(525.0, 525.0, 319.5, 239.5))

- `.ply`: ASCII or binary, the coordinates x, y, z of the element `vertex`;
- `.pcd`: ASCII, binary or binary_compressed, the fields x, y, z. Its VIEWPOINT is not applied;
- `.npy`, `.npz`: numbers of shape (..., 3), or a structured array with x, y, z; in an archive the
  array `points`, or its only one. Pickled arrays are rejected without being unpickled;
- a depth image, with `intrinsics`: `.png` of 16 bits (grey), or `.npy`, `.npz` of shape (h, w).

Sizes in a file's header are compared with the file's length before memory is allocated.

The readers of PLY and PCD are the project's own. The libraries that were tried read every element
of a file, row by row in Python, or take minutes for a damaged header.
"""

import io
import math
import struct
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from tokenize import TokenError
from typing import IO

import numpy as np
from PIL import Image

from roboarm_nmp.datasets.lzf_kernels import decompress_lzf
from roboarm_nmp.envs.robots.rotations import matrix
from roboarm_nmp.envs.scenes.numbers import is_number, unit_quaternion

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""m per unit of length, by name."""
ENDINGS = (".ply", ".pcd", ".npy", ".npz", ".png")
MAX_POINTS = 20_000_000
MAX_BYTES = 2**30
"""Of a file."""
_MAX_LINE = 10_000  # bytes
_MAX_HEADER = 1000  # lines
_BLOCK = 2**22  # bytes, or rows, that are converted at once
_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_PLY_FORMATS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
_PCD_TYPES = {"I": "1248", "U": "1248", "F": "48"}  # sizes, bytes


class CloudError(ValueError):
    """A point cloud's file that cannot be used; the message is one line with its path."""


def load_cloud(
    path: str | Path,
    units: str | float | None = None,
    frame: np.ndarray | Sequence | None = None,
    intrinsics: Sequence[float] | None = None,
) -> np.ndarray:
    """Load the points in a file: float32 (n, 3), m, in the frame of the robot's base.

    Points without a measurement stay, as NaN. Pixels without a depth (0 or not finite) do not.

    Args:
        path: the file; its ending names the format (see the module).
        units: the unit of the file's lengths: a name in `UNITS`, or a number, m per unit. By
            default m, and mm for a PNG.
        frame: the pose of the file's frame in the base's frame: position (m) and quaternion
            (x, y, z, w), 7 numbers, or a homogeneous matrix (4, 4). By default both frames are the
            same. For a depth image, the pose of the camera: x to the right in the image, y down,
            z forwards.
        intrinsics: for a depth image: (fx, fy, cx, cy), pixels. A pixel in column u and row v with
            the depth z is the point ((u - cx) z / fx, (v - cy) z / fy, z).

    Raises:
        CloudError: the file does not exist, or has none of these formats.
        ValueError: `units`, `frame` or `intrinsics` is out of its range.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if units is None:
        units = "mm" if ending == ".png" else "m"
    scale = UNITS.get(units, math.nan) if isinstance(units, str) else units
    if not is_number(scale) or scale <= 0:
        raise ValueError(f"units must be {', '.join(UNITS)} or m per unit, got {units!r}")
    rotation, position = _pose(frame)
    if intrinsics is not None:
        _check_intrinsics(intrinsics)
    try:
        if ending not in ENDINGS:
            raise ValueError(f"a point cloud's file must end in {', '.join(ENDINGS)}")
        if ending == ".png" and intrinsics is None:
            raise ValueError("a depth image needs intrinsics: fx, fy, cx, cy")
        if not path.is_file():
            raise ValueError("no such file")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ValueError(f"it is larger than {MAX_BYTES // 2**20} MiB")
        with open(path, "rb") as file:
            points = _READERS[ending](file, size)
        if intrinsics is not None:
            points = _back_projected(points, *intrinsics)
        elif points.ndim < 2 or points.shape[-1] != 3:
            raise ValueError(f"it has the shape {points.shape}, not (..., 3)")
    except OSError as error:
        raise CloudError(f"{path}: {error.strerror or error}") from error
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        # The last one is zipfile's, for an unknown compression.
        raise CloudError(f"{path}: {' '.join(str(error).split())}") from error
    return _placed(points.reshape(-1, 3), float(scale), rotation, position)


def _pose(frame: np.ndarray | Sequence | None) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and position (3,), m, of a pose. Raises ValueError if it is none."""
    if frame is None:
        return np.eye(3), np.zeros(3)
    wrong = f"frame must be a pose, 7 finite numbers, or a matrix (4, 4), got {frame!r}"
    try:
        numbers = np.array(frame, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(wrong) from error
    if numbers.shape not in ((7,), (4, 4)) or not np.isfinite(numbers).all():
        raise ValueError(wrong)
    if numbers.shape == (7,):
        return matrix(unit_quaternion(numbers[3:].tolist())), numbers[:3]
    rotation = numbers[:3, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    if not is_rotation or np.linalg.det(rotation) < 0 or (numbers[3] != (0, 0, 0, 1)).any():
        raise ValueError("frame must be a rotation and a position, with the last row 0, 0, 0, 1")
    return rotation, numbers[:3, 3]


def _check_intrinsics(intrinsics: Sequence[float]) -> None:
    if len(intrinsics) != 4 or not all(map(is_number, intrinsics)) or min(intrinsics[:2]) <= 0:
        raise ValueError(f"intrinsics must be fx > 0, fy > 0, cx, cy (pixels), got {intrinsics}")


def _placed(
    points: np.ndarray, scale: float, rotation: np.ndarray, position: np.ndarray
) -> np.ndarray:
    """Points in units of `scale` (m) as float32, m, rotated and moved."""
    with np.errstate(over="ignore", invalid="ignore"):  # infinite ones are dropped later
        if scale == 1.0 and (rotation == np.eye(3)).all() and not position.any():
            return np.require(points, np.float32, ("C", "W"))
        placed = np.empty(points.shape, np.float32)
        for begin in range(0, len(points), _BLOCK):
            block = points[begin : begin + _BLOCK].astype(np.float64)
            placed[begin : begin + _BLOCK] = (scale * block) @ rotation.T + position
    return placed


def _back_projected(depth: np.ndarray, fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """The points (n, 3) of a depth image (h, w), in its unit; pixels without depth are left out."""
    if depth.ndim != 2:
        raise ValueError(f"a depth image has the shape (h, w), this array {depth.shape}")
    with np.errstate(invalid="ignore"):
        row, column = np.nonzero(np.isfinite(depth) & (depth > 0))
    z = depth[row, column].astype(np.float64)
    return np.stack([(column - cx) * z / fx, (row - cy) * z / fy, z], axis=1)


# --- Arrays. `np.load` would allocate whatever a header in an archive announces.


def _read_npy(file: IO[bytes], size: int) -> np.ndarray:
    """The numbers in an open .npy file of `size` bytes. Raises ValueError."""
    magic = file.read(8)
    if len(magic) < 8 or not magic.startswith(b"\x93NUMPY"):
        raise ValueError("not a .npy file (pickled arrays are not read)")
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    version = (magic[6], magic[7])
    if version not in readers:
        raise ValueError(f"version {magic[6]}.{magic[7]} of .npy is unknown")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)  # a header of Python 2
            shape, columns_first, dtype = readers[version](file)
    except (SyntaxError, TypeError, RecursionError, UserWarning, TokenError) as error:
        raise ValueError(f"its header is damaged: {error}") from error
    if dtype.hasobject:
        raise ValueError("it has pickled objects, which are not read")
    number = math.prod(shape)
    if min(shape, default=1) < 0 or number > 3 * MAX_POINTS or number * dtype.itemsize > size:
        raise ValueError(f"an array {shape} does not fit into its {size} bytes")
    contents = file.read(number * dtype.itemsize)
    if len(contents) < number * dtype.itemsize:
        raise ValueError("it ends too early")
    if not contents:  # such as shape (0, 3)
        return np.zeros(shape)
    array = np.frombuffer(contents, dtype).reshape(shape, order="F" if columns_first else "C")
    if dtype.names is not None:
        if not {"x", "y", "z"} <= set(dtype.names):
            raise ValueError(f"it has the fields {', '.join(dtype.names)}, but no x, y, z")
        array = np.stack([array[name] for name in "xyz"], axis=-1)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"it has {array.dtype}, not numbers")
    return array


def _read_npz(file: IO[bytes], _: int) -> np.ndarray:
    with zipfile.ZipFile(file) as archive:
        entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.filelist}
        if len(entries) != 1 and "points" not in entries:
            raise ValueError(f"it needs an array points, and has {', '.join(entries) or 'none'}")
        entry = entries.get("points", next(iter(entries.values())))
        if entry.file_size > MAX_BYTES:
            raise ValueError("it is too large")
        if entry.flag_bits & 1:
            raise ValueError("it is encrypted")
        with archive.open(entry) as contents:
            array = _read_npy(contents, entry.file_size)
            contents.read(1)  # the end, where the checksum is compared
            return array


def _read_png(file: IO[bytes], _: int) -> np.ndarray:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(file, formats=["PNG"]) as image:
                if image.mode not in ("I;16", "I;16B", "I"):
                    raise ValueError(f"it is of mode {image.mode}, not of 16 bits and grey")
                return np.asarray(image).astype(np.float32)
    except (SyntaxError, struct.error, Image.DecompressionBombWarning, AttributeError) as error:
        raise ValueError(f"a damaged image: {error}") from error
    except Image.DecompressionBombError as error:
        raise ValueError("it is too large") from error


# --- PLY and PCD: a header, then a table with a row for each point


class _Header:
    """The words of a header's lines, one line after another; counts lines."""

    def __init__(self, file: IO[bytes]):
        self.file = file
        self.line = 0

    def words(self) -> list[str]:
        """The words of the next line. Raises ValueError: there is none, or it is too long."""
        self.line += 1
        text = self.file.readline(_MAX_LINE)
        if not text.endswith(b"\n") or self.line > _MAX_HEADER:
            raise ValueError(f"line {self.line}: the header does not end")
        return text.decode("latin-1").split()

    def error(self, reason: str) -> ValueError:
        """A ValueError about the last line."""
        return ValueError(f"line {self.line}: {reason}")

    def number(self, word: str) -> int:
        """A count from 0 on. Raises ValueError."""
        if not (word.isascii() and word.isdigit() and len(word) < 12):
            raise self.error(f"{word!r} is not a number")
        return int(word)


class _Table:
    """Rows of fields, of which x, y and z are read.

    Args:
        fields: list of (name, dtype's letter and size, such as f4, number of values).
        order: "<" or ">", of bytes.
    """

    def __init__(self, fields: list[tuple[str, str, int]], order: str = "<"):
        names = [name for name, _, _ in fields]
        if any(names.count(axis) != 1 for axis in "xyz"):
            raise ValueError(f"it has the fields {' '.join(names)}, but no x, y, z")
        if any(count != 1 for name, _, count in fields if name in ("x", "y", "z")):
            raise ValueError("x, y and z must be single numbers")
        self.row_size = sum(int(kind[1]) * count for _, kind, count in fields)  # bytes
        self.width = sum(count for _, _, count in fields)  # words
        self.kinds = []
        self.offsets = []
        self.columns = []
        for axis in "xyz":
            at = names.index(axis)
            self.kinds.append(order + fields[at][1])
            self.offsets.append(sum(int(kind[1]) * count for _, kind, count in fields[:at]))
            self.columns.append(sum(count for _, _, count in fields[:at]))
        self.result = np.result_type(*self.kinds, np.float32)

    def check(self, number: int, room: int) -> None:
        """Raise ValueError unless there is room (bytes) for so many points."""
        if number > min(room, MAX_POINTS):
            raise ValueError(f"it announces {number:,} points, and has room for {room:,}")

    def from_binary(self, file: IO[bytes], number: int, room: int) -> np.ndarray:
        """The points (number, 3) in the next rows; `room`: bytes left in the file."""
        self.check(number, room // self.row_size)
        points = np.empty((number, 3), self.result)
        rows = max(_BLOCK // self.row_size, 1)
        for begin in range(0, number, rows):
            block = points[begin : begin + rows]
            contents = file.read(len(block) * self.row_size)
            if len(contents) < len(block) * self.row_size:
                raise ValueError("it ends too early")
            bytes_of_rows = np.frombuffer(contents, np.uint8).reshape(len(block), self.row_size)
            for axis, (kind, offset) in enumerate(zip(self.kinds, self.offsets, strict=True)):
                numbers = bytes_of_rows[:, offset : offset + int(kind[2])]
                block[:, axis] = np.ascontiguousarray(numbers).view(kind)[:, 0]
        return points

    def from_text(self, header: _Header, number: int, room: int) -> np.ndarray:
        """The points (number, 3) in the next lines."""
        self.check(number, (room + 1) // (2 * self.width))
        points = np.empty((number, 3))
        done = 0
        while done < number:
            text = header.file.read(_BLOCK) + header.file.readline(_MAX_LINE)
            if not text:
                raise ValueError(f"it ends after {done:,} of {number:,} points")
            rows = _numbers(text.decode("latin-1"), self.columns, number - done, header.line)
            points[done : done + len(rows)] = rows
            done += len(rows)
            header.line += text.count(b"\n")
        return points


def _numbers(text: str, columns: list[int], most: int, line: int) -> np.ndarray:
    """The columns of a text's lines: float64 (at most `most`, 3). `line`: those before the text."""
    rows = [row for row in text.split("\n") if row and not row.isspace()][:most]
    if not rows:
        return np.empty((0, 3))
    try:
        return np.loadtxt(rows, usecols=columns, ndmin=2, comments=None)
    except ValueError as error:
        for number, row in enumerate(text.split("\n"), line + 1):
            words = row.split()
            try:
                _ = words and [float(words[column]) for column in columns]
            except (ValueError, IndexError):
                raise ValueError(f"line {number}: not numbers: {row[:60]!r}") from error
        raise


def _read_ply(file: IO[bytes], size: int) -> np.ndarray:
    header = _Header(file)
    if header.words() != ["ply"]:
        raise ValueError("not a PLY file")
    form = None
    elements = []  # of each: name, number of rows, fields
    while (words := header.words()) != ["end_header"]:
        match words:
            case [("comment" | "obj_info"), *_] | []:
                pass
            case ["format", name, _] if name in _PLY_FORMATS:
                form = name
            case ["element", name, number]:
                elements.append((name, header.number(number), []))
            case ["property", "list", _, _, name] if elements:
                elements[-1][2].append((name, "list", 1))
            case ["property", kind, name] if elements and kind in _PLY_TYPES:
                elements[-1][2].append((name, _PLY_TYPES[kind], 1))
            case _:
                raise header.error(f"not understood: {' '.join(words)[:60]!r}")
    if form is None:
        raise ValueError("its header has no known format")
    skipped_rows = 0
    skipped_bytes = 0
    for name, number, fields in elements:
        has_list = any(kind == "list" for _, kind, _ in fields)
        if has_list and (name == "vertex" or form != "ascii"):
            raise ValueError(f"the element {name} has a list")
        if name == "vertex":
            break
        skipped_rows += number
        skipped_bytes += number * sum(int(kind[1]) for _, kind, _ in fields if kind != "list")
    else:
        raise ValueError("it has no element vertex")
    table = _Table(fields, _PLY_FORMATS[form] or "<")
    if form == "ascii":
        for _ in range(min(skipped_rows, size)):
            if not file.readline(_MAX_LINE):
                raise ValueError("it ends too early")
            header.line += 1
        return table.from_text(header, number, size - file.tell())
    file.seek(skipped_bytes, io.SEEK_CUR)
    return table.from_binary(file, number, max(size - file.tell(), 0))


def _read_pcd(file: IO[bytes], size: int) -> np.ndarray:
    header = _Header(file)
    entries: dict[str, list[str]] = {}
    while "DATA" not in entries:
        words = header.words()
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    names = entries.get("FIELDS", entries.get("COLUMNS", []))
    sizes = entries.get("SIZE", [])
    types = entries.get("TYPE", [])
    counts = entries.get("COUNT", ["1"] * len(names))
    if not (names and len(names) == len(sizes) == len(types) == len(counts)):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT must have as many words")
    fields = []
    for name, bytes_each, kind, count in zip(names, sizes, types, counts, strict=True):
        if len(bytes_each) != 1 or bytes_each not in _PCD_TYPES.get(kind, ""):
            raise ValueError(f"field {name}: TYPE {kind} of SIZE {bytes_each} is unknown")
        fields.append((name, kind.lower() + bytes_each, header.number(count)))
    if "POINTS" in entries:
        edges = entries["POINTS"]
    else:
        edges = [*entries.get("WIDTH", []), *entries.get("HEIGHT", [])]
    if not edges:
        raise ValueError("its header has no POINTS")
    number = math.prod([header.number(edge) for edge in edges])
    table = _Table(fields)
    room = size - file.tell()
    match entries["DATA"]:
        case ["ascii"]:
            return table.from_text(header, number, room)
        case ["binary"]:
            return table.from_binary(file, number, room)
        case ["binary_compressed"]:
            return _decompressed(file, number, table, room)
    raise header.error(f"DATA {' '.join(entries['DATA'])[:60]!r} is unknown")


def _decompressed(file: IO[bytes], number: int, table: _Table, room: int) -> np.ndarray:
    """The points of a PCD's `binary_compressed` data: one field after another, all points of it."""
    sizes = file.read(8)
    if len(sizes) < 8:
        raise ValueError("it ends too early")
    compressed, uncompressed = struct.unpack("<II", sizes)
    # LZF's longest copy is 264 bytes, encoded in 3.
    if compressed > room - 8 or uncompressed > min(88 * compressed + 264, MAX_BYTES):
        raise ValueError("its compressed sizes do not fit")
    table.check(number, uncompressed // table.row_size)
    contents = np.frombuffer(file.read(compressed), np.uint8)
    unpacked = np.empty(uncompressed, np.uint8)
    if decompress_lzf(contents, unpacked) != uncompressed:
        raise ValueError("its compressed points are damaged")
    points = np.empty((number, 3), table.result)
    for axis, (kind, offset) in enumerate(zip(table.kinds, table.offsets, strict=True)):
        points[:, axis] = np.frombuffer(unpacked, kind, number, number * offset)
    return points


_READERS = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".png": _read_png,
}
