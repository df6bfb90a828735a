"""Search for causes of a misfit: why a rigid load does not explain a wrench."""
