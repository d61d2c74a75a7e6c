"""The fused operations, usable in any PyTorch code. Shapes, units and gradients stand in each docstring."""

from snh.ops.field import FieldSpec as FieldSpec
from snh.ops.field import field_map as field_map
from snh.ops.field import field_map_ as field_map_
from snh.ops.field import field_query as field_query
from snh.ops.field import field_track as field_track
from snh.ops.hash_table import HashTable as HashTable
from snh.ops.hull_cells import hull_cells as hull_cells
from snh.ops.hull_cells import plane_hulls as plane_hulls
from snh.ops.interframe import interframe as interframe
from snh.ops.plane_lookup import plane_lookup as plane_lookup
from snh.ops.ray_render import ray_render as ray_render
from snh.ops.ray_sample import ray_sample as ray_sample
from snh.ops.sparse_adam import adam_ as adam_
from snh.ops.sparse_adam import sparse_adam_ as sparse_adam_
