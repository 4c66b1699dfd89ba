"""Convex hulls as obstacles: PyBullet's answers, files, meshes of other programs."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from problem_files import (
    CORNERS,
    CUROBO,
    CUROBO_MESH,
    CUROBO_TRIANGLES,
    MOVEIT_MESH,
    MOVEIT_SCENE,
    SCENE_MESH,
    TRIANGLES,
    write_file,
)

from roboarm_nmp.datasets.format import DatasetError, read_scenes, scene_arrays
from roboarm_nmp.datasets.queries import load_queries, write_queries
from roboarm_nmp.envs import RoboArmEnv
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.rotations import matrix
from roboarm_nmp.envs.scenes import meshes
from roboarm_nmp.envs.scenes.files import load_scene, save_scene
from roboarm_nmp.envs.scenes.formats import load_world
from roboarm_nmp.envs.scenes.meshes import MeshError, load_mesh, mesh_hulls
from roboarm_nmp.envs.scenes.primitives import (
    MAX_HULL_VERTICES,
    Box,
    ConvexHull,
    Scene,
    Sphere,
    convex_hull,
    from_array,
    hull_faces,
    hull_vertices,
    scene_from_json,
    scene_to_json,
    to_array,
)
from roboarm_nmp.envs.tasks import TASKS
from roboarm_nmp.utils.bullet import pybullet as p
from roboarm_nmp.utils.documents import DocumentError

WEDGE = ConvexHull(
    (0.5, 0.1, 0.3),
    ((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.2)),
    (0.0, 0.0, 0.6, 0.8),
)
# The wedge as other programs write it.
OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
OBJ += "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in TRIANGLES)
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 4
property list uchar int vertex_indices
end_header
"""
PLY += "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS)
PLY += "".join(f"3 {a} {b} {c}\n" for a, b, c in TRIANGLES)
STL = "solid wedge\n"
for triangle in TRIANGLES:
    STL += "facet normal 0 0 0\nouter loop\n"
    STL += "".join(f"vertex {x} {y} {z}\n" for x, y, z in (CORNERS[i] for i in triangle))
    STL += "endloop\nendfacet\n"
STL += "endsolid wedge\n"
FILES = {"part.obj": OBJ, "part.ply": PLY, "part.stl": STL}


def random_scene(rng, number):
    hulls = []
    for _ in range(number):
        direction, turn = rng.normal(size=3), rng.normal(size=4)
        direction[2] = abs(direction[2])
        place = rng.uniform(0.4, 0.9) * direction / np.linalg.norm(direction)
        shape = rng.normal(size=(rng.integers(4, 200), 3)) * rng.uniform(0.02, 0.08, 3)
        turn = (turn / np.linalg.norm(turn)).tolist()
        hulls.append(convex_hull(shape + rng.uniform(-0.05, 0.05, 3), tuple(place.tolist()), turn))
    return Scene(tuple(hulls), table=None, floor=None)


def corners(hull):
    """The vertices in the base's frame, (v, 3), m, in lexicographic order."""
    moved = np.array(hull.vertices) @ matrix(hull.orientation).T + hull.position
    return moved[np.lexsort(np.round(moved, 6).T)]


def assert_wedge(obstacles):
    """The only obstacle is `WEDGE`."""
    [hull] = obstacles
    np.testing.assert_allclose(corners(hull), corners(WEDGE), atol=1e-6)


# --- Checks


def test_checks_and_distances_agree_with_pybullet():
    rng = np.random.default_rng(1)
    scene = random_scene(rng, 10)
    env = RoboArmEnv(scene)
    checker = CollisionChecker(scene)
    states = rng.uniform(-1, 1, (100, 7))
    free = checker.is_free(states)
    nearest = checker.signed_distances(states).distance.min(1)
    hits = np.array([env.in_collision(PANDA.denormalise(state)) for state in states])
    assert 0.2 < hits.mean() < 0.8
    assert (free == ~hits)[np.abs(nearest) > 1e-4].all()
    distances = checker.signed_distances(states[:20], self_collisions=False).distance
    assert (distances < -0.01).any()
    bodies = [b for b in range(p.getNumBodies(physicsClientId=env.client)) if b != env.body]
    for state, row in zip(states, distances, strict=False):
        env.world.arm.set_configuration(PANDA.denormalise(state))
        for link, distance in zip(PANDA.collision_links, row, strict=True):
            options = {"linkIndexA": link, "physicsClientId": env.client}
            points = [p.getClosestPoints(env.body, body, 3.0, **options) for body in bodies]
            assert abs(min(point[8] for found in points for point in found) - distance) < 2e-4
    env.close()


def test_hull_of_many_points_contains_all_of_them():
    points = np.random.default_rng(0).normal(size=(3000, 3)) * (0.1, 0.2, 0.02)
    points[:1000] *= 0.1 / np.linalg.norm(points[:1000] / (1, 2, 0.2), axis=1, keepdims=True)
    hull = convex_hull(points)
    assert 4 <= len(hull.vertices) <= MAX_HULL_VERTICES
    assert outside(hull, points).max() < 1e-9
    ball = np.random.default_rng(0).normal(size=(5000, 3))
    ball *= 0.1 / np.linalg.norm(ball, axis=1, keepdims=True)
    hull = convex_hull(ball)
    assert len(hull.vertices) > 200
    assert outside(hull, ball).max() < 1e-9
    assert np.linalg.norm(hull.vertices, axis=1).max() < 0.103


