"""Files of the same three points in every format, written by hand."""

import io
import struct

import numpy as np

POINTS = np.array([[0.5, -0.25, 0.125], [1.0, 2.0, -3.0], [0.0, 0.0, 0.75]])

PLY_TEXT = """ply
format ascii 1.0
comment made by hand
element camera 1
property list uchar int lens
element vertex 3
property float x
property uchar red
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
2 7 8
0.5 255 -0.25 0.125
1 0 2 -3
0 3 0 75e-2
3 0 1 2
"""
PCD_TEXT = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS normal x y z
SIZE 4 4 4 4
TYPE F F F F
COUNT 3 1 1 1
WIDTH 3
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 3
DATA ascii
0 0 1 0.5 -0.25 0.125
0 0 1 1 2 -3
0 0 1 0 0 0.75
"""
PCD_HEADER = PCD_TEXT.partition("DATA")[0].replace("COUNT 3", "COUNT 1")


def ply(order):
    """A binary PLY with doubles, a colour between them, and an element before the vertices."""
    name = {"<": "little", ">": "big"}[order]
    header = f"""ply
format binary_{name}_endian 1.0
element origin 2
property short a
element vertex 3
property double x
property uchar red
property double y
property double z
end_header
"""
    rows = [struct.pack(f"{order}dBdd", x, 9, y, z) for x, y, z in POINTS]
    return header.encode() + bytes(4) + b"".join(rows)


def pcd_binary():
    rows = [struct.pack("<4f", 7.0, *point) for point in POINTS]
    return PCD_HEADER.encode() + b"DATA binary\n" + b"".join(rows)


def pcd_compressed():
    """LZF by hand: 12 bytes of the field `normal` as a copy, then the rest as they are."""
    fields = np.float32(POINTS).T.tobytes()
    one = struct.pack("<f", 7.0)
    # Four bytes as they are; a copy of 8 bytes from 4 before; 36 more bytes in two runs.
    data = bytes([3]) + one + bytes([(8 - 2) << 5, 3])
    data += bytes([31]) + fields[:32] + bytes([3]) + fields[32:]
    sizes = struct.pack("<II", len(data), 48)
    return PCD_HEADER.encode() + b"DATA binary_compressed\n" + sizes + data


def npy(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def npz(**arrays):
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def structured():
    rows = np.zeros(3, [("intensity", "f4"), ("x", "f4"), ("y", "f4"), ("z", "f8")])
    for name, column in zip("xyz", POINTS.T, strict=True):
        rows[name] = column
    return rows


FILES = {
    "text.ply": PLY_TEXT.encode(),
    "little.ply": ply("<"),
    "big.PLY": ply(">"),
    "text.pcd": PCD_TEXT.encode(),
    "binary.pcd": pcd_binary(),
    "compressed.pcd": pcd_compressed(),
    "doubles.npy": npy(POINTS),
    "organised.npy": npy(np.float32(POINTS)[None]),
    "big_endian.npy": npy(POINTS.astype(">f4")),
    "structured.npy": npy(structured()),
    "named.npz": npz(colours=np.zeros(2), points=POINTS),
}
