"""The fused operations, usable in any PyTorch code. Shapes, units and gradients stand in each docstring."""

from snh.ops.hash_table import HashTable as HashTable
from snh.ops.hull_cells import hull_cells as hull_cells
from snh.ops.hull_cells import plane_hulls as plane_hulls
from snh.ops.interframe import interframe as interframe
from snh.ops.plane_lookup import plane_lookup as plane_lookup
from snh.ops.ray_render import ray_render as ray_render
from snh.ops.ray_sample import ray_sample as ray_sample
