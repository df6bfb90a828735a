"""Design of excitation trajectories: robot, limits, criterion, optimiser, check."""
