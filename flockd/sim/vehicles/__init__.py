"""What flies: vehicles and the wind, and fake autopilots apart from them."""
