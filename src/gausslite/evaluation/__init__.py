"""How good a map is: held-out views, image and depth metrics inside the task's region, and pictures to look at."""
