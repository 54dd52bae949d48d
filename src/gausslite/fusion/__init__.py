"""One map from many robots: the register of their words, the vote on each voxel, and the joint refinement."""
