"""Tubes as BOP models: PLY meshes in mm, ``models_info.json`` with the continuous symmetry, and its discretisation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tubepose.labware import TubeModel
from tubepose.simulation.meshes import Mesh, revolve
from tubepose.transforms import FloatArray

SYMMETRY_STEP = 0.01
"""Largest displacement by a discrete step of a symmetry, as a share of the diameter: bop_toolkit's default."""
_SPACING_M = 1e-3
_SEGMENTS = 72


def tube_mesh(tube: TubeModel) -> Mesh:
    """The tube's outside as a mesh; origin at its bottom, z along it."""
    return revolve(tube.outer_profile_m(_SPACING_M), _SEGMENTS)


def ply_text(mesh: Mesh) -> str:
    """A mesh as an ASCII PLY with normals, mm."""
    head = ["ply", "format ascii 1.0", f"element vertex {len(mesh.vertices_m)}"]
    head += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    head += [f"element face {len(mesh.triangles)}", "property list uchar int vertex_indices", "end_header"]
    rows = np.column_stack([mesh.vertices_m * 1e3, mesh.normals])
    lines = [" ".join(f"{value:.7g}" for value in row) for row in rows.tolist()]
    return "\n".join([*head, *lines, *(f"3 {a} {b} {c}" for a, b, c in mesh.triangles.tolist())]) + "\n"


def models_info(tubes: Mapping[int, TubeModel]) -> dict[str, Any]:
    """Contents of ``models_info.json``: box and diameter in mm, symmetric about z at any angle.

    Args:
        tubes: Tube per object number.
    """
    return {str(number): _info(tube) for number, tube in tubes.items()}


def _info(tube: TubeModel) -> dict[str, Any]:
    vertices_mm = tube_mesh(tube).vertices_m * 1e3
    low, high = vertices_mm.min(axis=0), vertices_mm.max(axis=0)
    profile_mm = tube.outer_profile_m(_SPACING_M) * 1e3
    z, r = profile_mm.T
    diameter = np.sqrt((z[:, None] - z) ** 2 + (r[:, None] + r) ** 2).max()
    boxes = {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    sizes = {f"size_{axis}": float(value) for axis, value in zip("xyz", high - low, strict=True)}
    symmetry = {"axis": [0, 0, 1], "offset": [0, 0, 0]}
    return {"diameter": float(diameter), **boxes, **sizes, "symmetries_continuous": [symmetry]}


def discrete_symmetries(step: float = SYMMETRY_STEP) -> FloatArray:
    """Rotations about z that stand for the continuous symmetry, shape (N, 3, 3), as bop_toolkit takes them.

    Source: Hodan et al., BOP Challenge 2020, Section 2.2; bop_toolkit, get_symmetry_transformations: ceil(pi / step)
    equal turns.

    Args:
        step: Largest displacement of a vertex by one step, as a share of the object's diameter.
    """
    count = int(np.ceil(np.pi / step))
    angles = 2 * np.pi / count * np.arange(count)
    cosines, sines, zeros, ones = np.cos(angles), np.sin(angles), np.zeros(count), np.ones(count)
    rows = [[cosines, -sines, zeros], [sines, cosines, zeros], [zeros, zeros, ones]]
    return np.asarray(np.transpose(np.array(rows), (2, 0, 1)))


def vertex_mssd_mm(
    T_camera_truth: FloatArray, T_camera_estimate: FloatArray, vertices_m: FloatArray, symmetries: FloatArray
) -> float:
    """MSSD over given vertices and symmetries: least over S of the largest ``|T_est x - T_truth S x|``, mm.

    Source: Hodan et al., BOP Challenge 2020, Eq. 2.

    Args:
        T_camera_truth: Array of shape (4, 4), metres.
        T_camera_estimate: Array of shape (4, 4), metres.
        vertices_m: Array of shape (V, 3), model frame, metres.
        symmetries: Rotations of the model, shape (N, 3, 3).
    """
    D = np.linalg.inv(T_camera_truth) @ T_camera_estimate
    moved = vertices_m @ D[:3, :3].T + D[:3, 3]
    constant = (moved**2).sum(axis=1) + (vertices_m**2).sum(axis=1)
    # |moved - S x|^2 by one product per symmetry; the best one is then computed without the cancellation.
    turned = np.einsum("nij,vj->nvi", symmetries, vertices_m)
    squared = constant - 2 * np.einsum("vi,nvi->nv", moved, turned)
    near = np.argsort(squared.max(axis=1))[:3]
    return float(min(np.linalg.norm(moved - turned[i], axis=1).max() for i in near) * 1e3)
