"""One command: a run or a sweep under Hydra, what it prints, and the exit code."""

from __future__ import annotations

import json
import math
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from ponn_torch.build import Plan, build
from ponn_torch.cli.overrides import CONFIG, Command, InputError, composed, config_folder
from ponn_torch.cli.run import Outcome, run
from ponn_torch.reporting.members import OUTCOME, natural
from ponn_torch.settings import ConfigError

BUG, BAD_INPUT, INTERRUPTED = 3, 1, 130


def execute(command: Command) -> int:
    """Run what was asked and answer with the exit code.

    Raises:
        InputError: no run can be made of the settings; members of a sweep keep that to themselves.
    """
    if command.multirun:
        return _sweep(command)
    plan: Plan | None = None
    if command.config is not None:
        try:
            plan = build(command.config)
        except ConfigError as error:
            raise InputError(error) from error
        except Exception:  # a slip in a user's problem: the run itself meets it again and keeps the traceback
            plan = None
    outcomes: list[Outcome] = []

    def task(config: DictConfig) -> float:
        outcome = _member(config, plan)
        outcomes.append(outcome)
        return outcome.score

    with _termination_interrupts():
        _under_hydra(task, command.options, command.overrides)
    return outcomes[0].exit_code if outcomes else 0


def _member(config: DictConfig, plan: Plan | None = None) -> Outcome:
    about = HydraConfig.get()
    return run(config, Path(about.runtime.output_dir), list(about.overrides.task), plan, about.runtime.choices)


def _under_hydra(task: Any, options: list[str], overrides: list[str]) -> None:
    """Call Hydra as from a command line."""
    before = sys.argv
    sys.argv = ["ponn", *options, *overrides]
    try:
        hydra.main(config_path=str(config_folder()), config_name=CONFIG, version_base="1.3")(task)()
    finally:
        sys.argv = before


@contextmanager
def _termination_interrupts() -> Iterator[None]:
    """SIGTERM, which batch systems send, ends a run as Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


# -- sweeps ----------------------------------------------------------------------------------------


def sweep_member(config: DictConfig) -> float:
    """Run one member of a sweep; the cost of a certified solution, else infinity.

    Raises:
        KeyboardInterrupt: the member was interrupted, which ends the sweep; what it had is in its folder.
    """
    job = HydraConfig.get().job
    print(f"\n[{job.num}] {job.override_dirname}", flush=True)
    outcome = _member(config)
    folder = Path(HydraConfig.get().runtime.output_dir)
    verdict = "certified" if outcome.certified else "not certified" if outcome.exit_code in (0, 2) else "failed"
    print(f"[{job.num}] {verdict}; {len(list(folder.parent.rglob(OUTCOME)))} members done", flush=True)
    if outcome.exit_code == INTERRUPTED:
        raise KeyboardInterrupt
    return outcome.score


def _sweep(command: Command) -> int:
    # the folder is fixed here, so that it is known whatever becomes of the members
    about = composed([text for text in command.overrides if _plain(text)], with_hydra=True)
    folder = Path(str(OmegaConf.select(about, "hydra.sweep.dir")))
    overrides = [text for text in command.overrides if not text.startswith("hydra.sweep.dir=")]
    if not any(text.startswith("hydra.sweep.subdir=") for text in overrides):
        overrides += _named_by_what_varies(command.overrides)
    name = str(folder).replace("\\", "\\\\").replace("'", "\\'")
    began, interrupted = time.time(), False
    try:
        with _termination_interrupts():
            _under_hydra(sweep_member, command.options, [*overrides, f"hydra.sweep.dir='{name}'"])
    except KeyboardInterrupt:
        interrupted = True
    found = [path for path in folder.rglob(OUTCOME) if path.stat().st_mtime >= began - 1]
    members = [(path.parent, json.loads(path.read_text(encoding="utf-8"))) for path in found]
    members.sort(key=lambda member: natural(str(member[0])))
    print(_summary(folder, members))
    codes = [int(outcome["exit_code"]) for _, outcome in members]
    return INTERRUPTED if interrupted else max(codes, default=BUG)


def _named_by_what_varies(overrides: Sequence[str]) -> list[str]:
    """Overrides that call a member's folder by its number and the values it has of what is swept."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    fixed = [override.key_or_group for override in parsed if not override.is_sweep_override()]
    if len(fixed) == len(parsed):
        return []
    quoted = ", ".join(f"'{key}'" for key in fixed)
    return [
        f"hydra.job.config.override_dirname.exclude_keys=[{quoted}]",
        "hydra.sweep.subdir='${hydra.job.num}_${hydra.job.override_dirname}'",
    ]


def _plain(text: str) -> bool:
    """Whether an override is Hydra's own and has one value."""
    return text.startswith("hydra.sweep.") and "," not in text


def _summary(folder: Path, members: list[tuple[Path, dict[str, Any]]]) -> str:
    """A line per member, with the settings in which it differs, and how many of them were certified."""
    first = members[0][1]["overrides"] if len(members) > 1 else []
    shared = [text for text in first if all(text in outcome["overrides"] for _, outcome in members)]
    lines = ["", *([f"all: {' '.join(shared)}"] if shared else [])]
    lines.append(f"{'member':8}{'cost':>16}  {'CPU s':>7}  settings: result")
    for place, outcome in members:
        cost = float(outcome["cost"]) if outcome["cost"] is not None else math.nan
        shown = f"{cost:>16.10g}" if math.isfinite(cost) else f"{'–':>16}"
        settings = " ".join(text for text in outcome["overrides"] if text not in shared) or "defaults"
        told = " ".join(["certified", "-".join(outcome["arcs"])]).strip()
        told = told if outcome["certified"] else outcome["message"]
        lines.append(f"{place.name:8}{shown}  {outcome['cpu_seconds']:7.2f}  {settings}: {told}")
    failed = sum(outcome["exit_code"] != 0 for _, outcome in members)
    certified = sum(bool(outcome["certified"]) for _, outcome in members)
    lines += ["", f"{certified} of {len(members)} certified, {failed} failed; folder {folder}"]
    return "\n".join(lines)