def outside(hull, points):
    """How far (m) points are outside of a hull, in its own frame."""
    a, b, c = np.array(hull.vertices)[hull_faces(hull.vertices)].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (points @ normals.T - (normals * a).sum(1)).max(1)


@pytest.mark.parametrize(
    ("vertices", "reason"),
    [
        (CORNERS[:3], "4 to 256 vertices, got 3"),
        ([*CORNERS[:3], [0.1, 0.1, 0.0]], "in one plane"),
        ([*CORNERS[:3], [0.0, 0.0, np.nan]], "finite numbers"),
    ],
)
def test_invalid_hull_is_rejected(vertices, reason):
    with pytest.raises(ValueError, match=reason):
        Scene((ConvexHull((0, 0, 0), vertices),))


def test_hulls_are_values():
    same = ConvexHull(list(WEDGE.position), np.array(WEDGE.vertices), list(WEDGE.orientation))
    assert same == WEDGE and hash(same) == hash(WEDGE)
    assert convex_hull(np.array([*CORNERS, [0.05, 0.05, 0.05]])).vertices == WEDGE.vertices


# --- Files

MIXED = (Sphere((0.3, 0.3, 0.3), 0.1), WEDGE, Box((0.5, 0.5, 0.5), (0.1, 0.1, 0.1)))
OTHER = random_scene(np.random.default_rng(3), 2).obstacles


def test_scene_files_and_json_make_the_round_trip(tmp_path):
    scene = Scene((*MIXED, *OTHER))
    save_scene(scene, tmp_path / "scene.yaml")
    assert load_scene(tmp_path / "scene.yaml") == scene
    assert scene_from_json(scene_to_json(scene)) == scene
    assert from_array(to_array(scene.obstacles), hull_vertices(scene.obstacles)) == scene.obstacles


def test_queries_keep_their_hulls(tmp_path):
    base, q = TASKS["random_boxes_hard"].scene.base, np.full((2, 7), -0.05, np.float32)
    scenes = [replace(base, obstacles=MIXED), replace(base, obstacles=OTHER)]
    path = tmp_path / "queries.h5"
    splits = {"test": (q, q, scenes), "validation": (q / 2, q / 2, [scenes[0], base])}
    write_queries(path, "random_boxes_hard", 0, splits, "made by a test", {})
    assert [query.scene for query in load_queries(path)] == scenes
    assert [query.scene for query in load_queries(path, "validation")] == [scenes[0], base]
    arrays = scene_arrays(path, scenes, base)
    for change, reason in [
        ({"hull_vertices": arrays["hull_vertices"][1:]}, "convex hulls of"),
        ({"hull_vertices": arrays["hull_vertices"] * 0}, "in one plane"),
        ({"obstacles": arrays["obstacles"] * [*[1] * 8, 1.01, 1, 1]}, "must be a whole number"),
    ]:
        with pytest.raises(DatasetError, match=f"{path}: obstacles: .*{reason}"):
            read_scenes(path, base, arrays | change)


# --- Meshes


@pytest.mark.parametrize("name", FILES)
def test_mesh_of_a_scene_file_becomes_its_hull(name, tmp_path):
    (tmp_path / "parts").mkdir()
    write_file(tmp_path / "parts" / name, FILES[name].replace("0.2", "200"))
    text = "obstacles:\n- mesh: {file: parts/%s, scale: 0.001, position: [0.5, 0.1, 0.3],\n"
    text += "         orientation: [0, 0, 0.6, 0.8]}\n"
    scene = load_scene(write_file(tmp_path / "scene.yaml", text % name))
    assert_wedge(scene.obstacles)
    save_scene(scene, tmp_path / "hulls.yaml")  # which needs no file of a mesh
    assert load_scene(tmp_path / "hulls.yaml") == scene


