"""Links between the programs of a team: frames and tasks to an agent, a service's map, and the team's in an agent."""
