"""The design of excitation trajectories: an arm, its limits, a criterion, an optimiser, a check."""
