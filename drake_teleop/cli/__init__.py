"""Command line: commands and their tables on the terminal."""
