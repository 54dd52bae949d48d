"""Joint refinement of the fused map (Sec. III-E), and the choice of the keyframes that robots send for it."""
