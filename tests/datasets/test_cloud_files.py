"""Reading point clouds: every format, units and frames, and files that are damaged or hostile."""

import os

import numpy as np
import pytest
from cloud_examples import FILES, PCD_TEXT, PLY_TEXT, POINTS, npy, pcd_binary, pcd_compressed, ply
from PIL import Image
from scipy.spatial.transform import Rotation

from roboarm_nmp.datasets.cloud_files import CloudError, load_cloud


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
