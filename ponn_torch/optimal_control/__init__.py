"""From an optimal control problem to a residual, through Pontryagin's minimum principle."""
