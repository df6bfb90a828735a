"""Contact detection in the wrench that remains after removal of the load's wrench."""
