"""The trainable table of splats, its loss and its density control; shared by mapping and refinement."""
