"""What those who operate a team need: commands for its services, maintenance of a store, figures for Prometheus."""
