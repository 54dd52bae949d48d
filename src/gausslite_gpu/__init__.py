"""The GPU backend: gsplat's kernels behind the rasterizer interface, with all training data on the device."""
