"""Records, figures and comparisons of solutions."""
