"""Horizons with known answers for the tests of the guidance room."""

from __future__ import annotations

import torch
from helpers import random as uniform
from torch import Tensor

from ponn_torch.ansatz.basis import Chebyshev, GaussianRBF, Legendre, RandomFeatures
from ponn_torch.guidance.horizon import HorizonSolver, LinearTPBVP, pseudospectral
from ponn_torch.numerics.nodes import make_nodes

N = 12
LOBATTO = make_nodes("legendre_lobatto", N)
SOLVERS = {
    "chebyshev": HorizonSolver(Chebyshev(N, 1), LOBATTO),
    "chebyshev_block": HorizonSolver(Chebyshev(N, 1), LOBATTO, route="block"),
    "chebyshev_qr": HorizonSolver(Chebyshev(N - 2, 1), LOBATTO, route="qr"),
    "legendre": HorizonSolver(Legendre(N, 1), make_nodes("legendre_gauss", N)),
    "rbf": HorizonSolver(GaussianRBF(N, 0.8), LOBATTO),
    "elm": HorizonSolver(RandomFeatures(N, "tanh", weight_range=(-1.5, 1.5)), LOBATTO),
    "radau": pseudospectral("legendre_radau", N),
    "gauss": pseudospectral("legendre_gauss", N),
}


def random(*shape: int, seed: int) -> Tensor:
    return uniform(*shape, seed=seed, low=-1.0)


def regulator(n: int = 3, *, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """The Hamiltonian matrix (2n, 2n) of a random LTI regulator, its terminal weight (n, n) and a drift (2n,)."""
    a, b, q, s = (random(n, n, seed=4 * seed + i) / n**0.5 for i in range(4))
    eye = torch.eye(n, dtype=torch.float64)
    matrix = torch.cat([torch.cat([a, -b @ b.T], 1), torch.cat([-(q @ q.T + eye), -a.T], 1)])
    return matrix, s @ s.T + eye, random(2 * n, seed=4 * seed + 5)


def problem_of(solver: HorizonSolver, duration: float = 1.0, *, seed: int = 0, n: int = 3) -> LinearTPBVP:
    """The regulator's horizon at a solver's nodes, from a random state."""
    matrix, terminal, drift = regulator(n, seed=seed)
    nodes = len(solver.nodes)
    return LinearTPBVP(
        matrix.expand(nodes, -1, -1),
        drift.expand(nodes, -1),
        duration,
        random(n, seed=seed + 50),
        terminal,
        random(n, seed=seed + 60),
    )
