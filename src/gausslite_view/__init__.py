"""Show maps, runs and teams: live pages in the browser, and the report of finished runs."""
