"""Types of the pybind11 module, see csrc/*/*_bind.cpp."""

import numpy as np

built_with_cuda: bool

class BuiltinRoom:
    """A furnished room defined in code, number 0 or 1; see csrc/builtin_scene/builtin_scene.h."""

    def __init__(self, number: int) -> None: ...
    @property
    def bounds(self) -> np.ndarray: ...  # [2, 3] m, inside of the walls: lowest and highest corner
    def render(
        self, T_wc: np.ndarray, width: int, height: int, fx: float, fy: float, cx: float, cy: float, n_threads: int = 1
    ) -> tuple[np.ndarray, np.ndarray]: ...  # rgb [H, W, 3] uint8, z-depth [H, W] float32 m
    def mesh(self, edge: float = 0.05) -> tuple[np.ndarray, np.ndarray]: ...  # [V, 3] float32 m, [T, 3] int32
    def signed_distance(self, points: np.ndarray) -> np.ndarray: ...  # [N, 3] m -> [N] m
