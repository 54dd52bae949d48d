"""The quality benchmark: every policy maps the same walks at the same budget and is judged on views off them."""
