"""The SLAM pipeline: tracker, mapper, keyframes, and the system that runs them."""

from snh.slam.system import SLAM as SLAM
from snh.slam.system import FrameResult as FrameResult
