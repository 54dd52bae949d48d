"""Sequences of posed RGB-D frames: readers of known folder layouts, behind one `Source` protocol."""
