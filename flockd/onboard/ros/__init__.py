"""ROS 2: its messages as plain values, pure; and one adapter each to its middleware and to its image messages."""
