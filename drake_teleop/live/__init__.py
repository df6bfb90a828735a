"""A station that is driven while it runs, by a page in the browser or by a recorded drive."""
