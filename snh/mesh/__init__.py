"""Coloured triangle meshes: extraction from a field, files."""

from snh.mesh.extract import box_blocks, candidate_blocks, extract_mesh
from snh.mesh.mesh import Mesh, load_mesh, save_mesh

__all__ = ["Mesh", "box_blocks", "candidate_blocks", "extract_mesh", "load_mesh", "save_mesh"]
