"""A simulated home: textured rooms with named objects, seen by a noisy RGB-D camera whose pose is known exactly."""
