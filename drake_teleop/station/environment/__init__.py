"""What the tool can touch."""
