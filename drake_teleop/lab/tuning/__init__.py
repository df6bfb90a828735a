"""Choice of passivity method and force scales for a station, hands, walls and a network."""
