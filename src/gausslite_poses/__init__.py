"""Poses and exposure of images, fitted to a map by brightness and by features: refinement of views, camera tracking."""
