"""What stands in a simulated world: solids, exact distances to them, and forests and villages drawn from a seed."""
