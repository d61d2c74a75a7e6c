"""The dumb oracle of the fused field: plain torch from the paper's formulas, gradients by autograd. A dict is the
hash table. Slow on purpose, and nothing in common with csrc/."""

import math

import torch

AXES = [(0, 1), (1, 2), (2, 0)]  # of the planes xy, yz, zx


def gamma(x, spec):
    """Positional encoding, [N, 3] -> [N, 6 n_octaves]."""
    rows = []
    for octave in range(spec.n_octaves):
        angle = 2 * math.pi * 2**octave / spec.base_wavelength * x
        rows += [angle.sin(), angle.cos()]
    return torch.cat(rows, dim=1) if rows else x.new_zeros(len(x), 0)


def look_up(x, features, slots, spec):
    """Eq. 4, [N, 3] -> ([N, L * F], valid [N]). `slots` maps (level, plane, i, j) to a row of features."""
    encoded, valid = [], torch.ones(len(x), dtype=torch.bool)
    for level, cell in enumerate(spec.cell_sizes):
        total = x.new_zeros(len(x), spec.n_features)
        for plane, axes in enumerate(AXES):
            uv = x[:, axes] * torch.tensor(1 / cell, dtype=x.dtype)
            ij = uv.detach().floor().long()
            fraction = uv - ij
            for di in (0, 1):
                for dj in (0, 1):
                    rows = torch.tensor([slots.get((level, plane, i + di, j + dj), -1) for i, j in ij.tolist()])
                    rows = rows.reshape(len(x)).long()
                    w_u = fraction[:, 0] if di else 1 - fraction[:, 0]
                    w_v = fraction[:, 1] if dj else 1 - fraction[:, 1]
                    corner = torch.where((rows >= 0)[:, None], features[rows.clamp(min=0), : spec.n_features], 0)
                    total = total + (w_u * w_v)[:, None] * corner
                    valid &= rows >= 0
        encoded.append(total)
    return torch.cat(encoded, dim=1), valid


def mlp(x, parameters):
    for k in (1, 2, 3):
        x = x @ parameters[f"W{k}"].T + parameters[f"b{k}"]
        x = x.relu() if k < 3 else x
    return x


def split_decoder(flat, spec):
    """{"geometry" | "color": {"W1": ..., "b1": ...}} by walking the flat tensor."""
    E = 6 * spec.n_octaves + len(spec.cell_sizes) * spec.n_features
    sizes = {"geometry": (E, 1 + spec.n_geometry), "color": (6 * spec.n_octaves + spec.n_geometry, 3)}
    decoder, rest = {}, flat
    for name, (n_in, n_out) in sizes.items():
        decoder[name] = {}
        for k, (rows, columns) in enumerate([(spec.hidden, n_in), (spec.hidden, spec.hidden), (n_out, spec.hidden)], 1):
            decoder[name][f"W{k}"], rest = rest[: rows * columns].reshape(rows, columns), rest[rows * columns :]
            decoder[name][f"b{k}"], rest = rest[:rows], rest[rows:]
    assert len(rest) == 0
    return decoder


def field(x, features, slots, flat, spec):
    """Eq. 5: points [N, 3] -> (tsdf [N], color [N, 3], valid [N])."""
    decoder = split_decoder(flat, spec)
    encoded, valid = look_up(x, features, slots, spec)
    position = gamma(x, spec)
    out = mlp(torch.cat([position, encoded], dim=1), decoder["geometry"])
    color = mlp(torch.cat([position, out[:, 1:]], dim=1), decoder["color"]).sigmoid()
    return out[:, 0], color, valid


def strata(low, high, u):
    """[R], [R], [R, n] -> [R, n]: one sample per stratum of [low, high]."""
    n = u.shape[1]
    return low[:, None] + (torch.arange(n, dtype=u.dtype) + u) / max(n, 1) * (high - low)[:, None]


def render_ray(s, color, z, spec):
    """Eq. 6-7 of one ray: [S], [S, 3], [S] -> ([3], scalar)."""
    w = (s * spec.sharpness).sigmoid() * (-s * spec.sharpness).sigmoid()
    if spec.cut_behind:
        for k in range(len(s) - 1):
            if s[k] > 0 and s[k + 1] <= 0:
                w = torch.where(z > z[k] + spec.truncation, 0, w)
                break
    p = w / (w.sum() + 1e-8)
    return p @ color, p @ z


def field_map(dirs_c, depth, color, frame_index, T_wc, u, features, slots, flat, spec, n_base, n_surface, near, far):
    """Eq. 8-10, [4]."""
    T_r = spec.truncation
    z = torch.cat(
        [strata(near * depth, far * depth, u[:, :n_base]), strata(depth - T_r, depth + T_r, u[:, n_base:])], dim=1
    )
    z = z.sort(dim=1).values
    losses = torch.zeros(4, dtype=depth.dtype)
    for r in range(len(depth)):
        T = T_wc[frame_index[r].item()]
        points_w = (z[r][:, None] * dirs_c[r]) @ T[:3, :3].T + T[:3, 3]
        s, c, _ = field(points_w, features, slots, flat, spec)
        c_ray, d_ray = render_ray(s, c, z[r], spec)
        free = depth[r] - z[r] > T_r
        near_surface = (depth[r] - z[r]).abs() <= T_r
        terms = [
            ((c_ray - color[r]) ** 2).mean(),
            (d_ray - depth[r]) ** 2,
            ((s - 1)[free] ** 2).mean() if free.any() else s.sum() * 0,
            ((z[r] + T_r * s - depth[r])[near_surface] ** 2).mean() if near_surface.any() else s.sum() * 0,
        ]
        losses = losses + torch.stack(terms) / len(depth)
    return losses


def exp_se3(twist):
    """Matrix exponential of a twist (rho, phi)."""
    x = torch.zeros(4, 4, dtype=twist.dtype)
    a, b, c = twist[3], twist[4], twist[5]
    zero = torch.zeros_like(a)
    x = torch.stack(
        [
            torch.stack([zero, -c, b, twist[0]]),
            torch.stack([c, zero, -a, twist[1]]),
            torch.stack([-b, a, zero, twist[2]]),
            torch.stack([zero, zero, zero, zero]),
        ]
    )
    return torch.linalg.matrix_exp(x)


def field_track(dirs_c, depth, T_wc, u, features, slots, flat, spec, band):
    """Residuals [R, S], their Jacobian [R, S, 6] by autograd through T exp(twist), valid [R, S]."""
    z = strata(depth - band, depth + band, u)
    points_c = (z[..., None] * dirs_c[:, None]).reshape(-1, 3)

    def residuals(twist):
        T = T_wc @ exp_se3(twist)
        s, _, valid = field(points_c @ T[:3, :3].T + T[:3, 3], features, slots, flat, spec)
        return (z + spec.truncation * s.reshape(z.shape) - depth[:, None]), valid.reshape(z.shape)

    twist = torch.zeros(6, dtype=depth.dtype)
    value, valid = residuals(twist)
    if not value.numel():
        return value, value.new_zeros(*value.shape, 6), valid
    jacobian = torch.autograd.functional.jacobian(lambda t: residuals(t)[0], twist)
    return value, jacobian, valid
