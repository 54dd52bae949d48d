"""The fusion server: stores the agents' voxel updates and serves the fused map."""
