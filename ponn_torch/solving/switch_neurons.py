"""Switch neurons as a refinement: frozen units at the zeros of S, on nodes that resolve their layers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from ponn_torch.ansatz.basis import Chebyshev, LinearBasis
from ponn_torch.ansatz.switch_neurons import SwitchNeuronBasis
from ponn_torch.numerics.nodes import graded_edges, make_panels
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.solving.single_domain import Layers, SingleDomain


@dataclass(frozen=True)
class SwitchNeurons(SingleDomain):
    """Units whose highest derivative in a chain is tanh(κ(z − c)), κ = |dS/dz|/ρ, at every zero c of S.

    Attributes:
        n_neurons: of the smooth functions; a switch adds len(factors) × n_lifts units.
        factors: of κ, because S is not straight across a layer. n_lifts: what jumps (see SwitchNeuronBasis).
        n_nodes: per panel; panels are halved towards the layers, and towards the ends as the polynomials need it.
        basis: the smooth functions (Chebyshev by default).
    """

    factor: float = 0.1
    n_neurons: int = 60
    factors: Sequence[float] = (1.0, 0.6, 0.8, 1.25, 1.7)
    n_lifts: int = 3
    n_nodes: int = 8
    basis: Callable[[int], LinearBasis] = Chebyshev

    def discretisation(self, curve: Curve, layers: Layers) -> Discretisation:
        # half a wave of the highest polynomial is π/L long inside and π²/(2L²) at the ends: two nodes or more for each
        ends = layers.centres.new_tensor([-1.0, 1.0])
        centres = torch.cat([layers.centres, ends])
        widths = torch.cat([layers.widths, torch.full_like(ends, 2.0 * self.n_nodes / self.n_neurons**2)])
        edges = graded_edges(centres, widths, 1.5 * self.n_nodes / self.n_neurons)
        nodes = make_panels("legendre_gauss", edges, self.n_nodes)
        smooth = self.basis(self.n_neurons)
        basis = SwitchNeuronBasis.at(smooth, layers.centres, 1 / layers.widths, self.factors, self.n_lifts)
        disc = curve.collocation.discretisation
        return Discretisation(curve.collocation.bvp, basis, nodes, disc.form, "ordered")
