"""The ROS 2 node of GaussLite. Only `node` imports rclpy."""
