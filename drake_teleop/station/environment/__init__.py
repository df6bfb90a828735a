"""Objects that the tool can touch."""
