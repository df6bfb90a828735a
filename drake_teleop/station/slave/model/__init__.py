"""Repair of the model files of arms, tools and scenes, so that Drake reads them."""
