"""The fused operations, usable in any PyTorch code. Shapes, units and gradients stand in each docstring."""

from snh.ops.hash_table import HashTable as HashTable
from snh.ops.ray_sample import ray_sample as ray_sample
