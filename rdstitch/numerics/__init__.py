"""Numerical methods that several rooms use: robust loss, nearest points, conjugate gradients, parabolas."""
