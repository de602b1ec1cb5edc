"""Reading the command line: options, overrides, a user's problem; what is wrong with them is one line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override, OverrideType
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

SWITCHES = ("--multirun", "-m", "--resolve", "--info", "--hydra-help", "--shell-completion")
WITH_VALUE = ("--cfg", "-c", "--package", "-p", "--info", "-i", "--config-dir", "-cd")
OPEN = ("problem.arguments.", "weights.equations.")  # settings whose names the problem gives
RESUMABLE = ("budget.", "record.")  # settings that may change where a run goes on
VALUES = ("job", "hydra", "all", "config", "defaults", "defaults-tree", "plugins", "searchpath")


@dataclass(frozen=True)
class Application:
    """A command: its name, its main config, the folder of its groups below the configs.

    own_problem: whether ``problem=file.py:function`` is understood. resumable: whether ``resume=FOLDER`` is.
    """

    program: str
    config: str
    folder: str = "."
    own_problem: bool = False
    resumable: bool = False


PONN = Application("ponn", "solve", own_problem=True, resumable=True)
RHC = Application("ponn-rhc", "fly", "rhc")
APPLICATIONS = {application.program: application for application in (PONN, RHC)}


class InputError(ValueError):
    """Something wrong with what was typed, in one line."""


@dataclass(frozen=True)
class Command:
    """Hydra's options, overrides, the config of a single run (None for sweeps and inspections), a folder to resume."""

    options: list[str]
    overrides: list[str]
    config: DictConfig | None
    resume: Path | None = None

    @property
    def multirun(self) -> bool:
        return "-m" in self.options or "--multirun" in self.options


def config_folder(application: Application = PONN) -> Path:
    """Beside the package in an installation, at the top of the repository in a checkout."""
    package, name = Path(__file__).resolve().parents[1], f"{application.config}.yaml"
    for configs in (package / "configs", package.parent / "configs"):
        folder = (configs / application.folder).resolve()
        if (folder / name).is_file():
            return folder
    raise InputError(f"configs are missing: no {name} beside the package; install it again")


def groups(application: Application = PONN) -> dict[str, list[str]]:
    """Options per config group, in the order of the main config's defaults; then those that its options bring."""
    folder = config_folder(application)
    named = _defaults(folder / f"{application.config}.yaml")
    further = [key for name in named for path in sorted((folder / name).glob("*.yaml")) for key in _defaults(path)]
    named += [key[1:] for key in dict.fromkeys(further) if key.startswith("/") and key[1:] not in named]
    return {name: sorted(path.stem for path in (folder / name).glob("*.yaml")) for name in named}


def _defaults(path: Path) -> list[str]:
    """Keys of a config's defaults list."""
    given = OmegaConf.load(path)
    entries = given.get("defaults", []) if isinstance(given, DictConfig) else []
    return [str(key) for entry in entries if isinstance(entry, DictConfig) for key in entry]


def nearest(name: str, allowed: Sequence[str]) -> str:
    close = get_close_matches(name, list(allowed), n=1)
    return f"allowed: {', '.join(allowed)}" + (f" (did you mean {close[0]!r}?)" if close else "")


def one_line(text: Any) -> str:
    return " ".join(str(text).split())


# -- reading ---------------------------------------------------------------------------------------


def read(arguments: Sequence[str], application: Application = PONN) -> Command:
    """Take the command line apart and compose the config of a single run.

    Raises:
        InputError: an unknown option, a setting that does not exist, a value that no config is named after.
    """
    options, overrides = _split(arguments)
    folders = [text.partition("=")[2].strip("'\"") for text in overrides if text.startswith("resume=")]
    if folders and application.resumable:
        return _resumed(Path(folders[0]), options, [text for text in overrides if not text.startswith("resume=")])
    if application.own_problem:
        overrides = [part for text in overrides for part in _own_problem(text)]
    command = Command(options, overrides, None)
    if not options:
        return Command(options, overrides, composed(overrides, application=application))
    if command.multirun:
        _check(overrides, application)
    return command


def _resumed(folder: Path, options: Sequence[str], overrides: Sequence[str]) -> Command:
    """The command that goes on with a run: its own config, with another budget or other records if that is asked."""
    if options:
        raise InputError(f"resume = {str(folder)!r} with {' '.join(options)}; allowed: alone, or with KEY=VALUE")
    saved = folder / "config.yaml"
    if not saved.is_file() or not any((folder / "checkpoints").glob("*.npz")):
        raise InputError(
            f"resume = {str(folder)!r}: nothing to resume; allowed: the folder of a run that was cut short"
        )
    config = OmegaConf.load(saved)
    assert isinstance(config, DictConfig)
    for text in overrides:
        key, _, value = text.partition("=")
        if not key.startswith(RESUMABLE):
            allowed = ", ".join(f"{place}*" for place in RESUMABLE)
            raise InputError(f"{key}: a run that goes on keeps its settings; allowed: {allowed}")
        _check_key(config, key, [])
        OmegaConf.update(config, key, OmegaConf.from_dotlist([f"value={value}"]).value)
    return Command([], list(overrides), config, folder)


