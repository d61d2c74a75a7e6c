"""snh.nn: growth loses nothing, maps load at any size, and the separate ops equal the fused ones."""

import copy
import io
import itertools

import pytest
import reference
import torch
from torch import nn

from snh.nn import Decoder, FrequencyEncoding, PlaneHashEncoding, SceneField, follow_growth
from snh.ops.field import FieldSpec, field_query

CELLS = (0.1, 0.25)
SPEC = FieldSpec(cell_sizes=CELLS, n_octaves=3, hidden=8, n_geometry=4, base_wavelength=4.0)


def random_points(n: int, low: float, high: float, seed: int = 0, dtype=torch.float32) -> torch.Tensor:
    return low + (high - low) * torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def all_vertices(encoding: PlaneHashEncoding) -> torch.Tensor:
    """(level, plane, i, j) of every vertex, [N, 4], by unpacking keys and masks with divisions."""
    rows = []
    for key, mask in zip(encoding.table.brick_keys.tolist(), encoding.table.masks.tolist(), strict=True):
        head, i, j = key // 2**56, key // 2**28 % 2**28 - 2**27, key % 2**28 - 2**27
        rows += [(head // 4, head % 4, 8 * i + b % 8, 8 * j + b // 8) for b in range(64) if mask % 2**64 >> b & 1]
    return torch.tensor(rows).reshape(-1, 4)


def randomise(encoding: PlaneHashEncoding, seed: int = 0) -> None:
    slots = encoding.table.find(all_vertices(encoding))
    generator = torch.Generator().manual_seed(seed)
    encoding.features.data[slots, :3] = torch.randn(len(slots), 3, generator=generator).to(encoding.features.dtype)


# --- PlaneHashEncoding ------------------------------------------------------------------------------------------------


def test_by_hand():
    """One vertex of the xy plane carries (8, 4, 2); the point lies 1/4 and 1/2 of a cell away from it."""
    encoding = PlaneHashEncoding([1.0])
    encoding.allocate_box((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
    assert encoding.n_vertices == 3 * 4
    slot = encoding.table.find(torch.tensor([[0, 0, 1, 0]]))
    encoding.features.data[slot, :3] = torch.tensor([8.0, 4.0, 2.0])
    encoded, valid = encoding(torch.tensor([[[0.75, 0.5, 0.1]], [[1.5, 0.5, 0.1]]]), return_valid=True)
    assert encoded.tolist() == [[[3.0, 1.5, 0.75]], [[2.0, 1.0, 0.5]]]
    assert valid.tolist() == [[True], [False]]


@pytest.mark.parametrize("reduce", ["sum", "prod", "cat"])
def test_shapes(reduce):
    encoding = PlaneHashEncoding(CELLS, n_features=2, reduce=reduce)
    assert encoding(torch.zeros(3)).shape == (encoding.width,)
    encoding.allocate_box((0, 0, 0), (1, 1, 1))
    for shape in [(3,), (0, 3), (4, 3), (2, 5, 3)]:
        encoded, valid = encoding(torch.rand(shape), return_valid=True)
        assert encoded.shape == (*shape[:-1], encoding.width)
        assert valid.shape == shape[:-1]
        assert valid.all()


def test_allocated_space_is_valid(dtype):
    encoding = PlaneHashEncoding(CELLS, dtype=dtype)
    encoding.allocate_box((-1.0, 2.0, -0.3), (1.0, 3.0, 0.3))
    box = torch.tensor(list(itertools.product((-1.0, 1.0), (2.0, 3.0), (-0.3, 0.3))), dtype=dtype)
    assert encoding(box, return_valid=True)[1].all()
    points = random_points(200, 5, 9, dtype=dtype)
    assert not encoding(points, return_valid=True)[1].any()
    encoding.allocate_hull(points, points[0])
    assert encoding(points, return_valid=True)[1].all()


def test_growth_keeps_parameter_rows_and_gradient():
    encoding = PlaneHashEncoding(CELLS)
    parameter = encoding.features
    encoding.allocate_box((0, 0, 0), (1, 1, 1))
    randomise(encoding)
    points = random_points(50, 0, 1)
    loss = encoding(points).square().sum()  # kept alive: its graph remembers the old shape
    loss.backward()
    encoded, features, grad = encoding(points).detach(), parameter.detach().clone(), parameter.grad.clone()
    n_rows, storages = len(features), set()
    for step in range(1, 30):
        encoding.allocate_box((step, 0, 0), (step + 1, 1, 1))
        storages.add(parameter.data_ptr())
        assert encoding.features is parameter
        assert len(parameter) == len(parameter.grad) == 64 * encoding.table.n_bricks
    assert len(storages) < 8  # room doubles: few copies
    assert torch.equal(parameter[:n_rows], features)
    assert torch.equal(parameter.grad[:n_rows], grad)
    assert not parameter[n_rows:].any()
    assert not parameter.grad[n_rows:].any()
    assert torch.equal(encoding(points), encoded)
    encoding(random_points(50, 20, 21)).sum().backward()
    with pytest.raises(RuntimeError):
        loss.square().backward()


@pytest.mark.parametrize(
    "make",
    [
        lambda p: torch.optim.Adam(p, lr=0.01, betas=(0.9, 0.99), eps=1e-15),
        lambda p: torch.optim.AdamW(p, lr=0.01, amsgrad=True, foreach=True),
        lambda p: torch.optim.SGD(p, lr=0.01, momentum=0.9),
        lambda p: torch.optim.RMSprop(p, lr=0.01),
    ],
    ids=["Adam", "AdamW", "SGD", "RMSprop"],
)
def test_moments_survive_growth(make):
    """Training that grows half-way equals training that had all room from the start, bit for bit."""
    near, far = ((0, 0, 0), (1, 1, 1)), ((0.5, 0, 0), (3, 1, 1))
    growing, whole = PlaneHashEncoding(CELLS), PlaneHashEncoding(CELLS)
    growing.allocate_box(*near)
    whole.allocate_box(*far)
    whole.allocate_box(*near)
    optimizers = [follow_growth(make(encoding.parameters())) for encoding in (growing, whole)]
    for step in range(8):
        if step == 4:
            growing.allocate_box(*far)
        points = random_points(64, 0, 1, step) * torch.tensor([3.0 if step >= 4 else 1.0, 1, 1])
        for encoding, optimizer in zip((growing, whole), optimizers, strict=True):
            optimizer.zero_grad(set_to_none=step % 2 == 0)
            (encoding(points) - points.repeat(1, 2)).square().mean().backward()
            optimizer.step()
    vertices = all_vertices(whole)
    assert growing.features.any()
    slots = [encoding.table.find(vertices) for encoding in (growing, whole)]
    assert torch.equal(growing.features[slots[0]], whole.features[slots[1]])


def test_without_follow_growth_the_optimizer_refuses():
    encoding = PlaneHashEncoding(CELLS)
    optimizer = torch.optim.Adam(encoding.parameters())
    for step in range(2):
        encoding.allocate_box((step, 0, 0), (step + 1, 1, 1))
        encoding(torch.rand(4, 3)).sum().backward()
        if step == 0:
            optimizer.step()
    with pytest.raises(RuntimeError):
        optimizer.step()


def test_state_loads_at_any_capacity():
    saved = PlaneHashEncoding(CELLS)
    saved.allocate_box((0, 0, 0), (1, 1, 1))
    saved.allocate_box((1, 0, 0), (2, 1, 1))
    randomise(saved)
    buffer = io.BytesIO()
    torch.save(saved.state_dict(), buffer)
    assert buffer.tell() < saved.features.nbytes + 16 * saved.table.n_bricks + 4096  # nothing of the spare room
    buffer.seek(0)
    state = torch.load(buffer, weights_only=True)

    points = random_points(50, 0, 2)
    larger = PlaneHashEncoding(CELLS)
    larger.allocate_box((-5, -5, -5), (5, 5, 5))
    larger.features.data.fill_(7)
    larger.features.grad = torch.ones_like(larger.features)
    for encoding in (PlaneHashEncoding(CELLS), larger):
        parameter = encoding.features
        encoding.load_state_dict(state)
        assert encoding.features is parameter
        assert parameter.grad is None
        assert torch.equal(encoding(points), saved(points))
        encoding.allocate_box((2, 0, 0), (3, 1, 1))
        assert not encoding.features[len(state["features"]) :].any()
    saved.allocate_box((2, 0, 0), (3, 1, 1))
    assert torch.equal(saved.table.brick_keys, larger.table.brick_keys)


def test_broken_state_is_refused():
    encoding = PlaneHashEncoding(CELLS)
    encoding.allocate_box((0, 0, 0), (1, 1, 1))
    state = encoding.state_dict()
    with pytest.raises(RuntimeError, match=r"features \[64, 4\] does not fit \d+ bricks of 64"):
        encoding.load_state_dict({**state, "features": torch.zeros(64, 4)})
    with pytest.raises(RuntimeError, match=r"Missing key.*masks"):
        encoding.load_state_dict({name: value for name, value in state.items() if name != "masks"})


def test_copies_and_types():
    encoding = PlaneHashEncoding(CELLS)
    encoding.allocate_box((0, 0, 0), (1, 1, 1))
    randomise(encoding)
    points = random_points(20, 0, 1)
    other = copy.deepcopy(encoding)
    other.allocate_box((1, 0, 0), (2, 1, 1))
    other.double()
    other.allocate_box((2, 0, 0), (3, 1, 1))
    other.features.data[64 * encoding.table.n_bricks :] = 1
    assert other.features.dtype == torch.float64
    assert len(encoding.features) == 64 * encoding.table.n_bricks < len(other.features)
    # float32: positions of up to 10 cells, so weights to 10 x 2^-24, times features of up to 4 on three planes
    assert torch.allclose(other(points.double()).float(), encoding(points), rtol=0, atol=1e-5)


def test_memory_bytes():
    encoding = PlaneHashEncoding([1.0])
    assert encoding.memory_bytes(occupied=True) == 0
    encoding.allocate_box((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
    assert encoding.memory_bytes(occupied=True) == 12 * 3 * 4
    assert encoding.memory_bytes() == 3 * 64 * 4 * 4 + encoding.table.n_bytes


def test_initial_features_depend_on_the_vertex_alone():
    boxes = [((0, 0, 0), (1, 1, 1)), ((0.5, -1, 0), (1.5, 0.5, 2)), ((-3, -3, -3), (3, 3, 3))]
    first, second = (PlaneHashEncoding(CELLS, init_std=0.1, seed=3) for _ in range(2))
    for a, b in zip(boxes, reversed(boxes), strict=True):
        first.allocate_box(*a)
        second.allocate_box(*b)
    vertices = all_vertices(first)
    slots = first.table.find(vertices)
    assert torch.equal(first.features[slots], second.features[second.table.find(vertices)])
    absent = torch.ones(len(first.features), dtype=torch.bool)
    absent[slots] = False
    values = first.features[slots, :3]
    assert not first.features[absent].any()
    assert not first.features[:, 3].any()
    # mean, deviation and correlation of neighbours of n normal numbers: within 5 standard errors
    n = values.numel()
    assert abs(values.mean()) < 5 * 0.1 / n**0.5
    assert abs(values.std() - 0.1) < 5 * 0.1 / (2 * n) ** 0.5
    assert abs((values.flatten()[1:] * values.flatten()[:-1]).mean()) < 5 * 0.1**2 / n**0.5
    other_seed = PlaneHashEncoding(CELLS, init_std=0.1, seed=4)
    other_seed.allocate_box(*boxes[2])
    assert not torch.equal(other_seed.features[other_seed.table.find(vertices), :3], values)


def test_initial_features_by_hand():
    """The hash in Python's own integers."""

    def mix(x):
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            x = (x ^ x >> shift) * factor % 2**64
        return x ^ x >> 31

    encoding = PlaneHashEncoding([1.0], init_std=2.0, seed=5)
    encoding.allocate_box((-0.5, 0.5, 0.5), (-0.5, 0.5, 0.5))
    golden = 0x9E3779B97F4A7C15
    for vertex in [(0, 0, -1, 0), (0, 0, 0, 1), (0, 1, 1, 1), (0, 2, 0, -1)]:
        key, place = reference.vertex_key(*vertex)
        slot = encoding.table.find(torch.tensor([vertex]))
        for feature in range(3):
            bits = mix((mix((key + 5 * golden) % 2**64) + (3 * place + feature + 1) * golden) % 2**64)
            total = sum(bits >> shift & 0xFFFF for shift in (0, 16, 32, 48)) - 2 * 0xFFFF
            expected = 2.0 * total / ((2**32 - 1) / 3) ** 0.5
            assert encoding.features[slot, feature].item() == pytest.approx(expected, rel=1e-6)


# --- gamma and decoders -----------------------------------------------------------------------------------------------


def test_frequency_encoding_by_hand():
    """Wavelengths of 4 and 2 m at x = 1, y = 0.5, z = 0."""
    encoded = FrequencyEncoding(n_octaves=2, base_wavelength=4.0)(torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64))
    h = 0.5**0.5
    expected = torch.tensor([1, h, 0, 0, h, 1, 0, 1, 0, -1, 0, 1], dtype=torch.float64)
    assert torch.allclose(encoded, expected, atol=1e-15, rtol=0)
    assert FrequencyEncoding(0, 4.0)(torch.zeros(5, 3)).shape == (5, 0)


def as_linear(weight: torch.Tensor, bias: torch.Tensor) -> nn.Linear:
    linear = nn.Linear(weight.shape[1], weight.shape[0], dtype=weight.dtype)
    linear.weight.data, linear.bias.data = weight, bias
    return linear


def test_decoder_is_two_networks_of_linear_layers():
    """The flat tensor, walked in the order of the contract, as nn.Linear layers."""
    decoder = Decoder(SPEC, seed=1)
    rest, layers = decoder.weight.detach(), []
    for n_in, n_out in ((18 + 6, 5), (18 + 4, 3)):
        for rows, columns in ((8, n_in), (8, 8), (n_out, 8)):
            weight, bias = rest[: rows * columns].view(rows, columns), rest[rows * columns :][:rows]
            layers += [as_linear(weight, bias), nn.ReLU()]
            rest = rest[rows * (columns + 1) :]
        layers.pop()
    assert len(rest) == 0
    geometry, color = nn.Sequential(*layers[:5]), nn.Sequential(*layers[5:])
    gamma, encoded = torch.randn(7, 18), torch.randn(7, 6)
    out = geometry(torch.cat([gamma, encoded], dim=1))
    tsdf, rgb = decoder(gamma, encoded)
    assert torch.equal(tsdf, out[:, 0])
    assert torch.equal(rgb, color(torch.cat([gamma, out[:, 1:]], dim=1)).sigmoid())


def test_decoder_starts_as_linear_layers_do():
    """Uniform within 1 / sqrt(inputs), weights and biases alike."""
    spec = FieldSpec(cell_sizes=CELLS)
    weight = Decoder(spec, seed=1).weight
    for name, view in spec.decoder_views(weight.detach()).items():
        bound = spec.decoder_views(weight.detach())[name.replace(".b", ".W")].shape[1] ** -0.5
        assert view.abs().max() <= bound
        if view.numel() > 100:
            assert view.abs().max() > 0.95 * bound
            assert abs(view.mean()) < 5 * bound / (3 * view.numel()) ** 0.5
    assert torch.equal(weight, Decoder(spec, seed=1).weight)
    assert not torch.equal(weight, Decoder(spec, seed=2).weight)


# --- SceneField -------------------------------------------------------------------------------------------------------


def make_field(dtype: torch.dtype) -> SceneField:
    field = SceneField(SPEC, seed=2)
    field.encoding.allocate_box((0, 0, 0), (1, 1, 1))
    randomise(field.encoding)
    return field.to(dtype)


# Both sum about 30 products per layer; 1e-10 is the project's bound for double, and 100 roundings of values near 1
# for float.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 100 * 2**-23)])
@pytest.mark.parametrize("n", [0, 1, 31, 32, 33])
def test_separate_ops_equal_the_fused_query(dtype, tolerance, n):
    field = make_field(dtype)
    points = random_points(n, -0.3, 1.3, seed=n, dtype=dtype)
    tsdf, color = field(points)
    fused = field_query(points, field.features, field.table, field.decoder.weight, field.spec)
    assert torch.allclose(tsdf, fused[0], rtol=0, atol=tolerance)
    assert torch.allclose(color, fused[1], rtol=0, atol=tolerance)
    assert torch.equal(field.encoding(points, return_valid=True)[1], fused[2])


def test_gradients_to_points_twice():
    """Points away from the borders of cells and from the kinks of ReLU, where no derivative exists."""
    field = make_field(torch.float64)
    points = random_points(4, 0.1, 0.9, seed=3, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(field, points)
    assert torch.autograd.gradgradcheck(field, points)


def test_eikonal_loss_reaches_every_parameter():
    field = make_field(torch.float64)
    points = random_points(50, 0, 1, dtype=torch.float64).requires_grad_()

    def eikonal():
        (normals,) = torch.autograd.grad(field(points)[0].sum(), points, create_graph=True)
        return (normals.norm(dim=-1) - 1).square().mean()

    eikonal().backward()
    for parameter, index in ((field.features, field.features.grad.abs().argmax()), (field.decoder.weight, 3)):
        step, values = 1e-6, []
        for sign in (1, -1):
            parameter.data.view(-1)[index] += sign * step
            values.append(eikonal().item())
            parameter.data.view(-1)[index] -= sign * step
        numeric = (values[0] - values[1]) / (2 * step)
        assert numeric == pytest.approx(parameter.grad.view(-1)[index].item(), rel=1e-5)
        assert abs(numeric) > 1e-6


def test_scene_field_state():
    field = make_field(torch.float32)
    state = field.state_dict()
    assert set(state) == {"encoding.features", "encoding.brick_keys", "encoding.masks", "decoder.weight"}
    other = SceneField(SPEC, seed=9)
    other.load_state_dict(state)
    points = random_points(10, 0, 1)
    for one, two in zip(field(points), other(points), strict=True):
        assert torch.equal(one, two)
