"""A simulated world's solids, exact distances to them, and forests and villages drawn from a seed."""
