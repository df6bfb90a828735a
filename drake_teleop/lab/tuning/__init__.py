"""Choice of passivity method and force scales for given hands, walls and network."""
