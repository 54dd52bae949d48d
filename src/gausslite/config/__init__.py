"""Program options: the ones that several programs share, and their values from files, environment and flags."""
