"""Replays: the pilot computes a recorded flight or a dataset again, and the outputs are compared."""
