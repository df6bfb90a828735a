"""The three parts of a station: master side, channel, slave side (docs/station.md)."""
