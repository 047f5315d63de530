"""The fleet in ROS 2: its telemetry as standard messages, orders to it, and perception alone for other stacks."""
