"""Work with a station: run it, identify its load, excite, analyse, compare, reproduce, study."""
