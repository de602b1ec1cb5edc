"""Optimal control problems, one file each."""
