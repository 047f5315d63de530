"""ROS 2: a fleet's telemetry as standard messages, orders to it, and perception alone for other software."""
