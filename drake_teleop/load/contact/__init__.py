"""Contact in what is left after elimination."""
