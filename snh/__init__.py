"""SNH-SLAM: dense neural RGB-D SLAM on hashed planes, and its ops for any PyTorch code."""

__version__ = "0.1.0"
