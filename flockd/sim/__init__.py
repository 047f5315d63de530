"""The simulated outdoors: worlds, cameras, vehicles and the loop that flies a flock through them."""
