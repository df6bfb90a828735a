"""Foreign files into one table."""
