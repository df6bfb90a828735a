"""Look of pages, pictures and terminal."""
