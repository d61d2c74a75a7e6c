"""Readers of RGB-D recordings. Files, units and axes of others end here: frames leave in metres and OpenCV axes."""

from snh.datasets.opening import FORMATS as FORMATS
from snh.datasets.opening import open_sequence as open_sequence
from snh.datasets.prefetch import prefetch as prefetch
from snh.datasets.preflight import check as check
from snh.datasets.sequence import FrameError as FrameError
from snh.datasets.sequence import Sequence as Sequence
from snh.datasets.sequence import View as View
