"""Receding-horizon control: a plant is steered by the start of the solution of a linear boundary value problem."""
