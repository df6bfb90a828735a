"""What is suspicious about a log."""