def composed(overrides: Sequence[str], with_hydra: bool = False, application: Application = PONN) -> DictConfig:
    """The config that overrides make of the main one; values may still be unresolved."""
    try:
        return _compose(overrides, application, with_hydra)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        _check(overrides, application)
        raise InputError(one_line(error)) from error


def _compose(overrides: Sequence[str], application: Application, with_hydra: bool = False) -> DictConfig:
    folder = str(config_folder(application))
    with initialize_config_dir(folder, job_name=application.program, version_base="1.3"):
        return compose(application.config, list(overrides), return_hydra_config=with_hydra)


def _split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    options: list[str] = []
    overrides: list[str] = []
    for text in arguments:
        name = text.partition("=")[0]
        if text.startswith("-") and not text[1:2].isdigit():
            if name not in (*SWITCHES, *WITH_VALUE):
                allowed = [*SWITCHES, *WITH_VALUE, "--help", "--config-groups", "--version"]
                raise InputError(f"{name}: no such option; {nearest(name, allowed)}")
            options.append(text)
        elif options and options[-1] in WITH_VALUE and (text in VALUES or "=" not in text):
            options.append(text)
        else:
            overrides.append(text)
    return options, overrides


def _own_problem(text: str) -> list[str]:
    """``problem=file.py:function`` as overrides of ``problem=custom``, open settings as additions; else as it is."""
    key, separator, value = text.partition("=")
    if key.startswith(OPEN):
        return [f"++{text}"]
    reference = value.strip("'\"")
    if key != "problem" or not separator or ":" not in reference:
        return [text]
    function = reference.rpartition(":")[2]
    if not function.isidentifier():
        raise InputError(
            f"problem = {reference!r}; allowed: module:function, file.py:function or a config of the group"
        )
    return ["problem=custom", f"problem.reference={_quoted(reference)}", f"problem.name={function}"]


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


# -- what is wrong ---------------------------------------------------------------------------------


def _check(overrides: Sequence[str], application: Application) -> None:
    """Raise an InputError for the first override that names no setting or no config."""
    parsed = [_parsed(text) for text in overrides]
    options, chosen = groups(application), []
    for override in parsed:
        name = override.key_or_group
        if name not in options:
            continue
        values = _values(override)
        for value in values:
            if value not in options[name]:
                extra = ", module:function, file.py:function" if name == "problem" and application.own_problem else ""
                hint = nearest(str(value), options[name])
                raise InputError(f"{name} = {value!r}; " + hint.replace(" (did", f"{extra} (did", 1))
        if values:
            chosen.append(f"{name}={values[0]}")
    try:
        base = _compose(chosen, application, with_hydra=True)
    except HydraException as error:
        absent = re.match(r"Could not override '(\w+)'", str(error))
        if absent is None:
            raise InputError(one_line(error)) from error
        base = _compose([text for text in chosen if not text.startswith(f"{absent[1]}=")], application)
        allowed = [name for name in options if name in base]
        raise InputError(f"{absent[1]}: no group of what is chosen here; {nearest(absent[1], allowed)}") from error
    for override in parsed:
        name = override.key_or_group
        plugin = name.startswith(("hydra/", "hydra.launcher."))  # Hydra knows what is installed
        if name not in options and not plugin and override.type is OverrideType.CHANGE:
            _check_key(base, name, [*options, *(["resume"] if application.resumable else [])])


def _parsed(text: str) -> Override:
    try:
        return OverridesParser.create().parse_override(text)
    except HydraException:
        hint = "allowed: key=value, with 'quotes' around special characters"
        raise InputError(f"{text!r} cannot be read as a setting; {hint}") from None


def _values(override: Override) -> list[Any]:
    """Values of an override, those of a sweep one by one; none for a pattern."""
    if override.is_sweep_override():
        return [] if isinstance(override.value(), Glob) else list(override.sweep_iterator())
    value = override.value()
    return list(value) if isinstance(value, list) else [value]


def _check_key(base: DictConfig, key: str, named: Sequence[str]) -> None:
    """Walk a dotted key down the config as far as it exists."""
    node: Any = base
    place: list[str] = []
    for part in re.split(r"[.\[]", key):
        place.append(part)
        if not isinstance(node, DictConfig):
            return
        if part not in node.keys():  # noqa: SIM118 - 'in' does not see a value that is still missing
            allowed = [str(entry) for entry in node if str(entry) not in ("hydra", "_target_")]
            if len(place) == 1:
                allowed += [name for name in named if name not in allowed and name != "hydra"]
            raise InputError(f"{'.'.join(place)}: no such setting; {nearest(part, allowed)}")
        if OmegaConf.is_missing(node, part):
            return
        node = node[part] if not OmegaConf.is_interpolation(node, part) else None
