"""One map from many agents: the store of their voxel updates, the vote on each voxel, and the joint refinement."""
