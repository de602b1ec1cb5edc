"""Continuation, switches, refinement, certificate: from a residual to a certified solution."""
