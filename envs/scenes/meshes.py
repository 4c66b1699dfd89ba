"""Meshes as convex hulls: STL, OBJ, PLY and GLB files, and triangles from other files.

Files are read by trimesh, and split by CoACD (Wei et al., 2022): the extra `meshes`.

    obstacles = mesh_hulls(*load_mesh("part.stl", folder="."), position=(0.5, 0.0, 0.2))
"""

import functools
import importlib.util
import io
import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from roboarm_nmp.envs.robots.glb import read_glb
from roboarm_nmp.envs.scenes.numbers import IDENTITY, MAX_LENGTH, Quaternion, Vector
from roboarm_nmp.envs.scenes.primitives import ConvexHull, convex_hull

MESH_FILES = (".stl", ".obj", ".ply", ".glb")
MAX_MESH_BYTES = 20_000_000
MAX_TRIANGLES = 500_000
MAX_CONCAVITY = 0.001
"""m. A mesh is convex if no triangle's centre is deeper inside its convex hull."""
THRESHOLD = 0.05
"""Of CoACD: the concavity that is left, 0.01 (many hulls) to 1."""
SEED = 0
"""Of CoACD."""
# CoACD takes minutes for some damaged meshes, so it runs in another process, with limits.
SPLIT_SECONDS = 60  # of processor time
SPLIT_MEMORY = 4_000_000_000  # bytes
SPLIT = """
import io, os, resource, sys
resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
answer = os.dup(1)
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
import coacd, numpy
coacd.set_log_level("error")
arrays = numpy.load(io.BytesIO(sys.stdin.buffer.read()))
mesh = coacd.Mesh(arrays["corners"], arrays["faces"])
parts = io.BytesIO()
numpy.savez(parts, *[part for part, _ in coacd.run_coacd(mesh, threshold=THRESHOLD, seed=SEED)])
os.fdopen(answer, "wb").write(parts.getvalue())
"""
# Comparisons of triangles with planes of the hull: at most, and at once.
_MAX_COMPARISONS = 50_000_000
_AT_ONCE = 2_000_000


class MeshError(ValueError):
    """A mesh that cannot be used. The message names the file, if there is one, and the reason."""


