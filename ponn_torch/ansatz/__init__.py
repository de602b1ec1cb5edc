"""How an unknown function is written: free functions, constraints and constrained expressions."""
