"""The torch oracle: the rasterizer in double precision with autograd, which tests compare every backend with."""
