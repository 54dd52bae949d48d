"""What those who operate a team need: commands for its services, maintenance of a store's file, figures for Prometheus."""
