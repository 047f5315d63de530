"""A simulated flock: its loop in lockstep, its pilots, what it perceives, and people who watch it."""
