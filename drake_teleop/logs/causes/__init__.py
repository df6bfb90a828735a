"""Causes of a misfit: why a rigid load does not explain a wrench, with times and values."""
