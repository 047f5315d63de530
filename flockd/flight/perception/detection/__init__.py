"""Detection of drones in two stages: propose, crop, refine, suppress, mask."""
