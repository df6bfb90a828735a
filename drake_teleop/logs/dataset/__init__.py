"""Robot-learning datasets with a wrench: verdict for each episode, and contact wrench."""
