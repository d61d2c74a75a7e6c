"""Rigid motions. T_ab maps points of b to a; a twist is (rho, phi) [6], translation first, and acts on the right:
T <- T exp(twist), so that rho and phi are in the moving (camera) frame."""

from __future__ import annotations

import numpy as np


def skew(v: np.ndarray) -> np.ndarray:
    """Matrix of the cross product, [..., 3] -> [..., 3, 3]."""
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape[:-1], 3, 3)


def se3_exp(twist: np.ndarray) -> np.ndarray:
    """Rigid motion of a twist, [..., 6] -> [..., 4, 4]. Series near zero, so there is no singular point."""
    twist = np.asarray(twist, dtype=np.float64)
    rho, phi = twist[..., :3], twist[..., 3:]
    theta2 = np.sum(phi * phi, axis=-1)[..., None, None]
    theta = np.sqrt(theta2)
    small = theta2 < 1e-8
    safe2 = np.where(small, 1.0, theta2)
    safe = np.sqrt(safe2)
    a = np.where(small, 1 - theta2 / 6, np.sin(theta) / safe)
    b = np.where(small, 0.5 - theta2 / 24, (1 - np.cos(theta)) / safe2)
    c = np.where(small, 1 / 6 - theta2 / 120, (theta - np.sin(theta)) / (safe2 * safe))
    K = skew(phi)
    K2 = K @ K
    T = np.zeros((*twist.shape[:-1], 4, 4))
    T[..., :3, :3] = np.eye(3) + a * K + b * K2
    T[..., :3, 3] = ((np.eye(3) + b * K + c * K2) @ rho[..., None])[..., 0]
    T[..., 3, 3] = 1
    return T


def inverse(T: np.ndarray) -> np.ndarray:
    """Inverse of rigid motions, [..., 4, 4]."""
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    result = np.zeros_like(T)
    result[..., :3, :3] = R_t
    result[..., :3, 3] = -(R_t @ T[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1
    return result


def orthonormal(T: np.ndarray) -> np.ndarray:
    """Nearest rigid motion (rotation part by SVD), [4, 4]."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    result = T.copy()
    result[:3, :3] = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return result


def quaternion_from_rotation(R: np.ndarray) -> np.ndarray:
    """Unit quaternion (x, y, z, w) with w >= 0 of a rotation matrix [3, 3] (Shepperd's method)."""
    trace = np.trace(R)
    candidates = np.array([R[0, 0], R[1, 1], R[2, 2], trace])
    k = int(np.argmax(candidates))
    q = np.empty(4)
    if k == 3:
        q[3] = 1 + trace
        q[:3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i, j, l = k, (k + 1) % 3, (k + 2) % 3
        q[i] = 1 + R[i, i] - R[j, j] - R[l, l]
        q[j] = R[j, i] + R[i, j]
        q[l] = R[l, i] + R[i, l]
        q[3] = R[l, j] - R[j, l]
    q /= np.linalg.norm(q)
    return q if q[3] >= 0 else -q


def rotation_from_quaternion(q: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion (x, y, z, w), normalised first, [4] -> [3, 3]."""
    x, y, z, w = np.asarray(q, dtype=np.float64) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
