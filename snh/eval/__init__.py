"""Measures of a run against a reference: path and reconstruction."""

from snh.eval.trajectory import AbsoluteError as AbsoluteError
from snh.eval.trajectory import RelativeError as RelativeError
from snh.eval.trajectory import align as align
from snh.eval.trajectory import associate as associate
from snh.eval.trajectory import ate as ate
from snh.eval.trajectory import read_tum as read_tum
from snh.eval.trajectory import rpe as rpe
from snh.eval.trajectory import write_tum as write_tum
