"""Contact detection in the eliminated wrench."""
