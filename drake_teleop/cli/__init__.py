"""The command line: commands and their tables on the terminal."""
