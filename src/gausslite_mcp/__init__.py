"""Goals and views of mapped objects for programs, and for language models by the Model Context Protocol."""
