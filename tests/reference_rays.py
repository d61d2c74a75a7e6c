"""Dumb oracles of plane_lookup, ray_sample, ray_render and interframe: one number at a time, float64, nothing shared
with the package. Those in torch scalars give first and second derivatives by autograd."""

import math
from types import SimpleNamespace

import numpy as np
import torch

# --- the table ----------------------------------------------------------------------------------------------------


def brick_key(level, plane, brick_i, brick_j):
    return ((level << 2) | plane) << 56 | (brick_i + 2**27) << 28 | (brick_j + 2**27)


def brick_hash(level, plane, brick_i, brick_j):
    u32 = 2**32 - 1
    h = (brick_i * 0x9E3779B1 & u32) ^ (brick_j * 0x85EBCA77 & u32) ^ ((level * 4 + plane) * 0xC2B2AE3D & u32)
    h ^= h >> 15
    h = h * 0x2C1B3C6D & u32
    return h ^ (h >> 13)


def dumb_table(vertices):
    """Table (probe, brick_keys, masks) that holds the vertices (level, plane, i, j), and the dict vertex -> row."""
    bricks = {}
    for level, plane, i, j in vertices:
        bricks.setdefault((level, plane, i // 8, j // 8), set()).add((i % 8) + 8 * (j % 8))
    names = sorted(bricks)
    capacity = 2
    while capacity < 2 * len(names):
        capacity *= 2
    probe = [-1] * capacity
    for number, name in enumerate(names):
        place = brick_hash(*name) % capacity
        while probe[place] >= 0:
            place = (place + 1) % capacity
        probe[place] = number
    masks = [sum(1 << local for local in bricks[name]) for name in names]
    table = SimpleNamespace(
        probe=torch.tensor(probe, dtype=torch.int32),
        brick_keys=torch.tensor([brick_key(*name) for name in names], dtype=torch.int64),
        masks=torch.tensor([m - 2**64 if m >= 2**63 else m for m in masks], dtype=torch.int64),
    )
    number = {name: n for n, name in enumerate(names)}
    rows = {(l, p, i, j): 64 * number[l, p, i // 8, j // 8] + (i % 8) + 8 * (j % 8) for l, p, i, j in vertices}
    return table, rows


# --- plane_lookup -------------------------------------------------------------------------------------------------


def plane_lookup(points, features, rows, cell_sizes, n_features, reduce):
    """Eq. 4. The position in cells is one product in the type of the points, as the contract says; the rest float64."""
    axes = [(0, 1), (1, 2), (2, 0)]
    all_encoded, all_valid = [], []
    for point in points:
        for level, size in enumerate(cell_sizes):
            inverse = torch.tensor(1.0 / size, dtype=points.dtype)
            phi = []
            for plane, (axis_u, axis_v) in enumerate(axes):
                u, v = (point[axis_u] * inverse).double(), (point[axis_v] * inverse).double()
                i, j = math.floor(u.item()), math.floor(v.item())
                total, found = torch.zeros(n_features, dtype=torch.float64), 0
                for di in (0, 1):
                    for dj in (0, 1):
                        row = rows.get((level, plane, i + di, j + dj))
                        if row is not None:
                            weight = (u - i if di else 1 - (u - i)) * (v - j if dj else 1 - (v - j))
                            total = total + weight * features[row, :n_features].double()
                            found += 1
                phi.append(total)
                all_valid.append(found == 4)
            all_encoded.append(
                {"sum": phi[0] + phi[1] + phi[2], "prod": phi[0] * phi[1] * phi[2], "cat": torch.cat(phi)}[reduce]
            )
    n, width = len(points), len(cell_sizes) * n_features * (3 if reduce == "cat" else 1)
    encoded = torch.stack(all_encoded).reshape(n, width) if all_encoded else torch.zeros(n, width, dtype=torch.float64)
    return encoded, torch.tensor(all_valid, dtype=torch.bool).reshape(n, len(cell_sizes), 3)


# --- ray_sample ---------------------------------------------------------------------------------------------------


def ray_sample(depth, uniforms, n_base, n_surface, truncation, near, far):
    result = []
    for d, u in zip(depth.tolist(), uniforms.tolist(), strict=True):
        z = [near * d + (k + u[k]) / n_base * (far - near) * d for k in range(n_base)]
        z += [d - truncation + (k + u[n_base + k]) / n_surface * 2 * truncation for k in range(n_surface)]
        result.append(sorted(z))
    return torch.tensor(result, dtype=torch.float64).reshape(len(depth), n_base + n_surface)


# --- ray_render ---------------------------------------------------------------------------------------------------


def ray_render(tsdf, color, z, sharpness, cut_behind):
    """Eq. 6-7 in torch scalars. The depth of the cut is one sum in the type of z, as the contract says."""
    colors, depths, weights = [], [], []
    for s, c, d in zip(tsdf.double(), color.double(), z, strict=True):
        crossings = [k for k in range(len(s) - 1) if s[k] > 0 >= s[k + 1]]
        cut = cut_behind is not None and bool(crossings)
        kept = [not cut or (d_i <= d[crossings[0]] + cut_behind).item() for d_i in d]
        d = d.double()
        w = [torch.sigmoid(s_i * sharpness) * torch.sigmoid(-s_i * sharpness) for s_i in s]
        w = [w_i * keep for w_i, keep in zip(w, kept, strict=True)]
        total = sum(w) + 1e-8
        colors.append(sum((w_i * c_i for w_i, c_i in zip(w, c, strict=True)), torch.zeros(3).double()) / total)
        depths.append(sum((w_i * d_i for w_i, d_i in zip(w, d, strict=True)), torch.zeros(()).double()) / total)
        weights.append(torch.stack([w_i / total for w_i in w]) if w else torch.zeros(0).double())
    if not colors:
        return color.new_zeros(0, 3).double(), z.new_zeros(0).double(), tsdf.new_zeros(tsdf.shape).double()
    return torch.stack(colors), torch.stack(depths), torch.stack(weights)


# --- interframe ---------------------------------------------------------------------------------------------------


def interframe(points_c, color, T_kc, image, camera):
    """Residuals [R, 3] and validity [R] of eq. 13."""
    fx, fy, cx, cy = camera
    height, width, _ = image.shape
    residuals, valid = np.zeros((len(points_c), 3)), np.zeros(len(points_c), dtype=bool)
    for r, (p, c) in enumerate(zip(points_c.double().numpy(), color.double().numpy(), strict=True)):
        x, y, z, _ = T_kc.double().numpy() @ np.append(p, 1.0)
        if z <= 0:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        if not (1 <= u <= width - 2 and 1 <= v <= height - 2):
            continue
        valid[r] = True
        for channel in range(3):
            total = 0.0
            for row in (math.floor(v), math.floor(v) + 1):
                for column in (math.floor(u), math.floor(u) + 1):
                    weight = (1 - abs(u - column)) * (1 - abs(v - row))
                    total += weight * int(image[row, column, channel]) / 255
            residuals[r, channel] = total - c[channel]
    return torch.from_numpy(residuals), torch.from_numpy(valid)
