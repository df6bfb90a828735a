"""Studies: designs over scenario fields, their runs, store and statistics."""
