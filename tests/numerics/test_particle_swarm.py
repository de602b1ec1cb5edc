"""The particle swarm: known minima, guarded costs, limits, seeds."""

import math

import pytest
import torch
from torch import Tensor

from ponn_torch.numerics.particle_swarm import ParticleSwarm


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_finds_the_minimum_of_a_bowl() -> None:
    target = torch.tensor([0.5, 2.0, 4.5], dtype=torch.float64)
    found = ParticleSwarm(n_iterations=400).minimise(lambda x: ((x - target) ** 2).sum(-1), 3, generator())
    assert (found.best - target).abs().max() < 1e-6
    assert found.cost == pytest.approx(float(((found.best - target) ** 2).sum()), rel=1e-12)


def test_finds_the_edge_where_the_minimum_lies_outside() -> None:
    found = ParticleSwarm(n_iterations=300).minimise(lambda x: x[:, 0] - x[:, 1], 2, generator())
    assert found.best.tolist() == [0.0, 5.0]


def test_costs_that_are_no_numbers_are_never_the_best() -> None:
    def cost(x: Tensor) -> Tensor:
        return torch.where(x[:, 0] < 2.0, torch.nan, (x[:, 0] - 1.0).abs())

    found = ParticleSwarm(n_particles=30, n_iterations=200).minimise(cost, 1, generator())
    assert found.best[0] >= 2.0
    assert found.cost == pytest.approx(1.0, abs=1e-3)
    hopeless = ParticleSwarm(3, 5).minimise(lambda x: x[:, 0] * torch.nan, 1, generator())
    assert hopeless.cost == math.inf
    assert hopeless.best.isfinite().all()


def test_particles_keep_to_the_box_and_the_speed_limit() -> None:
    seen: list[Tensor] = []

    def cost(x: Tensor) -> Tensor:
        seen.append(x)
        return x.sum(-1)

    swarm = ParticleSwarm(n_particles=20, n_iterations=40)
    found = swarm.minimise(cost, 4, generator())
    path = torch.stack(seen)
    assert path.shape == (41, 20, 4)
    assert path.min() >= 0.0
    assert path.max() <= 5.0
    assert 0.09 < (path[1:] - path[:-1]).abs().max() <= 0.1 + 1e-12
    assert found.history == sorted(found.history, reverse=True)
    assert len(found.history) == 41


def test_constriction_is_that_of_the_formula() -> None:
    assert ParticleSwarm().constriction == pytest.approx(2 / (2.2 + math.sqrt(4.2 * 0.2)), rel=1e-14)


def test_the_seed_decides() -> None:
    runs = [ParticleSwarm(10, 10).minimise(lambda x: x.sin().sum(-1), 2, generator(seed)) for seed in (1, 1, 2)]
    assert torch.equal(runs[0].best, runs[1].best)
    assert not torch.equal(runs[0].best, runs[2].best)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"n_particles": 0}, "n_particles = 0"),
        ({"lower": 5.0}, r"lower = 5.0; allowed: below upper = 5.0"),
        ({"own_pull": 1.0}, r"own_pull = 1.0; allowed: above 4 − swarm_pull = 1.9"),
    ],
)
def test_wrong_settings_are_named(wrong: dict[str, float], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        ParticleSwarm(**wrong)
