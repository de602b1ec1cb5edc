"""Settings every test runs under; set before torch and matplotlib are first imported."""

import os

# Small matrices gain nothing from threads, and test workers would fight over the cores. As environment
# variables the settings reach the subprocesses that tests start, and the package itself sets nothing.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["MPLBACKEND"] = "Agg"

from hypothesis import settings

# Drawn examples are the same on every run, so that a red test is a change in the code.
settings.register_profile("ponn", deadline=None, max_examples=20, derandomize=True)
settings.load_profile("ponn")
