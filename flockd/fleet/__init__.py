"""For people during a flight: the fleet's state, orders, the page, ROS 2."""
