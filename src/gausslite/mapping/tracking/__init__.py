"""Track the camera against the map, for recordings and robots without a good odometry."""