def test_glb_meshes_are_placed_as_in_their_scene(tmp_path):
    mesh, place = trimesh.Trimesh(CORNERS, TRIANGLES, process=False), np.eye(4)
    place[:3, 3] = 1.0, 0.0, 0.0
    scene = trimesh.Scene({"one": mesh})
    scene.add_geometry(mesh, transform=place)
    (tmp_path / "a.glb").write_bytes(contents := scene.export(file_type="glb"))
    vertices, faces = load_mesh("a.glb", tmp_path)
    expected = np.concatenate([CORNERS, CORNERS + place[:3, 3]])
    np.testing.assert_allclose(np.unique(vertices, axis=0), np.unique(expected, axis=0), atol=1e-7)
    assert len(faces) == 8 and len(mesh_hulls(vertices, faces, (0, 0, 0))) == 2
    for damaged in (contents[:300], contents.replace(b'"count":4', b'"count":%d' % 4e9)):
        (tmp_path / "a.glb").write_bytes(damaged)
        with pytest.raises(MeshError, match=r"a.glb: a damaged GLB file"):
            load_mesh("a.glb", tmp_path)


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        ("{file: none.stl, position: [0, 0, 0]}", "none.stl: No such file"),
        ("{file: link.stl, position: [0, 0, 0]}", "link.stl: outside of the folder"),
        ("{file: bad.obj, position: [0, 0, 0]}", "bad.obj: damaged, or no OBJ file"),
        ("{file: part.obj, scale: 1e3, position: [900, 0, 0]}", "finite numbers|scale"),
    ],
)
def test_mesh_that_cannot_be_used_is_rejected_with_its_line(mesh, reason, tmp_path):
    folder = tmp_path / "scenes"
    folder.mkdir()
    write_file(tmp_path / "part.stl", STL)
    (folder / "link.stl").symlink_to(tmp_path / "part.stl")
    write_file(folder / "bad.obj", OBJ + "f 1 2 x\n")
    write_file(folder / "part.obj", OBJ.replace("0.2", "2.2"))
    path = write_file(folder / "scene.yaml", f"floor: false\nobstacles:\n- mesh: {mesh}\n")
    with pytest.raises(DocumentError, match=f"scene.yaml:3: .*({reason})"):
        load_scene(path)


# Two boxes, 0.2 x 0.1 x 0.1 and 0.1 x 0.1 x 0.3, that stand side by side: an L.
_PROFILE = [(0.0, 0.0), (0.3, 0.0), (0.3, 0.1), (0.1, 0.1), (0.1, 0.3), (0.0, 0.3)]
L_VERTICES = np.array([(x, y, z) for y in (0.0, 0.1) for x, z in _PROFILE])
_SIDE = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
L_FACES = [*_SIDE, *[(a + 6, c + 6, b + 6) for a, b, c in _SIDE]]
for i in range(6):
    j = (i + 1) % 6
    L_FACES += [(i, i + 6, j), (j, i + 6, j + 6)]
L_FACES = np.array(L_FACES)


def test_mesh_that_is_not_convex_is_split_or_warned_about():
    with pytest.warns(UserWarning, match="up to 33 mm from the mesh"):
        [hull] = mesh_hulls(L_VERTICES, L_FACES, (0, 0, 0), decompose=False)
    notch = np.array([[0.18, 0.05, 0.18], [0.05, 0.05, 0.2], [0.2, 0.05, 0.05]])
    assert (outside(hull, notch) < 0).all()
    hulls = mesh_hulls(L_VERTICES, L_FACES, (1.0, 0.0, 0.0))
    assert len(hulls) >= 2 and all(hull.position == (1.0, 0.0, 0.0) for hull in hulls)
    inside = np.min([outside(hull, notch) for hull in hulls], axis=0)
    assert inside[0] > 0.05 and (inside[1:] < 0).all()
    apart = L_VERTICES[L_FACES].reshape(-1, 3), np.arange(L_FACES.size).reshape(-1, 3)  # as in STL
    assert mesh_hulls(*apart, (1.0, 0.0, 0.0)) == hulls


def test_mesh_that_takes_too_much_to_split_gives_one_error(monkeypatch):
    monkeypatch.setattr(meshes, "SPLIT_MEMORY", 50_000_000)
    other = L_VERTICES * 1.01  # those of the test above are remembered
    with pytest.raises(MeshError, match="cannot be split into convex parts: not within 60"):
        mesh_hulls(other, L_FACES, (0, 0, 0))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("moveit.yaml", MOVEIT_MESH),
        ("file.yaml", CUROBO_MESH),
        ("inline.yaml", CUROBO_TRIANGLES),
        ("a.scene", SCENE_MESH),
    ],
)
def test_meshes_of_other_programs_are_read(name, text, tmp_path):
    write_file(tmp_path / "part.stl", STL)
    assert_wedge(load_world(write_file(tmp_path / name, text)).obstacles)


@pytest.mark.parametrize(
    ("name", "text", "line", "reason"),
    [
        ("a.yaml", MOVEIT_MESH.replace("[0, 2, 1]", "[0, 2, 9]"), 4, "a vertex that is not there"),
        ("a.yaml", CUROBO_MESH.replace("part", "../part"), 1, r"\.\./part.stl: (outside|No such)"),
        ("a.scene", SCENE_MESH.replace("\n4 4\n", "\n4 4000\n"), 7, "before the last triangle"),
        ("a.yaml", MOVEIT_SCENE.replace("- id: can", "- id: can\n      planes: [{a: 1}]"), 14,
         "planes are not supported"),
        ("a.yaml", CUROBO.replace("mesh: {}", "capsule: {a: {b: 1}}"), 7, "capsules are not"),
    ],
)  # fmt: skip
def test_mesh_of_another_program_is_rejected_with_its_line(name, text, line, reason, tmp_path):
    write_file(tmp_path / "part.stl", STL)
    with pytest.raises(ValueError, match=f"{name}:{line}: .*{reason}"):
        load_world(write_file(tmp_path / name, text))
