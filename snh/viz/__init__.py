"""Pictures of meshes, paths and maps, without a window."""

from snh.viz.render import ViewPoint as ViewPoint
from snh.viz.render import dollhouse_view as dollhouse_view
from snh.viz.render import render_mesh as render_mesh
from snh.viz.render import save_png as save_png
from snh.viz.render import up_direction as up_direction
