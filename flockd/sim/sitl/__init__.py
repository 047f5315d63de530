"""A simulated fleet of real daemons and autopilots: their processes, cameras and ground station."""
