"""``ponn-compare FOLDER``: tables and figures that put the runs under a folder side by side."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path


def main(argv: Sequence[str] | None = None) -> int:
    """Compare, print the table, and answer with the exit code: 0, or 1 where there is nothing to compare."""
    parser = argparse.ArgumentParser(prog="ponn-compare", description=__doc__.split(": ", 1)[1])
    parser.add_argument("folder", type=Path, help="a sweep, or any folder with runs below it")
    parser.add_argument("--reference", type=Path, help="folder of a solution to take errors against (RUN/solution)")
    parser.add_argument("--out", type=Path, help="where to write (default: FOLDER/comparison)")
    parser.add_argument("--no-figures", action="store_true", help="tables only")
    arguments = parser.parse_args(argv)
    from ponn_torch.reporting.compare import compare, write_comparison
    from ponn_torch.reporting.overlays import histories_figure, solutions_figure
    from ponn_torch.reporting.style import save
    from ponn_torch.solving.solution import Solution

    try:
        reference = Solution.load(arguments.reference) if arguments.reference is not None else None
        comparisons = compare(arguments.folder, reference)
    except (OSError, ValueError) as error:
        print(f"ponn-compare: {error}", file=sys.stderr)
        return 1
    out = arguments.out or arguments.folder / "comparison"
    out.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Path] = {}
    for comparison in () if arguments.no_figures else comparisons:
        for kind, draw in (("histories", histories_figure), ("solutions", solutions_figure)):
            figure = draw(comparison)
            if figure is not None:
                path = out / f"{kind}_{comparison.problem}.png"
                save(figure, path)
                figures[f"{comparison.problem}: {kind}"] = path
    print(write_comparison(comparisons, out, figures))
    print(f"in {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
