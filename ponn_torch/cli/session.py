"""One command: a run or a sweep under Hydra, what it prints, and the exit code."""

from __future__ import annotations

import json
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from types import FrameType
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from ponn_torch.cli.job import BUG, INTERRUPTED, OVERRIDES, Outcome
from ponn_torch.cli.overrides import Application, Command, InputError, composed, config_folder
from ponn_torch.reporting.members import OUTCOME, natural
from ponn_torch.settings import ConfigError
from ponn_torch.solving.solution import in_a_row


@dataclass(frozen=True)
class Tool:
    """What a command does: ``build`` makes a plan of a config, ``run`` carries it out in a folder.

    ``run`` is told the overrides, and the config chosen in each group.

    member: the same for one member of a sweep, a function of a module, so that launchers can send it to processes.
    """

    application: Application
    build: Callable[[DictConfig], Any]
    run: Callable[[DictConfig, Path, Sequence[str], Any, Mapping[str, Any]], Outcome]
    member: Callable[[DictConfig], float]
    resume: Callable[[DictConfig, Path, Sequence[str]], Outcome] | None = None


def execute(command: Command, tool: Tool) -> int:
    """Run what was asked and answer with the exit code.

    Raises:
        InputError: no run can be made of the settings; members of a sweep keep that to themselves.
    """
    if command.multirun:
        return _sweep(command, tool)
    if command.resume is not None and command.config is not None:
        with _termination_interrupts():
            return _go_on(command.config, command.resume, command.overrides, tool)
    plan: Any = None
    if command.config is not None:
        try:
            plan = tool.build(command.config)
        except ConfigError as error:
            raise InputError(error) from error
        except Exception:  # a slip in a user's problem: the run itself meets it again and keeps its place
            plan = None
    outcomes: list[Outcome] = []

    def task(config: DictConfig) -> float:
        outcome = _member(tool, config, plan)
        outcomes.append(outcome)
        return outcome.score

    overrides = command.overrides
    if command.config is not None:
        _, overrides = _in_folder("hydra.run.dir", overrides, overrides, tool.application)
    with _termination_interrupts():
        _under_hydra(tool.application, task, command.options, overrides)
    return outcomes[0].exit_code if outcomes else 0


def _go_on(config: DictConfig, folder: Path, overrides: list[str], tool: Tool) -> int:
    """Take a run up again in its own folder."""
    path = folder / OVERRIDES
    before = list(OmegaConf.load(path)) if path.is_file() else []
    changed = [text.partition("=")[0] for text in overrides]
    kept = [str(text) for text in before if str(text).partition("=")[0] not in changed]
    try:
        tool.build(config)
    except ConfigError as error:
        raise InputError(error) from error
    except Exception:  # as in a first run
        pass
    assert tool.resume is not None
    return tool.resume(config, folder, [*kept, *overrides]).exit_code


def _member(tool: Tool, config: DictConfig, plan: Any = None) -> Outcome:
    about = HydraConfig.get()
    folder, overrides = Path(about.runtime.output_dir), list(about.overrides.task)
    return tool.run(config, folder, overrides, plan, about.runtime.choices)


def _under_hydra(application: Application, task: Any, options: list[str], overrides: list[str]) -> None:
    """Call Hydra as from a command line."""
    before = sys.argv
    sys.argv = [application.program, *options, *overrides]
    folder, name = str(config_folder(application)), application.config
    try:
        hydra.main(config_path=folder, config_name=name, version_base="1.3")(task)()
    finally:
        sys.argv = before


def _in_folder(
    key: str, overrides: Sequence[str], known: Sequence[str], application: Application
) -> tuple[Path, list[str]]:
    """The folder that Hydra would make, made here, and the overrides with it fixed; ``known`` ones decide on it.

    Raises:
        InputError: it cannot be made or written to.
    """
    about = composed(known, with_hydra=True, application=application)
    folder = Path(str(OmegaConf.select(about, key)))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        allowed = "a folder that can be made and written to"
        raise InputError(f"{key} = {str(folder)!r}: {error.strerror}; allowed: {allowed}") from error
    name = str(folder).replace("\\", "\\\\").replace("'", "\\'")
    return folder, [*(text for text in overrides if not text.startswith(f"{key}=")), f"{key}='{name}'"]


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


def sweep_member(tool: Tool, config: DictConfig) -> float:
    """Run one member of a sweep; the cost of a certified solution, else infinity.

    Raises:
        KeyboardInterrupt: the member was interrupted, which ends the sweep; what it had is in its folder.
    """
    job = HydraConfig.get().job
    print(f"\n[{job.num}] {job.override_dirname}", flush=True)
    outcome = _member(tool, config)
    folder = Path(HydraConfig.get().runtime.output_dir)
    verdict = "certified" if outcome.certified else "not certified" if outcome.exit_code in (0, 2) else "failed"
    print(f"[{job.num}] {verdict}; {len(list(folder.parent.rglob(OUTCOME)))} members done", flush=True)
    if outcome.exit_code == INTERRUPTED:
        raise KeyboardInterrupt
    return outcome.score


def _sweep(command: Command, tool: Tool) -> int:
    # the folder is fixed here, so that it is known whatever becomes of the members
    plain = [text for text in command.overrides if _plain(text)]
    folder, overrides = _in_folder("hydra.sweep.dir", command.overrides, plain, tool.application)
    if not any(text.startswith("hydra.sweep.subdir=") for text in overrides):
        overrides += _named_by_what_varies(command.overrides)
    began, interrupted = time.time(), False
    try:
        with _termination_interrupts():
            _under_hydra(tool.application, tool.member, command.options, overrides)
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
    width = max(len(name) for name in ("member", *(place.name for place, _ in members))) + 2
    lines.append(f"{'member':{width}}{'cost':>16}  {'CPU s':>7}  settings: result")
    for place, outcome in members:
        cost = float(outcome["cost"]) if outcome["cost"] is not None else math.nan
        shown = f"{cost:>16.10g}" if math.isfinite(cost) else f"{'–':>16}"
        settings = " ".join(text for text in outcome["overrides"] if text not in shared) or "defaults"
        told = " ".join(["certified", in_a_row(outcome["arcs"])]).strip()
        told = told if outcome["certified"] else outcome["message"]
        lines.append(f"{place.name:{width}}{shown}  {outcome['cpu_seconds']:7.2f}  {settings}: {told}")
    failed = sum(outcome["exit_code"] != 0 for _, outcome in members)
    certified = sum(bool(outcome["certified"]) for _, outcome in members)
    lines += ["", f"{certified} of {len(members)} certified, {failed} failed; folder {folder}"]
    return "\n".join(lines)
