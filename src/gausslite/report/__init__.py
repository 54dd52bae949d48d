"""One page that shows the results of runs to people: pictures, plots and tables in a single HTML file."""
