"""What the slave finds out from its sensor."""
