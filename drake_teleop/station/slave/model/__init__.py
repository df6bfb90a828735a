"""Model files of arms, tools and scenes: their repair, so that Drake reads them."""
