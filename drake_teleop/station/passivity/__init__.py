"""Methods that keep a bilateral station passive over a channel, and their energy balances."""
