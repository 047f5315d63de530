"""A recording to be looked at in Rerun: what was recorded, and what the networks make of it."""
