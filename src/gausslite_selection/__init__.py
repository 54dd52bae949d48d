"""Which objects a task means: by attributes, further relations and a person's pointing; answers to questions."""
