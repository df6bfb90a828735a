"""Search for causes of a misfit: reasons why a rigid load does not explain a wrench."""