def load_mesh(name: str, folder: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Load the triangles of a file in a folder: float64 (v, 3) vertices and int64 (f, 3) faces.

    It reads this file only, no other one such as its materials, and nothing outside of the folder.

    Raises MeshError: the file is missing, outside of the folder, too large, or damaged; or trimesh
    is not installed.
    """
    try:
        path = (Path(folder) / name).resolve(strict=True)
        if not path.is_relative_to(Path(folder).resolve()):
            raise MeshError(f"{name}: outside of the folder of the file that names it")
        if not path.is_file():  # a pipe would never end
            raise MeshError(f"{name}: no regular file")
        kind = path.suffix.lower()
        if kind not in MESH_FILES:
            raise MeshError(f"{name}: a mesh's file ends in {', '.join(MESH_FILES)}")
        if path.stat().st_size > MAX_MESH_BYTES:
            raise MeshError(f"{name}: more than {MAX_MESH_BYTES // 1_000_000} MB")
        contents = path.read_bytes()
    except MeshError:
        raise
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links; a name with byte 0
        reason = getattr(error, "strerror", None) or "cannot be read"
        raise MeshError(f"{name}: {reason}") from error
    try:
        vertices, faces = _joined(read_glb(contents)) if kind == ".glb" else _read(contents, kind)
        check_mesh(vertices, faces)
    except ValueError as error:
        raise MeshError(f"{name}: {error}") from error
    return vertices, faces


def _read(contents, kind):
    """The vertices and triangles of an STL, OBJ or PLY file."""
    try:
        import trimesh
    except ImportError as error:
        raise MeshError("meshes need: pip install 'roboarm-nmp[meshes]'") from error
    try:
        mesh: Any = trimesh.load_mesh(
            io.BytesIO(contents), file_type=kind[1:], process=False, skip_materials=True
        )
        return np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    except Exception as error:  # damaged files raise all kinds of exceptions
        raise MeshError(f"damaged, or no {kind[1:].upper()} file") from error


def _joined(parts):
    """The vertices and triangles of several meshes as those of one."""
    firsts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [corners + first for (_, corners), first in zip(parts, firsts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def check_mesh(vertices: np.ndarray, faces: np.ndarray) -> None:
    """Raise MeshError unless vertices (v, 3) and triangles (f, 3) are those of a mesh."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError("not a mesh of triangles")
    if not 1 <= len(faces) <= MAX_TRIANGLES:
        raise MeshError(f"{len(faces):,} triangles, not 1 to {MAX_TRIANGLES:,}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError("a triangle has a vertex that is not there")
    if not np.isfinite(vertices[faces]).all():
        raise MeshError("a vertex is not finite")


def mesh_hulls(
    vertices: np.ndarray,
    faces: np.ndarray,
    position: Vector,
    orientation: Quaternion = IDENTITY,
    scale: float | Vector = 1.0,
    decompose: bool = True,
) -> tuple[ConvexHull, ...]:
    """A mesh as a tuple of `ConvexHull`s: one, if it is convex to `MAX_CONCAVITY`.

    Args:
        vertices, faces: of `load_mesh`.
        position, orientation: of the mesh's frame: m, and a quaternion (xyzw).
        scale: a number, or three, by which vertices are multiplied to be in m.
        decompose: split a mesh that is not convex into several hulls, by CoACD. Otherwise its
            convex hull is returned, with a warning that says how far that is from the mesh.

    Raises MeshError: the mesh is flat, or too large; or CoACD is not installed.
    """
    check_mesh(vertices, faces)
    vertices = vertices * np.broadcast_to(scale, 3)
    if np.abs(vertices[faces]).max() > MAX_LENGTH:
        raise MeshError(f"coordinates exceed {MAX_LENGTH:.0f} m: is the scale right?")
    try:
        hull = convex_hull(vertices[np.unique(faces)], position, orientation)
    except ValueError as error:
        raise MeshError(str(error)) from error
    depth = _concavity(vertices[faces])
    if depth <= MAX_CONCAVITY:
        return (hull,)
    if not decompose:
        warnings.warn(
            f"a mesh is not convex: its convex hull is used, up to {depth * 1000:.0f} mm from the "
            f"mesh (decompose: true splits it)",
            stacklevel=2,
        )
        return (hull,)
    parts = _parts(vertices.tobytes(), faces.tobytes())
    return tuple(ConvexHull(position, part, orientation) for part in parts)


def _concavity(triangles: np.ndarray) -> float:
    """How deep (m) the deepest of triangles' (f, 3, 3) centres is inside of their convex hull.

    Of meshes with very many triangles, every second one is examined, or every third, and so on.
    """
    from scipy import spatial  # here, because it takes a while to import

    planes = spatial.ConvexHull(triangles.reshape(-1, 3)).equations
    step = 1 + len(triangles) * len(planes) // _MAX_COMPARISONS
    centres = triangles[::step].mean(axis=1)
    deepest = 0.0
    count = 1 + _AT_ONCE // len(planes)
    for i in range(0, len(centres), count):
        depths = -(centres[i : i + count] @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        deepest = max(deepest, float(depths.max()))
    return deepest


@functools.lru_cache(maxsize=256)
def _parts(vertices_bytes: bytes, faces_bytes: bytes) -> tuple[tuple[Vector, ...], ...]:
    """The vertices of the convex parts of a mesh."""
    if importlib.util.find_spec("coacd") is None:
        raise MeshError("a mesh that is not convex needs: pip install 'roboarm-nmp[meshes]'")
    vertices = np.frombuffer(vertices_bytes).reshape(-1, 3)
    faces = np.frombuffer(faces_bytes, np.int64).reshape(-1, 3)
    # In an STL file each triangle has corners of its own: joined, the surface is closed, which
    # spares CoACD the repair of the mesh, most of its time.
    corners, faces = np.unique(vertices[faces.ravel()], axis=0, return_inverse=True)
    arrays = io.BytesIO()
    np.savez(arrays, corners=corners, faces=faces.reshape(-1, 3))
    limits = (
        f"SECONDS, MEMORY, THRESHOLD, SEED = {SPLIT_SECONDS}, {SPLIT_MEMORY}, {THRESHOLD}, {SEED}"
    )
    command = [sys.executable, "-c", f"{limits}\n{SPLIT}"]
    one_thread = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, input=arrays.getvalue(), capture_output=True, env=one_thread)
    try:
        if done.returncode:
            raise ValueError(f"not within {SPLIT_SECONDS} s and {SPLIT_MEMORY // 10**9} GB")
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as parts:
            return tuple(convex_hull(parts[name], (0.0, 0.0, 0.0)).vertices for name in parts)
    except ValueError as error:
        raise MeshError(f"a mesh cannot be split into convex parts: {error}") from error
