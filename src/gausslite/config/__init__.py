"""Program options shared by the command line and the services."""
