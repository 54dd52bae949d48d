"""Notice that a robot is not where its odometry says, and find its place in the map again."""
