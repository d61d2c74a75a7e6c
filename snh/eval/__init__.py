"""Measures of a run against a reference: path and reconstruction."""

from snh.eval.reconstruction import DepthError as DepthError
from snh.eval.reconstruction import HiddenSurface as HiddenSurface
from snh.eval.reconstruction import SurfaceError as SurfaceError
from snh.eval.reconstruction import depth_l1 as depth_l1
from snh.eval.reconstruction import evaluate_reconstruction as evaluate_reconstruction
from snh.eval.reconstruction import hidden_surface as hidden_surface
from snh.eval.reconstruction import icp_alignment as icp_alignment
from snh.eval.reconstruction import refined as refined
from snh.eval.reconstruction import sample_points as sample_points
from snh.eval.reconstruction import seen_vertices as seen_vertices
from snh.eval.reconstruction import surface_error as surface_error
from snh.eval.reconstruction import virtual_views as virtual_views
from snh.eval.trajectory import AbsoluteError as AbsoluteError
from snh.eval.trajectory import RelativeError as RelativeError
from snh.eval.trajectory import align as align
from snh.eval.trajectory import ate as ate
from snh.eval.trajectory import rpe as rpe
from snh.eval.trajectory import write_tum as write_tum
