"""What those who operate a fusion server need: figures for Prometheus, and maintenance of a store's file."""
