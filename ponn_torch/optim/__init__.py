"""Optimisers that know only a residual and its linearisation."""
