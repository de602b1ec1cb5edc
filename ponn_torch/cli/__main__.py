"""``python -m ponn_torch.cli``."""

import sys

from ponn_torch.cli import main

if __name__ == "__main__":
    sys.exit(main())
