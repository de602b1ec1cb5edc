"""``ponn``: from a line of settings to a run folder with a certified solution.

Exit codes: 0 the run did what was asked (certified; or, with ``refinement=none``, a solution, whatever its
certificate says), 1 bad input, 2 no certified solution, 3 an error inside, 130 interrupted. A sweep (``-m``)
runs all its members and ends with the largest code among them; what it optimises is the cost of a certified
solution, else infinity.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

BAD_INPUT, INTERRUPTED = 1, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and answer with its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    # imports wait for what needs them: help comes at once, and Ctrl-C while they load is no traceback
    try:
        from ponn_torch.cli.overrides import InputError, read
        from ponn_torch.cli.texts import TEXTS

        for option, text in TEXTS.items():
            if option in arguments:
                print(text())
                return 0
        try:
            command = read(arguments)
            from ponn_torch.cli.session import execute

            return execute(command)
        except InputError as error:
            print(f"ponn: {error}", file=sys.stderr)
            return BAD_INPUT
    except KeyboardInterrupt:
        print("ponn: interrupted", file=sys.stderr)
        return INTERRUPTED
