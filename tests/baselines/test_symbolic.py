"""Torch functions as CasADi expressions: the same values, exact derivatives, and errors that say what is missing."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from ponn_torch.baselines.symbolic import evaluate, load_casadi

casadi = pytest.importorskip("casadi")

MATRIX = [[1.0, 2.0, -1.0], [0.5, 0.0, 3.0], [-2.0, 1.0, 1.0]]


def skew(x: Tensor) -> Tensor:
    """The matrix of a cross product, with a diagonal that makes it invertible."""
    a, b, c = x.unbind(-1)
    return torch.stack([torch.stack(row, -1) for row in ([a, -c, b], [c, b, -a], [-b, a, c])], -2)


FUNCTIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "gravity": lambda x: -x / torch.sqrt((x * x).sum(-1, keepdim=True)) ** 3,
    "norm": lambda x: x / x.norm(dim=-1, keepdim=True),
    "matrix": lambda x: x @ x.new_tensor(MATRIX),
    "matrix from the left": lambda x: torch.einsum("ij,...j->...i", x.new_tensor(MATRIX), x),
    "cross": lambda x: torch.stack([x[..., 1], -x[..., 0], torch.zeros_like(x[..., 0])], -1),
    "slices": lambda x: torch.cat([x[..., 1:], 2.0 - x[..., :1], x.new_zeros(*x.shape[:-1], 1)], -1),
    "pieces": lambda x: torch.cat([*x.split(2, -1), *x.split((1, 2), -1)], -1) * torch.stack(x.unbind(-1), -1).sum(),
    "angles": lambda x: torch.atan2(torch.sin(x), torch.cos(x)) + torch.tan(x) * torch.tanh(x),
    "exponentials": lambda x: torch.exp(-x) + torch.log(x) + torch.log1p(x) + torch.sigmoid(x) + torch.expm1(x),
    "choices": lambda x: torch.where(x > 1.0, x**2, x.clamp(0.8, 1.2)) + torch.minimum(x, 1.0 / x).abs(),
    "mean": lambda x: (x - x.mean(-1, keepdim=True)).square() + torch.rsqrt(x),
    "indices": lambda x: x[..., [0]] * x[..., [2, 1]] + x[:, torch.tensor([True, False, True])],
    "indices of two axes": lambda x: (x[..., None] * x[..., None, :])[..., [0, 1], [1, 2]],
    "indices by name": lambda x: x.index_select(-1, torch.tensor([2, 0])).gather(-1, torch.tensor([[1]])),
    "order": lambda x: x.roll(1, -1) * x.flip(-1) + x.roll((-1,), (-1,)) + x[..., :1].repeat(1, 3),
    "vectors": lambda x: torch.linalg.cross(x, x.flip(-1)) + torch.outer(x[0], x[0]) @ torch.vdot(x[0], x[0]).expand(3),
    "layer": lambda x: torch.relu(torch.nn.functional.linear(x, x.new_tensor(MATRIX), x.new_tensor([1.0, 2.0, 3.0]))),
    "matrices": lambda x: torch.linalg.solve(torch.diag_embed(x) + x.new_tensor(MATRIX), x),
    "inverses": lambda x: (torch.linalg.inv(x.new_tensor(MATRIX)) @ torch.linalg.inv(skew(x))).sum(-1),
    "determinant": lambda x: (
        torch.linalg.det(skew(x))[..., None] + skew(x).diagonal(dim1=-2, dim2=-1) * x.prod(-1, keepdim=True)
    ),
    "constants": lambda x: x @ torch.eye(3, dtype=x.dtype) * torch.arange(3) + torch.linspace(0.0, 1.0, 3),
    "extremes": lambda x: x.amax(-1) - x.min(-1, keepdim=True).values + x.max() * torch.fmin(x, 1.0 / x),
    "norms": lambda x: (
        x.norm(p=1, dim=-1, keepdim=True) + torch.linalg.norm(x - 1.0, ord=torch.inf, dim=-1) * torch.norm(x)
    ),
    "running": lambda x: x.cumsum(-1) * x.cumprod(-1) + x.prod(),
    "soft choices": lambda x: x.logsumexp(-1, keepdim=True) + x.softmax(-1) + torch.logaddexp(x, x.log_softmax(-1)),
    "softplus": lambda x: torch.nn.functional.softplus(x * x.new_tensor([-1.0, 20.0, 3000.0])) + torch.exp2(x),
    "logic": lambda x: torch.where((x > 0.5) & ~(x > 1.0) | (x > 9.0), x, 0.0).masked_fill(x < 0.1, 1.0),
    "remainders": lambda x: torch.deg2rad(x % 0.3) + (x - 1.0) % 0.3 + torch.fmod(x - 1.0, 0.25) + torch.log2(x),
    "full": lambda x: torch.full_like(x, 3.0) * torch.ones_like(x) - torch.hypot(x, x.new_tensor(2.0)),
}


def as_function(function: Callable[[Tensor], Tensor]) -> object:
    symbol = casadi.SX.sym("x", 3)
    values = evaluate(function, np.array([[symbol[i] for i in range(3)]], dtype=object))
    return casadi.Function("f", [symbol], [casadi.vertcat(*values.ravel())])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_derivatives_are_those_of_torch(name: str) -> None:
    function, x = FUNCTIONS[name], torch.tensor([[0.7, 1.3, 0.4]], dtype=torch.float64)
    symbolic = as_function(function)
    found = np.asarray(symbolic(x[0].numpy())).ravel()
    np.testing.assert_allclose(found, function(x)[0].numpy(), rtol=1e-14, atol=1e-15)
    jacobian = torch.func.jacrev(lambda v: function(v[None])[0])(x[0])
    by_casadi = np.asarray(symbolic.jacobian()(x[0].numpy(), 0.0))
    np.testing.assert_allclose(by_casadi, jacobian.numpy(), rtol=1e-13, atol=1e-14)


def test_an_unknown_operation_is_named() -> None:
    with pytest.raises(
        ValueError, match="counterpart of torch operation 'erfinv'; allowed: elementary functions, "
    ) as told:
        as_function(torch.erfinv)
    assert "\n" not in str(told.value)  # torch would add its graph


@pytest.mark.parametrize(
    ("function", "told"),
    [
        (lambda x: x.norm(p=3, dim=-1), "'linalg_vector_norm' as it is used: order 3; allowed: 1, 2, inf"),
        (lambda x: x.div(0.3, rounding_mode="floor"), "'div' as it is used: .* 'rounding_mode'"),
        (lambda x: x * x.max(-1).indices, "'mul' as it is used: "),
    ],
)
def test_an_unknown_use_of_an_operation_is_told(function: Callable[[Tensor], Tensor], told: str) -> None:
    with pytest.raises(ValueError, match=f"no CasADi counterpart of torch operation {told}"):
        as_function(function)


def test_a_choice_by_data_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot be traced"):
        as_function(lambda x: x if bool(x.sum() > 1.0) else -x)


def test_without_casadi_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(ImportError, match=r"pip install ponn-torch\[baselines\]"):
        load_casadi()
