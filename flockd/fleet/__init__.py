"""During a flight, for people: the drones that are there, orders, the page, ROS 2."""
