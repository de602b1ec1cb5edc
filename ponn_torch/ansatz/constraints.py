"""Constraints as linear functionals, and the switching functions that impose them.

A `Constraint` C maps functions y = (y0, y1, ...) of z to a number. It has no target: targets κ are data of
the run. `SwitchingFunctions` are polynomials Ω_j with C_i[Ω_j] = 1 for i = j and 0 otherwise (theory of
functional connections).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.numerics.nodes import NodeSet

Table = Callable[[Tensor, int], Tensor]  # (z (n,), order) -> derivatives 0..order, (..., order+1, n, m)

_INDEPENDENT = 1e-9  # what a column must have beside those before it, relative to its length


@dataclass(frozen=True)
class Term:
    """factor · Σ_i coefficients_i · y_variable^(order)(points_i): a point value or a quadrature."""

    variable: int
    order: int
    points: tuple[float, ...]
    coefficients: tuple[float, ...]
    label: str
    factor: float = 1.0

    def on(self, table: Table, *, dtype: torch.dtype, device: torch.device | str) -> Tensor:
        """The term of every tabulated function, (..., m)."""
        points = torch.tensor(self.points, dtype=dtype, device=device)
        coefficients = torch.tensor(self.coefficients, dtype=dtype, device=device)
        values = table(points, self.order)[..., self.order, :, :]
        return self.factor * torch.einsum("n,...nm->...m", coefficients, values)

    @property
    def magnitude(self) -> float:
        """What the term gives at most on T_order, the lowest polynomial it sees: T_e^(e) = 2^(e-1) e!."""
        lowest = math.factorial(self.order) * 2.0 ** max(self.order - 1, 0)
        return abs(self.factor) * lowest * sum(map(abs, self.coefficients))


@dataclass(frozen=True)
class Constraint:
    """A linear functional: a sum of terms. Sums, differences and multiples of constraints are constraints."""

    terms: tuple[Term, ...]

    def __add__(self, other: Constraint) -> Constraint:
        return Constraint(self.terms + other.terms)

    def __mul__(self, scalar: float) -> Constraint:
        return Constraint(tuple(replace(term, factor=float(scalar) * term.factor) for term in self.terms))

    __rmul__ = __mul__

    def __neg__(self) -> Constraint:
        return -1.0 * self

    def __sub__(self, other: Constraint) -> Constraint:
        return self + (-other)

    def __str__(self) -> str:
        words: list[str] = []
        for term in self.terms:
            words.append("-" if term.factor < 0 else "+")
            words.append(term.label if abs(term.factor) == 1 else f"{abs(term.factor):g} {term.label}")
        return ("-" if words[:1] == ["-"] else "") + " ".join(words[1:]) or "0"


def value(variable: int, at: float, *, name: str | None = None) -> Constraint:
    """y_variable(at). `name` is what messages call the variable, by default y0, y1, ..."""
    return derivative(variable, at, 0, name=name)


def derivative(variable: int, at: float, order: int = 1, *, name: str | None = None) -> Constraint:
    """The derivative of a variable with respect to z at a point; order 0 is the value."""
    label = f"{_derivative_name(variable, order, name)}({float(at):g})"
    return Constraint((Term(variable, order, (float(at),), (1.0,), label),))


def integral(
    variable: int, nodes: NodeSet, weight: Sequence[float] | Tensor | None = None, *, name: str | None = None
) -> Constraint:
    """∫ weight(z) y_variable(z) dz over [-1, 1] by the quadrature of the nodes; weight (n,) there, default 1.

    Raises ValueError when the weight does not have one entry per node.
    """
    quadrature, label = nodes.weights, f"∫ {_derivative_name(variable, 0, name)} dz"
    if weight is not None:
        weight = torch.as_tensor(weight, dtype=quadrature.dtype, device=quadrature.device)
        if weight.shape != quadrature.shape:
            raise ValueError(
                f"weight has shape {tuple(weight.shape)}; allowed: one per node, {tuple(quadrature.shape)}"
            )
        quadrature, label = quadrature * weight, label.replace("∫", "∫ weight")
    points, coefficients = tuple(nodes.points.tolist()), tuple(quadrature.tolist())
    return Constraint((Term(variable, 0, points, coefficients, label),))


def hermite(order: int) -> tuple[Constraint, ...]:
    """Value and derivatives below `order` at -1, then the same at +1: 2·order constraints on one variable."""
    return tuple(derivative(0, at, e, name="y") for at in (-1.0, 1.0) for e in range(order))


def _derivative_name(variable: int, order: int, name: str | None) -> str:
    if variable < 0 or order < 0:
        raise ValueError(f"variable = {variable}, order = {order}; allowed: both at least 0")
    return (f"y{variable}" if name is None else name) + ("'" * order if order < 4 else f"^({order})")


def apply(
    constraint: Constraint,
    function: Table,
    *,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> Tensor:
    """C[y], shape (...), of a function that returns its jet (..., order+1, n, n_variables)."""
    values = [term.on(function, dtype=dtype, device=device)[..., term.variable] for term in constraint.terms]
    return torch.stack(values).sum(dim=0)


def functional_matrix(
    constraints: Sequence[Constraint],
    features: Table,
    size: int,
    n_variables: int,
    *,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> Tensor:
    """Every constraint of every basis function put into every variable, (n_constraints, n_variables, size).

    Raises ValueError when a constraint uses a variable that does not exist.
    """
    matrix = torch.zeros(len(constraints), n_variables, size, dtype=dtype, device=device)
    for row, constraint in zip(matrix, constraints, strict=True):
        for term in constraint.terms:
            if term.variable >= n_variables:
                raise ValueError(
                    f"variable = {term.variable} in {constraint}; allowed: below n_variables = {n_variables}"
                )
            row[term.variable] += term.on(features, dtype=dtype, device=device)
    return matrix


class SwitchingFunctions(nn.Module):
    """Ω_j of a tuple of constraints over n variables: polynomials of the lowest degrees that tell them apart.

    Degrees are tried in ascending order, variable by variable, and one is taken if the constraints can tell
    it from those before: two end values take 1 and z, a derivative alone takes z. For one variable these are
    Tables A1-A6 of the fuel-optimal paper. The points may lie on any interval.

    Raises ValueError that names the constraints that clash, i.e. of which some combination is always zero.
    """

    coefficients: Tensor  # of Chebyshev polynomials, (n_degrees, n_variables, n_constraints)

    def __init__(
        self,
        constraints: Sequence[Constraint],
        n_variables: int = 1,
        *,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__()
        self.register_buffer(
            "coefficients", _switching_coefficients(constraints, n_variables).to(device=device, dtype=dtype)
        )

    def forward(self, z: Tensor, order: int) -> Tensor:
        """Derivatives 0..order at z (n,): (order+1, n, n_variables, n_constraints)."""
        features = Chebyshev(self.coefficients.shape[0]).features(z, order)
        return torch.einsum("onk,kvj->onvj", features, self.coefficients)


def _switching_coefficients(constraints: Sequence[Constraint], n_variables: int) -> Tensor:
    terms = [term for constraint in constraints for term in constraint.terms]
    n_points = len({point for term in terms for point in term.points})
    # Hermite interpolation of all derivatives at all points is regular: up to its degree all clashes show
    supports = Chebyshev(max(1, n_points * max((term.order + 1 for term in terms), default=1)))
    matrix = functional_matrix(constraints, supports.features, supports.size, n_variables)
    scale = matrix.new_tensor([sum(term.magnitude for term in c.terms) or 1.0 for c in constraints])
    columns = (matrix / scale[:, None, None]).movedim(2, 1).flatten(1)  # degree by degree
    chosen = _independent_columns(columns)
    if len(chosen) < len(constraints):
        culprits = ", ".join(str(constraints[i]) for i in _dependent_rows(columns))
        raise ValueError(f"constraints = [{culprits}] clash: one follows from the rest; allowed: independent ones")
    coefficients = columns.new_zeros(columns.shape[1], len(constraints))
    coefficients[chosen] = torch.linalg.inv(columns[:, chosen]) / scale
    n_degrees = 1 + max(chosen, default=0) // n_variables
    return coefficients.unflatten(0, (supports.size, n_variables))[:n_degrees]


def _independent_columns(matrix: Tensor) -> list[int]:
    """The first columns, at most one per row, each independent of those before (Gram-Schmidt, done twice)."""
    chosen: list[int] = []
    basis = matrix.new_zeros(len(matrix), 0)
    for index, column in enumerate(matrix.T):
        if len(chosen) == len(matrix):
            break
        rest = column - basis @ (basis.T @ column)
        rest = rest - basis @ (basis.T @ rest)
        if rest.norm() > _INDEPENDENT * max(1.0, float(column.norm())):
            chosen.append(index)
            basis = torch.cat([basis, (rest / rest.norm())[:, None]], dim=1)
    return chosen


def _dependent_rows(matrix: Tensor) -> list[int]:
    """Rows that take part in a vanishing combination: those with an entry in the left null space."""
    left, singular, _ = torch.linalg.svd(matrix / matrix.norm(dim=0).clamp_min(1.0))
    rank = int((singular > _INDEPENDENT * singular[0]).sum())
    null_space = left[:, min(rank, len(matrix) - 1) :]
    return [row for row, entries in enumerate(null_space) if entries.norm() > 1e-6]
