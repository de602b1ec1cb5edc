"""Pontryagin neural networks: optimal control problems solved through their necessary conditions.

Importing the package loads nothing heavy and sets no global of torch; import the rooms you need.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("ponn-torch")
except PackageNotFoundError:  # a source tree on the path that was never installed
    __version__ = "0+unknown"
