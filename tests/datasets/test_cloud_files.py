"""Reading point clouds: every format, units and frames, and files that are damaged or hostile."""

import io
import os
import struct

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from roboarm_nmp.datasets.cloud_files import CloudError, load_cloud

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


@pytest.mark.parametrize("name", FILES)
def test_points_of_every_format_are_read(name, tmp_path):
    (tmp_path / name).write_bytes(FILES[name])
    points = load_cloud(tmp_path / name)
    assert points.dtype == np.float32 and points.tolist() == POINTS.tolist()


def test_points_without_a_measurement_stay(tmp_path):
    text = PCD_TEXT.replace("1 2 -3", "nan nan nan")
    (tmp_path / "a.pcd").write_text(text)
    assert np.isnan(load_cloud(tmp_path / "a.pcd")).all(1).tolist() == [False, True, False]


@pytest.mark.parametrize("units", ["mm", 0.001])
def test_units_and_frame_move_the_points(units, tmp_path):
    (tmp_path / "a.npy").write_bytes(npy(1000 * POINTS))
    rotation = Rotation.from_euler("xyz", (0.3, -0.5, 2.0))
    position = (0.4, 0.1, -0.2)
    expected = rotation.apply(POINTS) + position
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), position
    for frame in ((*position, *rotation.as_quat()), matrix):
        points = load_cloud(tmp_path / "a.npy", units, frame)
        np.testing.assert_allclose(points, expected, atol=1e-6)


@pytest.mark.parametrize("name", ["depth.png", "depth.npy"])
def test_depth_image_is_projected_back(name, tmp_path):
    depth = np.zeros((3, 4))
    depth[1, 2], depth[2, 0] = 1.5, 0.5  # m; row, column
    if name.endswith("png"):
        Image.fromarray((1000 * depth).astype(np.uint16)).save(tmp_path / name)
    else:
        depth[0, 0] = np.nan
        np.save(tmp_path / name, depth)
    intrinsics = 2.0, 4.0, 1.0, 0.5
    points = load_cloud(tmp_path / name, intrinsics=intrinsics)
    expected = [[0.75, 0.1875, 1.5], [-0.25, 0.1875, 0.5]]
    np.testing.assert_allclose(points, expected, atol=1e-6)
    # A camera above the base that looks down: its z is the base's -z, its x the base's x.
    frame = (0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0)
    points = load_cloud(tmp_path / name, frame=frame, intrinsics=intrinsics)
    np.testing.assert_allclose(points, np.array(expected) * (1, -1, -1) + (0, 0, 2), atol=1e-6)


class Payload:
    """Unpickling it makes a folder."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
def test_pickled_array_is_rejected_and_not_unpickled(name, tmp_path):
    made, path = tmp_path / "made", tmp_path / name
    array = np.array([Payload(made)], dtype=object)
    if name == "a.npz":
        np.savez(path, points=array)
    else:
        np.save(path, array, allow_pickle=True)
    with pytest.raises(CloudError, match=r"a\.np[yz]: .*pickled"):
        load_cloud(path)
    assert not made.exists()


HUGE_NPY = npy(POINTS).replace(b"(3, 3)", b"(9999999999, 3)")
DAMAGED = {
    "word.ply": (PLY_TEXT.replace("1 0 2 -3", "1 0 two -3").encode(), "line 16: not numbers"),
    "cut.ply": (PLY_TEXT.partition("0 3 0")[0].encode(), "ends after 2 of 3 points"),
    "many.ply": (ply("<").replace(b"vertex 3", b"vertex 99999999999"), "announces 99,999,999,999"),
    "cut.pcd": (pcd_binary()[:-5], "announces 3 points, and has room for 2"),
    "cut_compressed.pcd": (pcd_compressed()[:-1], "compressed sizes do not fit"),
    "lzf.pcd": (pcd_compressed().replace(b"\xc0\x03", b"\xc0\xff"), "damaged"),
    "huge.npy": (HUGE_NPY, "does not fit"),
    "cut.png": (None, "truncated|damaged|broken"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_file_gives_one_line_that_names_it(name, tmp_path):
    contents, message = DAMAGED[name]
    path = tmp_path / name
    if name == "cut.png":
        noise = np.random.default_rng(0).integers(0, 2**16, (60, 60)).astype(np.uint16)
        Image.fromarray(noise).save(path)
        path.write_bytes(path.read_bytes()[:2000])
    else:
        path.write_bytes(contents)
    intrinsics = (1.0, 1.0, 0.0, 0.0) if name.endswith("png") else None
    with pytest.raises(CloudError, match=message) as error:
        load_cloud(path, intrinsics=intrinsics)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def test_missing_file_and_folder_are_rejected(tmp_path):
    (tmp_path / "folder.ply").mkdir()
    for name in ("a.ply", "folder.ply"):
        with pytest.raises(CloudError, match=f"{name}: no such file"):
            load_cloud(tmp_path / name)
    with pytest.raises(CloudError, match="needs intrinsics"):
        load_cloud(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"units": "inch"}, "units must be m, cm, mm"),
        ({"frame": (0.0, 0.0, 0.0)}, "frame must be a pose"),
        ({"frame": np.diag([1.0, 1.0, -1.0, 1.0])}, "frame must be a rotation"),
        ({"intrinsics": (0.0, 1.0, 0.0, 0.0)}, "intrinsics must be"),
    ],
)
def test_invalid_options_are_rejected(options, message, tmp_path):
    (tmp_path / "a.npy").write_bytes(npy(POINTS))
    with pytest.raises(ValueError, match=message):
        load_cloud(tmp_path / "a.npy", **options)
