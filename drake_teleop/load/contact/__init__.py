"""Contact detection in the wrench that remains after elimination of the load."""
