"""During a flight, for people: who is there, orders, the page, ROS 2."""
