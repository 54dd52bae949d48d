"""The checks of `gausslite doctor`: each looks at one part of the machine or of the installation."""
