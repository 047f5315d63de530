"""Training and export of the networks that flockd ships."""
