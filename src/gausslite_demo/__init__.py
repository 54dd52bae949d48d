"""The demo, a team on one machine, and the check of a machine and its installation."""
