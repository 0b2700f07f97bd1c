"""Buffers of Mitsuba's meshes."""

import numpy as np


def mesh_arrays(mesh):
    """Buffers of a mesh in its own frame.

    Returns
    -------
    positions : (v, 3) float32
    faces : (f, 3) int64
    normals : (v, 3) float32 or None
        Shading normals as Mitsuba uses them (flip_normals applied); None if the mesh is faceted.
    uv : (v, 2) float32 or None
    """
    positions = np.array(mesh.vertex_positions_buffer(), dtype=np.float32).reshape(-1, 3)
    faces = np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
    normals = uv = None
    if mesh.has_vertex_normals() and not mesh.has_face_normals():
        normals = np.array(mesh.vertex_normals_buffer(), dtype=np.float32).reshape(-1, 3)
        if mesh.has_flipped_normals():
            normals = -normals
    if mesh.has_vertex_texcoords():
        uv = np.array(mesh.vertex_texcoords_buffer(), dtype=np.float32).reshape(-1, 2)
    return positions, faces, normals, uv
