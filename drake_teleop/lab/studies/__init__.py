"""Studies: designs of experiments over scenario fields, with runs, storage and statistics."""
