"""Coloured triangle meshes: extraction from a field, files, ray casting, views."""

from snh.mesh.extract import box_blocks as box_blocks
from snh.mesh.extract import candidate_blocks as candidate_blocks
from snh.mesh.extract import extract_mesh as extract_mesh
from snh.mesh.mesh import Mesh as Mesh
from snh.mesh.mesh import load_mesh as load_mesh
from snh.mesh.mesh import save_mesh as save_mesh
from snh.mesh.raycast import RayScene as RayScene
from snh.mesh.views import ViewPoint as ViewPoint
from snh.mesh.views import dollhouse_view as dollhouse_view
from snh.mesh.views import look_at as look_at
from snh.mesh.views import up_direction as up_direction
