"""Recordings and live frames of ROS: bags, messages, transforms, and the logic of the ROS node."""
