"""Other methods for the same problems: direct collocation. CasADi is imported lazily (extra ``baselines``)."""
