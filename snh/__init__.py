"""SNH-SLAM: dense neural RGB-D SLAM on hashed planes, and its ops for any PyTorch code."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = ["SLAM", "Camera", "Config", "Frame", "SNHError", "load_config", "open_sequence"]

if TYPE_CHECKING:
    from snh.config import Config, load_config
    from snh.datasets import open_sequence
    from snh.errors import SNHError
    from snh.frame import Camera, Frame
    from snh.slam import SLAM

_HOMES = {
    "SLAM": "snh.slam",
    "Camera": "snh.frame",
    "Config": "snh.config",
    "Frame": "snh.frame",
    "SNHError": "snh.errors",
    "load_config": "snh.config",
    "open_sequence": "snh.datasets",
}


def __getattr__(name: str) -> Any:
    """Loads a public name when it is first used: `import snh` and `snh-slam --help` need neither torch nor OpenCV."""
    if name not in _HOMES:
        raise AttributeError(f"module 'snh' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)
