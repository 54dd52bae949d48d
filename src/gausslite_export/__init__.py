"""Write maps in the formats of other tools: splat viewers, point cloud software and robot planners."""
