"""Pictures of meshes, paths and maps, without a window."""

from snh.viz.render import render_mesh as render_mesh
from snh.viz.render import save_png as save_png
