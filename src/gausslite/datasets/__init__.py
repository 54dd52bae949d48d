"""Sequences of posed RGB-D frames: files of known layouts and a simulated home, all behind one Source."""
