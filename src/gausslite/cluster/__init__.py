"""The store of a fusion server on several machines: voxel regions as shards, each with a standby."""
