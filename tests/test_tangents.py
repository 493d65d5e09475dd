"""Tensors that carry derivatives by n variables: every rule against the derivatives of torch's graph."""

import pytest
import torch
from torch.testing import assert_close

from raytrace.maths.numerics import varies
from raytrace.maths.tangents import (
    MovingTensor,
    applied,
    tangents_of,
    value_of,
    values_alone,
    with_tangents,
)


def drawn(*shape: int, seed: int) -> torch.Tensor:
    return 0.2 + torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


X, Y, Z = drawn(3, 4, seed=1), drawn(4, seed=2), drawn(3, 3, seed=3)
COUNT = X.numel() + Y.numel() + Z.numel()
INSIDE = X > 0.7
PLACES = torch.tensor([2, 0, 1])

UNARY = (
    "sqrt rsqrt square reciprocal neg abs exp log log10 sin cos tan asin acos atan sinh cosh tanh erf deg2rad rad2deg"
)

FUNCTIONS = {
    "sum and difference": lambda x, y, z: x + y - 3 + (2 - x) + torch.add(x, y, alpha=2) - torch.sub(x, y, alpha=3),
    "product and quotient": lambda x, y, z: x * y * 3 + 1 / x + x / y,
    "powers": lambda x, y, z: x**2 + x**y + 2.0**x,
    "functions of one": lambda x, y, z: sum(getattr(torch, name)(x / 2) for name in UNARY.split()),
    "functions of two": lambda x, y, z: torch.hypot(x, y) + torch.atan2(y, x) + torch.addcmul(x, x, y),
    "signs": lambda x, y, z: torch.copysign(x - 0.6, y - 0.7) + torch.copysign(X, y - 0.7) + torch.copysign(y, -X),
    "larger and smaller": lambda x, y, z: (
        torch.maximum(x, y) + torch.minimum(x, y) + x.clamp(0.4, 0.7) + x.clamp_min(0.5)
    ),
    "extremes": lambda x, y, z: x.amax(0) + x.max() + x.min(1, keepdim=True).values + x.amin((0, 1)),
    "choice": lambda x, y, z: torch.where(INSIDE, x, y) + torch.where(INSIDE, 0.0, x) + x.where(INSIDE, y),
    "joined": lambda x, y, z: torch.cat([torch.stack([x, y.expand(3, 4), 0 * X], -1).sum(-1), y[None]], 0),
    "sums": lambda x, y, z: x.sum() + x.sum(0) + x.sum((0, 1)) + x.mean(-1, keepdim=True).sum(0) + x.cumsum(1)[0],
    "entries": lambda x, y, z: x[1:, None, ..., 0].sum() * x[0] + x[INSIDE].sum() + x.gather(1, PLACES[:, None])[0],
    "unbound": lambda x, y, z: sum(x.unbind(-1)).sum() + sum(y.unbind()),
    "shapes": lambda x, y, z: x.reshape(2, 6).flatten()[:4] + x.view(4, 3).expand(2, 4, 3)[0].T[0] + x.expand_as(x)[1],
    "axes": lambda x, y, z: (
        x.movedim(0, -1).T + x.transpose(0, 1).mT + x[None].squeeze(0) + x.flip(0).unsqueeze(-1)[..., 0]
    ),
    "matrices": lambda x, y, z: z @ x + z @ X + Z @ x,
    "matrix and vector": lambda x, y, z: (z @ x) @ y,
    "contraction": lambda x, y, z: torch.einsum("ij,j,ik->k", x, y, z),
    "equations": lambda x, y, z: torch.linalg.solve(z, x),
    "lengths": lambda x, y, z: torch.linalg.vector_norm(x, dim=0) + torch.linalg.vector_norm(y),
    "complex": lambda x, y, z: (torch.exp(torch.complex(x, y.expand(3, 4))) * 2j).real + torch.polar(x, x).imag,
    "fourier": lambda x, y, z: torch.fft.fft2(x).abs() + torch.fft.ifft(torch.fft.fft(x, dim=0), dim=0).real,
    "placed": lambda x, y, z: x.new_zeros(5, 4).index_copy(0, PLACES, x)[:3],
    "broadcast": lambda x, y, z: sum(torch.broadcast_tensors(x, y, X)),
    "conversions": lambda x, y, z: x.to(torch.float64).clone().contiguous().double() * float(y.sum().detach()),
    "parts": lambda x, y, z: sum(x.split(2, -1)).permute(1, 0)[:, [0, 1]] + torch.broadcast_to(y, (2, 4))[:, :2].sum(),
    "chosen places": lambda x, y, z: x.index_select(1, PLACES).nan_to_num() + x.index_select(-1, PLACES),
    "vector product": lambda x, y, z: torch.linalg.cross(z, Z, dim=0) + torch.linalg.cross(Z, z[:1], dim=-1),
    "without a rule": lambda x, y, z: torch.lerp(x, y, 0.3) + x.sort(0).values + torch.special.bessel_j0(x.detach()),
}


