"""GaussLite: online Gaussian maps whose detail follows the robot's task."""

__version__ = "0.1.0"
