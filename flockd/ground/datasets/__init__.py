"""Datasets of real cameras, in folders with depth and poses, for replay."""