def moving() -> tuple[torch.Tensor, ...]:
    every, first, parts = torch.eye(COUNT, dtype=torch.float64), 0, []
    for value in (X, Y, Z):
        last = first + value.numel()
        parts.append(with_tangents(value, every[:, first:last].reshape(COUNT, *value.shape)))
        first = last
    return tuple(parts)


def by_graph(function, x, y, z) -> torch.Tensor:
    """∂f/∂(x, y, z) (n, ...) by torch's graph."""
    of = torch.autograd.functional.jacobian(function, (x, y, z), create_graph=x.requires_grad)
    value = function(x, y, z)
    columns = [part.reshape(*value.shape, -1) for part in of]
    return torch.cat(columns, -1).movedim(-1, 0)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_are_those_of_the_graph(name):
    result = FUNCTIONS[name](*moving())
    assert isinstance(result, MovingTensor)
    assert_close(value_of(result), FUNCTIONS[name](X, Y, Z), rtol=0, atol=0)
    assert_close(tangents_of(result, COUNT), by_graph(FUNCTIONS[name], X, Y, Z), rtol=1e-12, atol=1e-12)


def test_derivatives_have_derivatives():
    x = X.clone().requires_grad_()
    moved = with_tangents(x, torch.ones(1, 3, 4, dtype=torch.float64))
    slope = tangents_of(torch.sin(moved) * moved**2, 1)
    (second,) = torch.autograd.grad(slope.sum(), x)
    assert_close(second, 2 * X.sin() * 1 + 4 * X * X.cos() - X**2 * X.sin(), rtol=1e-12, atol=0)


def test_gradients_within_a_function_carry_derivatives():
    """∂/∂v of ∂f/∂s, s not among the variables: a root or a slope that a function finds by gradients of its own."""
    x, *_ = moving()
    s = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad((torch.sin(s * x) * x).sum(), s, create_graph=True)
    assert_close(value_of(slope).detach(), (torch.cos(0.3 * X) * X**2).sum(), rtol=1e-14, atol=0)
    expected = -torch.sin(0.3 * X) * 0.3 * X**2 + 2 * X * torch.cos(0.3 * X)
    assert_close(tangents_of(slope, COUNT).detach()[: X.numel()].reshape(3, 4), expected, rtol=1e-13, atol=0)
    assert not tangents_of(slope, COUNT)[X.numel() :].any()


def test_nothing_is_lost_in_silence():
    x, y, _ = moving()
    with pytest.raises(RuntimeError, match="changes a tensor in place"):
        X.clone()[0] = y
    with pytest.raises(RuntimeError, match="has no array"):
        x.numpy()
    assert tangents_of(x.mH, COUNT).any()  # a property without a rule
    assert varies(x)
    assert not varies(x.detach())


def test_values_alone_without_a_graph_or_where_asked_for():
    x, *_ = moving()
    with torch.no_grad():
        assert not isinstance(x * x, MovingTensor)
    with values_alone():
        assert not isinstance(torch.lerp(x, x, 0.5), MovingTensor)
    assert isinstance((x > 0.5), torch.Tensor)
    assert not isinstance(x > 0.5, MovingTensor)


class Cube(torch.autograd.Function):
    """x³ with derivatives of its own."""

    @staticmethod
    def forward(x):
        return x**3

    @staticmethod
    def setup_context(context, inputs, output):
        context.save_for_backward(*inputs)
        context.save_for_forward(*inputs)

    @staticmethod
    def jvp(context, tangent):
        (x,) = context.saved_tensors
        return 3 * x**2 * tangent


@pytest.mark.parametrize("slopes", [None, lambda x: (3 * x**2,)])
def test_functions_with_derivatives_of_their_own(slopes):
    x, *_ = moving()
    cube = applied(Cube, x, slopes=slopes)
    assert_close(tangents_of(cube, COUNT), 3 * X**2 * x.tangents, rtol=1e-14, atol=0)
    assert_close(applied(Cube, X), X**3, rtol=0, atol=0)
