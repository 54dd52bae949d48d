"""Model files on a user's disk: which ones are of use, how they come there whole, and what is in them."""
