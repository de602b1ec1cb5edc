"""``ponn`` and ``ponn-rhc``: from a line of settings to a run folder with a certified solution, or a flight.

Exit codes: 0 the run did what was asked (certified; or, where the refinement claims no certificate, a solution,
whatever its certificate says), 1 bad input, 2 no certified solution, 3 an error inside, 130 interrupted. A sweep
(``-m``) runs all its members and ends with the largest code among them; what it optimises is the cost of a
certified solution, else infinity.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

BAD_INPUT, INTERRUPTED = 1, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``ponn`` and answer with its exit code."""
    return _main("ponn", "ponn_torch.cli.run", argv)


def guide(argv: Sequence[str] | None = None) -> int:
    """Run ``ponn-rhc`` and answer with its exit code."""
    return _main("ponn-rhc", "ponn_torch.cli.flight", argv)


def _main(program: str, module: str, argv: Sequence[str] | None) -> int:
    """``module`` holds the command's TOOL."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    # imports wait for what needs them: help comes at once, and Ctrl-C while they load is no traceback
    try:
        from ponn_torch.cli.overrides import APPLICATIONS, InputError, read
        from ponn_torch.cli.texts import texts

        application = APPLICATIONS[program]
        for option, text in texts(application).items():
            if option in arguments:
                print(text())
                return 0
        try:
            command = read(arguments, application)
            from ponn_torch.cli.session import execute

            return execute(command, import_module(module).TOOL)
        except InputError as error:
            print(f"{program}: {error}", file=sys.stderr)
            return BAD_INPUT
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return INTERRUPTED
