"""Damped steps of dense and arrow-shaped Jacobians are the solutions of their normal equations."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers import random, relative
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ponn_torch.numerics import linalg
from ponn_torch.numerics.linalg import LINEAR_SOLVERS, ArrowJacobian, DenseJacobian, Jacobian
from ponn_torch.numerics.tape import RECORDING_PAYS


def dense(batch: tuple[int, ...] = (), rows: int = 12, columns: int = 7, seed: int = 0) -> DenseJacobian:
    return DenseJacobian(random(*batch, rows, columns, seed=seed, low=-1.0))


NO_UNKNOWN = 6
# what three segments see of six shared unknowns: some share, one sees a column twice, one sees none at all
INDEX = [[0, 1, 2, NO_UNKNOWN, 3], [2, 3, 4, NO_UNKNOWN, 0], [4, 5, 1, 5, NO_UNKNOWN]]
NEIGHBOURS = [[NO_UNKNOWN, 0, 1, 2, 3], [2, 3, 4, 5, NO_UNKNOWN], [NO_UNKNOWN] * 5]


def arrow(
    batch: tuple[int, ...] = (),
    *,
    index: list[list[int]] = INDEX,
    n_extra: int = 2,
    n_own: int = 4,
    seed: int = 0,
) -> ArrowJacobian:
    """Three segments of 8 rows that see five shared columns each."""
    return ArrowJacobian(
        random(*batch, 3, 8, n_own, seed=seed, low=-1.0),
        random(*batch, 3, 8, 5, seed=seed + 1, low=-1.0),
        random(*batch, n_extra, 6, seed=seed + 2, low=-1.0),
        torch.tensor(index),
    )


JACOBIANS = {
    "dense": lambda batch: dense(batch),
    "arrow": lambda batch: arrow(batch),
    "arrow_of_neighbours": lambda batch: arrow(batch, index=NEIGHBOURS),
    "arrow_without_extra_rows": lambda batch: arrow(batch, n_extra=0),
    "arrow_without_own_columns": lambda batch: arrow(batch, n_own=0),
    "wide": lambda batch: dense(batch, columns=19),
    "wide_arrow": lambda batch: arrow(batch, n_own=11),
    "wide_arrow_without_extra_rows": lambda batch: arrow(batch, n_own=11, n_extra=0),
}


def normal_solution(matrix: Tensor, residual: Tensor, damping: Tensor, scale: Tensor) -> Tensor:
    """The step by torch.linalg.solve of (JᵀJ + μD²) p = −Jᵀr."""
    damped = matrix.mT @ matrix + torch.diag_embed(damping.unsqueeze(-1) * scale**2)
    return -torch.linalg.solve(damped, (matrix.mT @ residual.unsqueeze(-1)).squeeze(-1))


def data(jacobian: Jacobian, batch: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor]:
    rows, columns = jacobian.dense().shape[-2:]
    residual = random(*batch, rows, seed=8, low=-1.0)
    return residual, random(*batch, seed=9, low=0.01, high=2.0), random(*batch, columns, seed=10, low=0.5)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("method", LINEAR_SOLVERS)
@pytest.mark.parametrize("name", JACOBIANS)
def test_steps_solve_the_normal_equations(name, method, batch):
    jacobian = JACOBIANS[name](batch)
    residual, damping, scale = data(jacobian, batch)
    step = jacobian.solve_damped(residual, damping, scale, method)
    assert step.shape == (*batch, jacobian.dense().shape[-1])
    assert relative(step, normal_solution(jacobian.dense(), residual, damping, scale)) < 1e-11


@given(seed=st.integers(0, 10**6), exponent=st.floats(-12, 6))
def test_any_damping_by_either_route(seed, exponent):
    for jacobian in (dense(seed=seed), arrow(seed=seed)):
        residual, _, scale = data(jacobian, ())
        damping = torch.tensor(10.0**exponent, dtype=torch.float64)
        expected = normal_solution(jacobian.dense(), residual, damping, scale)
        tolerance = 1e-11 * float(torch.linalg.cond(jacobian.dense())) ** 2
        for method in LINEAR_SOLVERS:
            assert relative(jacobian.solve_damped(residual, damping, scale, method), expected) < tolerance


@pytest.mark.parametrize("method", LINEAR_SOLVERS)
@pytest.mark.parametrize("make", [dense, arrow])
def test_no_damping_gives_the_least_squares_step(make, method):
    jacobian = make()
    residual, damping, scale = data(jacobian, ())
    step = jacobian.solve_damped(residual, 0 * damping, scale, method)
    expected = torch.linalg.lstsq(jacobian.dense(), -residual[:, None], driver="gelsd").solution[:, 0]
    assert relative(step, expected) < 1e-10


@pytest.mark.parametrize("make", [dense, arrow])
def test_qr_keeps_the_digits_that_normal_equations_lose(make):
    jacobian = make()
    matrix = jacobian.dense()
    # columns that nearly agree: cond(J) = 1e7, so cond(JᵀJ) = 1e14
    if isinstance(jacobian, DenseJacobian):
        matrix[:, 1] = matrix[:, 0] + 1e-7 * matrix[:, 1]
    else:
        jacobian.local[..., 1] = jacobian.local[..., 0] + 1e-7 * jacobian.local[..., 1]
        matrix = jacobian.dense()
    truth = random(matrix.shape[-1], seed=5, low=-1.0)
    errors = {
        method: relative(
            jacobian.solve_damped(
                -matrix @ truth, torch.tensor(0.0, dtype=torch.float64), torch.ones_like(truth), method
            ),
            truth,
        )
        for method in LINEAR_SOLVERS
    }
    assert errors["qr"] < 1e-8
    assert errors["cholesky"] > 10 * errors["qr"]


@pytest.mark.parametrize("make", [dense, arrow])
def test_a_rank_deficient_member_is_nan_by_cholesky_and_others_are_not(make):
    jacobian = make((2,))
    block = jacobian.matrix if isinstance(jacobian, DenseJacobian) else jacobian.local
    block[0, ..., 1] = 0.0
    residual, damping, scale = data(jacobian, (2,))
    step = jacobian.solve_damped(residual, 0 * damping, scale, "cholesky")
    assert not torch.isfinite(step[0]).any()
    assert torch.isfinite(step[1]).all()
    # damping makes it regular again
    damped = jacobian.solve_damped(residual, damping, scale, "cholesky")
    assert relative(damped, normal_solution(jacobian.dense(), residual, damping, scale)) < 1e-11


def test_dependent_shared_unknowns_are_nan_too():
    jacobian = arrow()
    none = torch.full_like(jacobian.index, NO_UNKNOWN)
    singular = ArrowJacobian(jacobian.local, jacobian.shared, 0 * jacobian.extra, none)
    residual, damping, scale = data(singular, ())
    assert torch.isnan(singular.solve_damped(residual, 0 * damping, scale, "cholesky")).any()


@pytest.mark.parametrize("batch", [(), (2, 3)])
@pytest.mark.parametrize("name", JACOBIANS)
def test_norms_gradient_and_product_are_those_of_the_whole_matrix(name, batch):
    jacobian = JACOBIANS[name](batch)
    matrix = jacobian.dense()
    residual, _, step = data(jacobian, batch)
    assert relative(jacobian.column_norms(), matrix.norm(dim=-2)) < 1e-13
    assert relative(jacobian.gradient(residual), (matrix.mT @ residual.unsqueeze(-1)).squeeze(-1)) < 1e-13
    assert relative(jacobian.apply(step), (matrix @ step.unsqueeze(-1)).squeeze(-1)) < 1e-13


@pytest.mark.parametrize("make", [lambda: dense(columns=40), lambda: arrow(n_own=20)])
def test_with_more_unknowns_than_equations_little_damping_meets_them_all_by_the_shortest_step(make):
    jacobian = make()
    matrix = jacobian.dense()
    residual, _, scale = data(jacobian, ())
    step = jacobian.solve_damped(residual, torch.tensor(1e-26, dtype=torch.float64), scale, "qr")
    assert relative(matrix @ step, -residual) < 1e-12
    assert relative(scale * step, -torch.linalg.pinv(matrix / scale) @ residual) < 1e-11


@pytest.mark.parametrize("batch", [(), (3,)])
def test_steps_from_a_tape_are_the_same_to_the_bit(batch):
    """All Jacobians of one shape share a tape; what lies otherwise in memory is not played."""
    before = linalg._replay.cache_info().currsize
    for seed in range(RECORDING_PAYS + 3):
        jacobian = arrow(batch, n_extra=3, seed=100 * seed)
        residual, damping, scale = data(jacobian, batch)
        norms, step = jacobian.column_norms(), jacobian.solve_damped(residual, damping, scale)
        own, mixed, shared = jacobian._normal
        plain = jacobian._step(own, mixed, shared, residual, damping[..., None, None], scale)
        assert torch.equal(step, plain[0])
        assert torch.equal(jacobian.gradient(residual), plain[1])
        assert torch.equal(norms, jacobian._norms(own, shared)[0])
    arrays = (jacobian.local, jacobian.shared, jacobian.extra, jacobian.index)
    shapes = [x.shape for x in (*arrays, *jacobian._normal, residual, damping[..., None, None], scale)]
    assert linalg._replay(ArrowJacobian._step, *shapes, residual.dtype, residual.device).recorded
    assert linalg._replay.cache_info().currsize <= before + 2
    permuted = replace(jacobian, local=jacobian.local.mT.contiguous().mT)
    assert relative(permuted.solve_damped(residual, damping, scale), step) < 1e-11


def test_an_arrow_without_coupling_is_block_diagonal():
    jacobian = arrow()
    local = torch.block_diag(*jacobian.local)
    whole = jacobian.dense()
    assert torch.equal(whole[:24, :12], local)
    assert torch.equal(whole[24:, 12:], jacobian.extra)
    assert not whole[24:, :12].any()
    # the third segment sees 4, 5, 1, 5 and something known
    shared = jacobian.shared[2]
    assert torch.equal(whole[16:24, [16, 13]], shared[:, [0, 2]])
    assert torch.equal(whole[16:24, 17], shared[:, 1] + shared[:, 3])
    assert not whole[16:24, [12, 14, 15]].any()


def test_an_unknown_method_is_a_key_error():
    with pytest.raises(KeyError, match="lu"):
        dense().solve_damped(random(12), torch.tensor(1.0), torch.ones(7), "lu")
