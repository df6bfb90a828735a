"""The wrist sensor."""
