"""Score maps on held-out views: image and depth metrics inside the task's region, and comparison images."""
