"""What ``--help``, ``--config-groups`` and ``--version`` say."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path

from ponn_torch import __version__
from ponn_torch.cli.overrides import PONN, RHC, Application, config_folder, groups

SOLVE = """\
ponn: solve an optimal control problem by a Pontryagin neural network, fly the solution and certify it.

  ponn [GROUP=CONFIG ...] [KEY=VALUE ...] [-m]

Examples
  ponn                                              Earth-Mars transfer from a random start
  ponn problem=mars_landing seed=3                  another problem, another start
  ponn problem=mars_landing ansatz=elm_tanh optimizer=lm continuation=tanh_ladder
  ponn problem=mars_landing problem.final_time=50   other data
  ponn problem=my_problem.py:my_problem             your own problem (a function that returns one)
  ponn experiment=ponn_landing_paper                the setting of a paper
  ponn -m seed=0,1,2,3 record=sweep                 a sweep
  ponn hydra.run.dir=runs/here                      into a folder of your choice
  ponn resume=runs/here                             go on with a run that was cut short

Config groups (GROUP=CONFIG; the first line of each config: ponn --config-groups)
{groups}

Settings of the chosen configs (KEY=VALUE): ponn --cfg job [GROUP=CONFIG ...]
Other options: -m sweep over lists of values, --config-groups, --version, --hydra-help

A run leaves in its folder: config.yaml, overrides.yaml, records.jsonl, TensorBoard events, solution/,
certificate.json, figures/, report.md, environment.json, outcome.json; failure.txt if something went wrong.

Exit code: 0 certified (solved, where the refinement claims no certificate), 1 bad input, 2 not certified,
3 an error inside, 130 interrupted.\
"""

GUIDE = """\
ponn-rhc: fly a plant in closed loop, each control from an optimal control problem solved from where it is.

  ponn-rhc [GROUP=CONFIG ...] [KEY=VALUE ...] [-m]

Examples
  ponn-rhc                                            rendezvous on a circular orbit
  ponn-rhc problem=quadrotor passes=newton            a manoeuvre, Newton's method on every horizon
  ponn-rhc problem=shuttle n_vehicles=500             entry, and a Monte Carlo of 500 vehicles
  ponn-rhc problem=quadrotor method=rbf_swarm         Gaussians tuned by a particle swarm
  ponn-rhc problem=quadrotor problem.flown.thrust=0.95   a true vehicle that is not the model's
  ponn-rhc problem=powered_descent n_vehicles=200     fuel-optimal descents planned anew every second
  ponn-rhc problem.horizon=70 ending=shrink           other data
  ponn-rhc -m method=chebyshev,igpm,rbf               a sweep

Config groups (GROUP=CONFIG; the first line of each config: ponn-rhc --config-groups)
{groups}

Settings of the chosen configs (KEY=VALUE): ponn-rhc --cfg job [GROUP=CONFIG ...]
Other options: -m sweep over lists of values, --config-groups, --version, --hydra-help

A run leaves in its folder: config.yaml, overrides.yaml, records.jsonl, TensorBoard events, flight/,
certificate.json, figures/, report.md, environment.json, outcome.json; failure.txt if something went wrong.

Exit code: 0 certified, 1 bad input, 2 not certified, 3 an error inside, 130 interrupted.\
"""

USAGES = {PONN: SOLVE, RHC: GUIDE}


def first_comment(path: Path) -> str:
    """The line that opens a config."""
    lines = path.read_text(encoding="utf-8").splitlines()
    line = next((line for line in lines if not line.startswith("# @package")), "")
    return line.removeprefix("#").strip() if line.startswith("#") else ""


def _shown_groups(application: Application) -> dict[str, list[str]]:
    return {name: options for name, options in groups(application).items() if name != "hydra" and options}


def usage(application: Application) -> str:
    lines = []
    for name, options in _shown_groups(application).items():
        text = ", ".join(options)
        lines.append(textwrap.fill(text, 110, initial_indent=f"  {name:14}", subsequent_indent=" " * 16))
    return USAGES[application].format(groups="\n".join(lines))


def config_groups(application: Application) -> str:
    lines, folder = [], config_folder(application)
    for name, options in _shown_groups(application).items():
        lines.append(name)
        lines += [f"  {option:24}{first_comment(folder / name / f'{option}.yaml')}" for option in options]
    return "\n".join(lines)


def texts(application: Application) -> dict[str, Callable[[], str]]:
    """What an option prints."""
    return {
        "--help": lambda: usage(application),
        "-h": lambda: usage(application),
        "--config-groups": lambda: config_groups(application),
        "--version": lambda: f"ponn-torch {__version__}",
    }
