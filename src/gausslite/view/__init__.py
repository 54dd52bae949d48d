"""A page in the browser that shows maps, runs, agents and fusion servers."""
