"""The agent service: one robot's mapper, its task, its frames and its link to the team."""
