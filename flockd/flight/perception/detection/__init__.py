"""Detection of drones in two stages, as a pipeline: propose, crop, refine, suppress, mask."""
