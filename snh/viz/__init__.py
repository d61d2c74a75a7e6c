"""Pictures of meshes, paths and maps, without a window."""

from snh.viz.figures import contact_sheet as contact_sheet
from snh.viz.figures import map_picture as map_picture
from snh.viz.figures import occupied_vertices as occupied_vertices
from snh.viz.figures import path_picture as path_picture
from snh.viz.render import render_mesh as render_mesh
from snh.viz.render import save_png as save_png
