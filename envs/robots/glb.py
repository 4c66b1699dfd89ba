"""GLB files (binary glTF) as triangles. PyBullet reads none, so it gets OBJ files of them."""

import io
import json
from typing import Any

import numpy as np

MAX_GLB_TRIANGLES = 500_000

GlbMesh = tuple[np.ndarray, np.ndarray]


def read_glb(contents: bytes) -> list[GlbMesh]:
    """The meshes of a GLB file: float64 vertices (v, 3) and int64 triangles (f, 3) of each.

    Coordinates are those of the file's scene: no axes are exchanged. No other file is read.

    Raises ValueError: the file is damaged or too large, or trimesh is not installed.
    """
    try:
        import trimesh  # here, because it takes a while, and few meshes need it
    except ImportError as error:
        raise ValueError("GLB files need: pip install 'roboarm-nmp[meshes]'") from error
    try:
        size = int.from_bytes(contents[12:16], "little")
        for accessor in json.loads(contents[20 : 20 + size]).get("accessors", []):
            if not 0 <= accessor["count"] <= len(contents):  # trimesh would make an array of it
                raise ValueError("an accessor has more elements than the file has bytes")
        scene: Any = trimesh.load_scene(
            io.BytesIO(contents), file_type="glb", process=False, skip_materials=True
        )
        placed = [scene.graph.get(node) for node in sorted(scene.graph.nodes_geometry)]
        meshes = [(matrix, scene.geometry[name]) for matrix, name in placed]
        meshes = [(matrix, mesh) for matrix, mesh in meshes if hasattr(mesh, "faces")]
        triangles = sum(len(mesh.faces) for _, mesh in meshes)
        if not 1 <= triangles <= MAX_GLB_TRIANGLES:
            raise ValueError(f"{triangles:,} triangles, not 1 to {MAX_GLB_TRIANGLES:,}")
        return [
            (trimesh.transform_points(mesh.vertices, matrix), np.array(mesh.faces, np.int64))
            for matrix, mesh in meshes
        ]
    except Exception as error:  # damaged files raise all kinds of exceptions
        raise ValueError(f"a damaged GLB file, export it again: {error}") from error
