"""A simulated flock: its loop in lockstep, its pilots, their perception, and people who watch it."""
